"""A sweep's file: what axes decide, which options and points are meant, what is refused before any run. About 2 s."""

import re
from pathlib import Path

import pytest
from blocks import falling_block

from petfsi.errors import InputError
from petfsi.scene.load import apply_set, scene_from_dict
from petfsi.scene.raw import parsed
from petfsi.sweeps.plan import plan_sweep
from petfsi.sweeps.selection import select
from petfsi.sweeps.states import Look
from petfsi.sweeps.table import row_of

FLUID = """
[fluid]
kind = "{kind}"
density = 1000.0
origin = [0.0, 0.0]
size = [1.0, 2.0]
"""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(falling_block(0.2, 0.05))
    return tmp_path


def planned(text, path="s.toml"):
    Path(path).write_text(f'scene = "scene.toml"\n{text}')
    return plan_sweep(Path(path))


def refused(text):
    """Return the mistakes in a sweep's file, a line each."""
    with pytest.raises(InputError) as caught:
        planned(text)
    return str(caught.value).splitlines()[1:]


# ---- axes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["solids.block.young", "solids.block"])
def test_two_axes_cannot_set_a_table_and_a_key_in_it(first):
    young, body = (
        'y = { key = "solids.block.young", values = [1e5, 2e5] }',
        'b = { key = "solids.block", values = [{}] }',
    )
    lines = refused("[axis]\n" + "\n".join([young, body] if first.endswith("young") else [body, young]))
    said = {
        "solids.block.young": "  axis.b: decides set.solids.block, and axis.y set.solids.block.young: one would undo",
        "solids.block": "  axis.y: decides set.solids.block.young, and axis.b set.solids.block: one would undo",
    }
    assert lines[0].startswith(said[first])


def test_axes_may_set_different_keys_of_a_table_and_one_point_a_table_and_its_keys():
    text = """[axis]
    x = { key = "gravity.0", values = [1.0, 2.0] }
    y = { key = "gravity.1", values = [1.0] }
    [axis.body]
    soft = { set = { "solids.block.initial" = { velocity = [0.0, 0.0] }, "solids.block.initial.velocity.0" = 3.0 } }
    """
    first = planned(text).runs[0]
    assert (first.says["gravity"], first.says["solids.block.initial.velocity"]) == ("[1.0, 1.0]", "[3.0, 0.0]")


def test_no_two_runs_are_the_same_but_for_repeat():
    # 00 is the item 0, too: the keys differ, and what they set does not
    twice = """[axis]
    a = { key = "gravity.0", values = [1.0, 2.0] }
    b = { key = "gravity.00", values = [3.0] }
    """
    assert refused(twice) == [
        "  run a-2_b-3: is the same as a-1_b-3: nothing differs, or one axis undoes what another sets"
    ]
    many = "".join(f"p{n} = {{}}\n" for n in range(11))
    assert refused(f"[axis.how]\n{many}")[8:] == ["  and 2 more runs are the same as others"]
    assert (
        len(planned("repeat = 3\n[axis]\ndt = { key = 'time.dt', values = [0.1, 0.05] }\nranks.ranks = [1, 2]").runs)
        == 12
    )


@pytest.mark.parametrize(
    "text, said",
    {
        "values = [2020-01-01]": "axis.d.values: no value is a date or a time",
        "values = [[12:30:00]]": "axis.d.values: no value is a date or a time",
        "point": "axis.d.a.set.time.dt: no setting is a date or a time",
        "set": "set.time.end: no setting is a date or a time",
        "option": "axis.d.a.options.fsi_ksp_rtol: an option's value is a number, a text, true or false",
        "exclude": "exclude.0.d = 2020-01-01: must be a point or several",
    }.items(),
    ids=lambda value: value[:20],
)
def test_a_date_is_a_mistake(text, said):
    files = {
        "point": '[axis.d]\na = { set = { "time.dt" = 2020-01-01 } }',
        "set": 'set = { "time.end" = 2020-01-01T00:00:00Z }',
        "option": "[axis.d]\na = { options = { fsi_ksp_rtol = 2020-01-01 } }",
        "exclude": 'exclude = [{ d = 2020-01-01 }]\n[axis]\nd = { key = "time.dt", values = [0.1] }',
    }
    lines = refused(files.get(text, f'[axis]\nd = {{ key = "time.dt", {text} }}'))
    assert len(lines) == 1 and said in lines[0] and "datetime" not in lines[0]


# ---- options ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ksp_rtol", "steps", "out"])
def test_an_option_that_no_run_would_read_is_a_mistake(name):
    lines = refused(f'[axis]\no = {{ option = "{name}", values = [1, 2, 3] }}')
    assert lines == [f"  run o-1: option -{name}: is read by nothing; petfsi's begin with -fsi_"]


def test_every_option_that_is_wrong_is_told_with_its_line():
    Path("mine.opts").write_text("-fsi_ksp_rtol 1e-5\n-ksp_rtol 1\n")
    assert refused('[axis.o]\na = { options_file = "mine.opts", options = { pc_type = "lu" } }') == [
        "  run o-a: mine.opts, line 2: option -ksp_rtol: is read by nothing; petfsi's begin with -fsi_",
        "  run o-a: option -pc_type: is read by nothing; petfsi's begin with -fsi_",
    ]
    lines = refused('[axis.o]\na = { options = { fsi_ksp_rtol = "x", fsi_ksp_max_it = "y" } }')
    assert ["-fsi_ksp_rtol x" in lines[0], "-fsi_ksp_max_it y" in lines[1], len(lines)] == [True, True, 2]
    assert "cannot be read" in refused(f'[axis.o]\na = {{ options_file = "{"x" * 300}" }}')[0]
    assert planned("[axis.o]\na = { options = { log_view = true } }").runs  # PETSc reads it at its start


def test_a_file_of_shipped_files_is_copied_and_a_change_of_it_seen():
    file = '[axis.o]\na = { options_file = "mine.opts" }'
    Path("mine.opts").write_text("-options_file monolithic.opts\n")
    plan = planned(file)
    run = plan.runs[0]
    assert plan.files[run.options[1]] == b"-options_file monolithic.opts\n"
    assert any(key.startswith("mine.opts: -fsi_") for key in run.says)
    Path("mine.opts").write_text("-options_file split.opts\n")
    assert planned(file).runs[0].hash != run.hash


def test_a_shipped_file_is_meant_where_none_stands_beside_the_sweep(place, monkeypatch):
    Path("elsewhere").mkdir()
    Path("elsewhere/monolithic.opts").write_text("-fsi_ksp_rtol 1e-1\n")
    file, path = '[axis.o]\na = { options_file = "monolithic.opts" }', place / "s.toml"
    run = planned(file, path).runs[0]
    assert run.options == ["-options_file", "monolithic.opts"]
    monkeypatch.chdir("elsewhere")
    assert planned(file, path).runs == [run]
    (place / "monolithic.opts").write_text("-fsi_ksp_rtol 1e-2\n")
    assert planned(file, path).runs[0].says["monolithic.opts: -fsi_ksp_rtol"] == "1e-2"


# ---- points -------------------------------------------------------------------------------------------------

LISTS = """
exclude = [{ w = [[0, 1]], dt = 0.05 }]
[axis]
w = { key = "gravity", values = [[0.0, -1.0], [0.0, 1.0]] }
dt = { key = "time.dt", values = [0.1, 0.05] }
"""


@pytest.mark.parametrize(
    "only, numbers",
    {
        "w=[0.0, -1.0]": [0, 1],
        "w=[0,-1],dt=0.05": [1],
        "dt=1e-1, w=[0,1],w=[0, -1]": [0, 2],
        "NAME2": [2],
        "NAME2,NAME0": [0, 2],
        "NAME2 , dt=0.05": [1, 2],
    }.items(),
)
def test_only_takes_lists_and_names_of_runs(only, numbers):
    runs = planned(LISTS).runs
    assert len(runs) == 3
    text = re.sub(r"NAME(\d)", lambda match: runs[int(match[1])].name, only)
    assert select(text, runs) == [runs[n] for n in numbers]


@pytest.mark.parametrize(
    "only, said",
    [
        ("w", "must be axis=point, or the name of a run; axes are w, dt"),
        ("w=[0,-2]", "no such point; w has [0.0, -1.0], [0.0, 1.0]"),
        ("w=[0,-1],", "must be axis=point"),
        ("w=[0,-1", "no such point"),
        ("w=[0,1],dt=0.05", "they are excluded"),
    ],
)
def test_only_says_what_is_wrong(only, said):
    with pytest.raises(InputError, match=re.escape(said)):
        select(only, planned(LISTS).runs)


def test_an_exclusion_of_no_point_is_a_mistake():
    assert refused(LISTS.replace("w = [[0, 1]]", "w = []")) == ["  exclude.0.w = []: must be a point or several"]


def test_a_figure_does_not_take_the_place_of_an_axis():
    run = planned("""[axis]
    "last.top.y" = { key = "gravity.0", values = [1.0] }
    state = { key = "gravity.1", values = [2.0] }
    dt = { key = "time.dt", values = [0.1] }
    """).runs[0]
    row = row_of(run, Look("done", "", 2, summary={"probes": {"top.y": 0.5}}))
    assert (row["axis.last.top.y"], row["last.top.y"], row["axis.state"], row["dt"]) == ("1", 0.5, "2", "0.1")


# ---- what a scene's mistakes suggest ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "setting, shape, meant",
    [
        ("solids.block.cells=3", "box", "'solids.block.shape.box.cells'"),
        ("solids.block.cells=3", "ball", "'solids.block.shape.ball.cells'"),
        ("solids.block.cells=3", "mesh", "'solids.block.shape.cells'"),
        ("solids.block.scale=3", "mesh", "'solids.block.shape.scale'"),
        ("coupling.spacing=3", "mac", ""),
        ("coupling.spacing=3", "sph", "'fluid.spacing'"),
        ("coupling.cells=3", "sph", ""),
    ],
)
def test_what_a_setting_is_taken_for_is_of_the_scene(setting, shape, meant):
    shapes = {
        "ball": "{ ball = { centre = [0.0, 0.0], radius = 1.0, cells = 4 } }",
        "mesh": '{ mesh = "block.msh" }',
    }
    fluid = FLUID.format(kind=shape) if shape in ("mac", "sph") else ""
    given = {"shape": shapes[shape]} if shape in shapes else {}
    data = parsed(falling_block(0.2, 0.05, **given, more=fluid), "scene")
    apply_set(data, setting)
    with pytest.raises(InputError) as caught:
        scene_from_dict(data)
    line = next(line for line in str(caught.value).splitlines() if setting.split("=")[0] in line)
    assert (f"did you mean {meant}?" in line) if meant else ("did you mean" not in line)


# ---- what is named twice, or not at all -----------------------------------------------------------------------


def test_a_folder_is_no_scene():
    Path("s.toml").write_text('scene = "."\n')
    with pytest.raises(InputError, match="scene: "):
        plan_sweep(Path("s.toml"))


def test_names_that_read_as_one_number_are_two_points():
    text = """exclude = [{ a = "10" }]
    [axis.a]
    1_0 = { set = { "time.dt" = 0.1 } }
    10 = { set = { "time.dt" = 0.05 } }
    """
    runs = planned(text).runs
    assert [run.name for run in runs] == ["a-1_0"]
    assert [run.name for run in select("a=1_0", runs)] == ["a-1_0"]


def test_values_that_read_as_one_number_are_one_point():
    text = """exclude = [{ dt = 5e-2 }]
    [axis]
    dt = { key = "time.dt", values = [0.1, 0.05] }
    """
    assert [run.axes["dt"] for run in planned(text).runs] == ["0.1"]


@pytest.mark.parametrize(
    "text, said",
    [
        ("a.x = { options = { -fsi_ksp_rtol = 1e-3, fsi_ksp_rtol = 1e-4 } }", "stands there twice"),
        ('a.ranks = ["2"]', "axis.a.ranks = \"2\": must be a whole number"),
        ("a.ranks = [true]", "axis.a.ranks = true: must be a whole number"),
        ('a = { key = "time.dt", values = { from = 0.1, step = 0.0, count = 3 } }', "0.1 stands there more than once"),
        ('a = { key = "time.dt", values = [0.1, 0.1, 0.05, 0.05] }', "0.1, 0.05 stand there more than once"),
    ],
)  # fmt: skip
def test_what_stands_twice_or_is_no_number_is_told_as_it_was_written(text, said):
    lines = refused(f"[axis]\n{text}")
    assert len(lines) == 1 and said in lines[0]
