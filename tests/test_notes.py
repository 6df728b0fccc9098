"""What `check` tells of a scene, and `run` warns of: true where it is said, and not said where it is not."""

import math
import time
from pathlib import Path

import meshio
import numpy as np
import pytest
from step_cases import loaded, prepared

from petfsi.notes.bending import SHEARED, SLOWEST, Span, bending_period, wave_time, widest_span
from petfsi.notes.forms import form_of, held
from petfsi.notes.notes import find_notes
from petfsi.notes.solids import _steps
from petfsi.runs.plan import describe_plan, read_files
from petfsi.runs.run import run_scene
from petfsi.scene.load import scene_from_dict

ROOT = Path(__file__).parents[1]
CLAMP = [{"where": "left", "fix": ["x", "y"]}]


def bar(cells=(40, 4), size=(1.0, 0.1), supports=CLAMP, **more):
    shape = {"box": {"origin": [0.0] * len(size), "size": list(size), "cells": list(cells)}}
    solid = {"shape": shape, "density": 1000.0, "young": 1e6, "poisson": 0.3}
    return solid | ({"supports": supports} if supports else {}) | more


def beam(supports=(), **more):
    shape = {"beam": {"start": [0.2, 0.1], "end": [0.8, 0.7], "thickness": 0.02, "elements": 10}}
    return {"shape": shape, "density": 1000.0, "young": 1e6, "poisson": 0.3, "supports": list(supports)} | more


def water(cells=(40, 40), **more):
    return {"density": 1000.0, "origin": [-1.0, -1.0], "size": [4.0, 4.0], "cells": list(cells)} | more


def scene(solid=None, fluid=None, directory=".", dim=2, dt=0.01, **more):
    data = {"dim": dim, "time": {"end": 1.0, "dt": dt} | more.pop("time", {}), **more}
    data |= {"solids": {"b": solid}} if solid else {}
    return scene_from_dict(data | ({"fluid": fluid} if fluid else {}), directory)


def warned(made, splits=False):
    """Return all warnings of a scene, and all notes, a line each."""
    notes = find_notes(made, read_files(made)[0], made.time.dt, splits)
    return [
        "\n".join(note.text for note in notes if note.warns),
        "\n".join(note.text for note in notes if not note.warns),
    ]


# ---- kinds of notes -----------------------------------------------------------------------------------------

SMALL = {"shape": {"ball": {"centre": [1.0, 1.0], "radius": 0.1, "cells": 8}}}
JET = {"inflow": {"speed": "60*(1 - (y/0.1)**2)", "region": {"box": {"origin": [-2.0, 0.0], "size": [2.0, 0.1]}}}}
WARNED = {
    "few across": (scene(bar(cells=(20, 2))), "linear elements, 2 across it, poisson = 0.3: it bends about 1.7"),
    "few across 3D": (
        scene(bar((20, 2, 2), (1.0, 0.1, 0.1), [{"where": "left", "fix": ["x", "y", "z"]}], poisson=0.495), dim=3),
        'about 18 times too stiffly (locking); set elements = "quadratic", or take volumetric = "reduced" and 4 across',
    ),
    "thin walls": (
        scene(bar((20, 20), (1.0, 1.0)) | {"shape": bar((20, 20), (1.0, 1.0))["shape"]
              | {"cavity": {"origin": [0.05, 0.05], "size": [0.9, 0.9]}}}), "b: linear elements, 1 across its wall"),
    "long elements": (scene(bar(cells=(5, 2))), "with more of them along it, or give it as a beam"),
    "no support": (scene(bar(supports=None), gravity=[0, -9.81]), "gravity carries it away"),
    "a load on what nothing holds": (scene(bar(supports=None, body_force=[1.0, 0.0])), "its load carries it away"),
    "a small body": (scene(bar() | SMALL, water()), "b is 2 of the fluid's cells across, where 4 are few"),
    "a thin body by rays": (scene(bar(), water(), coupling={"transfer": "ray"}), '"cutcell" has it in its place'),
    "a fast start": (scene(None, water(initial={"velocity": [60.0, 0.0]})), "6 cells a step, by fluid.initial.vel"),
    "a fast jet": (scene(None, water(sides={"left": JET, "right": "open"})), "6 cells a step, by fluid.sides.left.in"),
    "a jet into a closed box": (scene(bar(), water(sides={"left": JET})), "fluid.sides.left: what comes in can leave"),
    "a fast body": (scene(bar(initial={"velocity": ["70*x", 0.0]}), water()), "by solids.b.initial.velocity"),
    "a fast support": (
        scene(bar(supports=[CLAMP[0] | {"displacement": {"x": "sin(80*t)"}}]), water()), "supports.0.displacement"),
    "a quick swing": (scene(bar(), dt=0.4), "takes about 4.7 steps, too few to be followed; time.dt = 0.18 res"),
}  # fmt: skip


@pytest.mark.parametrize(("made", "said"), WARNED.values(), ids=WARNED)
def test_what_is_likely_wrong_is_warned_of(made, said):
    assert said in warned(made)[0]
    assert max(map(len, warned(made)[0].splitlines())) < 240


SILENT = {
    "four across": scene(bar()),
    "quadratic": scene(bar(cells=(20, 1), elements="quadratic")),
    "a beam": scene(beam([{"where": "start", "fix": ["x", "y", "angle"]}])),
    "held all along": scene(bar(cells=(20, 1), supports=[{"where": "bottom", "fix": ["x", "y"]}])),
    "no bar": scene(bar(cells=(2, 2), size=(1.0, 1.0))),
    "a plate held around": scene(
        bar(
            (10, 10, 1),
            (1.0, 1.0, 0.1),
            [{"where": s, "fix": ["x", "y", "z"]} for s in ("left", "right", "top", "bottom")],
        ),
        dim=3,
    ),
    "afloat": scene(bar(supports=None), water(), gravity=[0, -9.81]),
    "it flies": scene(bar(supports=None, initial={"velocity": [1.0, 0.0]})),
    "a jet that is fast where it is closed": scene(
        None, water(sides={"left": {"inflow": JET["inflow"] | {"speed": "1-(y/0.1)**2"}}, "right": "open"})
    ),
    "slow": scene(bar(), water(), dt="0.001*(1+t)"),
    "as good as rigid": scene(bar(young=1e12)),
    "static": scene(bar(), time={"integrator": "static"}, dt=1.0),
    "alone": scene(None, water()),
}


@pytest.mark.parametrize("made", SILENT.values(), ids=SILENT)
def test_what_is_fine_is_not_warned_of(made):
    notes = find_notes(made, {}, 0.001 if isinstance(made.time.dt, str) else made.time.dt)
    assert [note.text for note in notes if note.warns] == []


TOLD = {
    "free": (scene(bar(supports=None, density=500.0), water()), "nothing holds it in the fluid, of which it has 0.5"),
    "thin": (scene(bar(), water()), "b is 1 of the fluid's cells across where it is thinnest: the fluid on its sides"),
    "no speed": (scene(None, water()), "CFL: no speed is given"),
    "cfl": (scene(None, water(initial={"velocity": [0.0, "x"]})), "CFL: 0.3 cells a step, by fluid.initial.velocity"),
    "masses": (scene(bar(), water()), "mass ratio, solid to fluid: b 1; only split.opts minds it"),
    "periods": (scene(bar()), "its slowest bending takes about 1.9 s = 190 steps; pressure waves cross an element in"),
    "waves": (scene(bar()), "step, damped by bdf2"),
    "waves that stay": (scene(bar(), time={"integrator": "midpoint"}), "step, which midpoint does not damp"),
    "wet": (scene(bar(), water()), "s with the fluid it moves)"),
}  # fmt: skip


@pytest.mark.parametrize(("made", "said"), TOLD.values(), ids=TOLD)
def test_what_a_user_may_want_to_know_is_told_by_check(made, said):
    assert said in warned(made)[1] and said in describe_plan(made)


@pytest.mark.parametrize(("density", "told"), [(500.0, True), (1e5, False)])
def test_light_solids_are_warned_of_where_options_split(density, told):
    made = scene(bar(density=density), water())
    assert ("time splitting will be unstable" in warned(made, splits=True)[0]) == told
    assert "splitting" not in warned(made)[0]


def test_of_many_solids_few_lines_are_told():
    solids = {f"b{n}": bar(size=(0.1, 0.1), supports=None) for n in range(150)}
    for n, solid in enumerate(solids.values()):
        solid["shape"]["box"]["origin"] = [0.2 * n, 0.0]
    made = scene_from_dict({"dim": 2, "time": {"end": 1.0, "dt": 0.1}, "solids": solids})
    notes = find_notes(made, {}, 0.1)
    assert len(notes) < 20 and "and 144 more like the last one" in [note.text for note in notes]


#: Of the scenes that come along those that are warned of, and why that is so.
FLAWED = {
    "flap.toml": "2 across it",  # two linear triangles across a flap
    "sheet.toml": "1 across it",  # one, 160 times as long as thick
}


@pytest.mark.parametrize("path", [*ROOT.glob("jobs/*.toml"), *ROOT.glob("tests/scenes/*.toml")], ids=lambda p: p.name)
def test_scenes_that_come_along_are_fine_but_for_those_that_are_not(path):
    made = loaded(path)
    begin = time.perf_counter()
    notes = find_notes(made, {}, made.time.dt if isinstance(made.time.dt, float) else 2e-4)
    assert time.perf_counter() - begin < 0.1  # 1 ms as a rule
    said = "\n".join(note.text for note in notes if note.warns)
    assert (FLAWED[path.name] in said and said.count("\n") == 0) if path.name in FLAWED else said == ""


# ---- where they are said ------------------------------------------------------------------------------------

OVERLAPS = {
    "two speeds": ({"velocity": {"x": 1.0}}, {"velocity": {"x": "2.0*t"}}, "velocity 1.0, velocity 2.0*t"),
    "rest and a way": ({}, {"displacement": {"x": "0.1*t"}}, "at rest, displacement 0.1*t"),
    "by place": ({"velocity": {"x": "y"}}, {"velocity": {"x": "2*y"}}, "velocity y, velocity 2*y"),
    "written otherwise": ({"velocity": {"x": "t+t"}}, {"velocity": {"x": "2*t"}}, None),
    "both rest": ({"displacement": {"x": 0.0}}, {"velocity": {"x": "0*t"}}, None),
    "the same": ({"velocity": {"x": "sin(t)"}}, {"velocity": {"x": "sin(t)"}}, None),
    "alike where they meet": ({"velocity": {"x": "1-y"}}, {"velocity": {"x": "1-y-(1-y)*x"}}, None),
    "other axes": ({"fix": ["y"]}, {"fix": ["x"], "velocity": {"x": 1.0}}, None),
}


def overlapping(first, second, **shape):
    fixed = {"fix": ["x", "y"]}
    supports = [{"where": "left", **fixed, **first}, {"where": "top", **fixed, **second}]
    return scene(bar((4, 4), (1.0, 1.0), supports), time={"retries": 0})


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(("first", "second", "said"), OVERLAPS.values(), ids=OVERLAPS)
def test_supports_that_disagree_are_named_with_place_and_values(first, second, said):
    with prepared(overlapping(first, second)) as sim:
        warnings = list(sim.solid.warnings)
    if said is None:
        assert warnings == []
        return
    assert len(warnings) == 1 and "supports.0 (left) and supports.1 (top) move the node at (0, 1) m" in warnings[0]
    assert f"differently along x: {said}. The later one, supports.1, counts there" in warnings[0]


def test_supports_of_beams_and_of_shapes_are_named_too():
    place = {"ball": {"centre": [0.2, 0.1], "radius": 0.1}}
    turned = [{"where": "start", "fix": ["angle"]}, {"where": place, "fix": ["angle"], "velocity": {"angle": 1.0}}]
    joint = {"beam": beam(turned), "block": bar((2, 2), (0.1, 0.1), CLAMP)}
    with prepared(scene_from_dict({"dim": 2, "time": {"end": 1.0, "dt": 0.1}, "solids": joint})) as sim:
        (said,) = sim.solid.warnings
    assert said.startswith("solids.beam: supports.0 (start) and supports.1 (a ball) move the node at (0.2, 0.1) m by")


def test_check_and_the_log_say_the_same_warnings(tmp_path, here):
    path = tmp_path / "scene.toml"
    path.write_text("""
        dim = 2
        time = { end = 1.0, dt = 0.01 }
        [solids.b]
        shape = { box = { origin = [0.0, 0.0], size = [1.0, 0.1], cells = [20, 2] } }
        density = 1000.0
        young = 1e6
        poisson = 0.3
        supports = [{ where = "left", fix = ["x", "y"] }, { where = "top", fix = ["x"], velocity = { x = "t" } }]
    """)
    said = here("check", path).stdout.split("\nnotes:\n")[1].splitlines()
    told = [line.strip() for line in said if "warning: " in line]
    assert len(told) == 2 and "supports.1, counts there" in told[0] and "too stiffly" in told[1]
    assert here("run", path, "--out", tmp_path / "out", "--steps", 1).returncode == 0
    log = (tmp_path / "out" / "log.txt").read_text().splitlines()
    assert [line for line in log if line.startswith("warning: ")] == told
    assert not [line for line in log if "pressure waves" in line]
    # a run that goes on unchanged has said so; one that is changed is looked at again
    for sets, times in (((), 1), (("--set", "time.dt=0.02"), 2)):
        assert here("resume", tmp_path / "out", "--steps", 1, *sets).returncode == 0
        assert (tmp_path / "out" / "log.txt").read_text().count(told[1]) == times


# ---- are they true? -----------------------------------------------------------------------------------------


def euler_bernoulli(solid, length, c):
    """Return the period of a slender beam, s: omega = c sqrt(E I / (rho A L^4))."""
    shape = solid.shape
    flat = 1.0 if shape.beam is not None else 1 - solid.poisson**2
    thickness = shape.beam.thickness if shape.beam is not None else min(shape.box.size)
    return 2 * math.pi * length**2 / c * math.sqrt(12 * solid.density * flat / solid.young) / thickness


PIN = {"where": {"box": {"origin": [-0.01, -0.01], "size": [0.012, 0.012]}}, "fix": ["x", "y"]}
ROLLER = {"where": {"box": {"origin": [0.995, -0.01], "size": [0.012, 0.012]}}, "fix": ["y"]}
MIDDLE = {"where": {"box": {"origin": [0.49, -1.0], "size": [0.02, 2.0]}}, "fix": ["x", "y"]}
RIGHT = {"where": "right", "fix": ["x", "y"]}
X = {"where": "left", "fix": ["x"]}  # a plane of symmetry
X_RIGHT = {"where": "right", "fix": ["x"]}
START, END = ({"where": where, "fix": ["x", "y", "angle"]} for where in ("start", "end"))
SLENDER = {"size": (1.0, 0.02), "cells": (100, 4)}
SPANS = {
    "cantilever": (bar(**SLENDER), 1.0, 3.516),
    "free": (bar(**SLENDER, supports=None), 1.0, 22.37),
    "pinned": (bar(**SLENDER, supports=[PIN, ROLLER]), 1.0, math.pi**2),
    "clamped": (bar(**SLENDER, supports=[*CLAMP, RIGHT]), 1.0, 22.37),
    "propped": (bar(**SLENDER, supports=[*CLAMP, ROLLER]), 1.0, 15.42),
    "held in the middle": (bar(**SLENDER, supports=[MIDDLE]), 0.49, 3.516),
    "a beam": (beam([START]), math.hypot(0.6, 0.6), 3.516),
    "a free beam": (beam(), math.hypot(0.6, 0.6), 22.37),
    "a pinned beam": (
        beam([{"where": w, "fix": ["x", "y"]} for w in ("start", "end")]), math.hypot(0.6, 0.6), math.pi**2),
    "a clamped beam": (beam([START, END]), math.hypot(0.6, 0.6), 22.37),
    "half of what is pinned": (bar(**SLENDER, supports=[X, ROLLER]), 2.0, math.pi**2),
    "half of what is clamped": (bar(**SLENDER, supports=[X, RIGHT]), 2.0, 22.37),
    "half of what is free": (bar(**SLENDER, supports=[X]), 2.0, 22.37),
    "between planes of symmetry": (bar(**SLENDER, supports=[X, X_RIGHT]), 1.0, math.pi**2),
    "half of a pinned beam": (
        beam([{"where": "start", "fix": ["angle"]}, {"where": "end", "fix": ["x", "y"]}]),
        2 * math.hypot(0.6, 0.6), math.pi**2),
    "held along a half of it": (
        bar((400, 1), (1.0, 0.002), [{"where": {"box": {"origin": [-0.1, -0.1], "size": [0.6, 1.0]}}, "fix": ["y"]}]),
        0.5, 3.516),
}  # fmt: skip


@pytest.mark.parametrize(("solid", "length", "c"), SPANS.values(), ids=SPANS)
def test_periods_of_slender_solids_are_those_of_euler_and_bernoulli(solid, length, c):
    solid = scene(solid).solids["b"]
    form = form_of(solid, 2, None)
    span = widest_span(form, held(solid, form, Path()))
    assert bending_period(solid, form, span) == pytest.approx(euler_bernoulli(solid, length, c), rel=0.03)


ALL = ["x", "y", "z"]
PLATES = {
    "as wide as long": ((0.05, 1.0, 1.0), (1, 5, 5), ["bottom"], (1.0, ("clamped", "free"))),
    "wider than long": ((0.05, 1.0, 2.0), (1, 10, 4), ["bottom"], (1.0, ("clamped", "free"))),
    "longer than wide": ((0.05, 1.0, 0.4), (1, 10, 4), ["bottom"], (1.0, ("clamped", "free"))),
    "between two walls": ((0.05, 1.0, 1.5), (1, 5, 5), ["bottom", "top"], (1.0, ("clamped", "clamped"))),
    "one side of it": ((0.05, 1.0, 1.5), (1, 5, 5), ["front"], (1.5, ("clamped", "free"))),
    "all round": ((0.05, 1.0, 1.0), (1, 5, 5), ["bottom", "top", "front", "back"], None),
    "free": ((0.05, 1.0, 1.5), (1, 5, 5), [], (1.5, ("free", "free"))),
}


@pytest.mark.parametrize(("size", "cells", "where", "right"), PLATES.values(), ids=PLATES)
def test_plates_bend_along_the_side_that_is_free_to(size, cells, where, right):
    solid = scene(bar(cells, size, [{"where": w, "fix": ALL} for w in where]), dim=3).solids["b"]
    form = form_of(solid, 3, None)
    span = widest_span(form, held(solid, form, Path()))
    assert right == (span and (pytest.approx(span.length), span.ends))


def test_a_wide_flap_is_warned_of_as_a_narrow_one_is():
    for width in (0.4, 1.0, 3.0):
        made = scene(bar((1, 10, 4), (0.05, 1.0, width), [{"where": "bottom", "fix": ALL}]), dim=3, dt=0.2)
        said = "".join(warned(made))
        assert "linear elements, 1 across it" in said and "its slowest bending takes about 3.9 s" in said


def test_an_inflow_that_swings_is_seen_wherever_it_is_nothing_at_equal_times():
    for end in (1.0, 8.0, 16.0):
        inflow = {"inflow": {"speed": "50*sin(4*pi*t)"}}
        made = scene(None, water(sides={"left": inflow, "right": "open"}), time={"end": end})
        assert "CFL: 5 cells a step" in "".join(warned(made))


def test_a_jet_with_a_way_out_is_none_into_a_closed_box():
    slow = {"inflow": JET["inflow"] | {"speed": 0.1}}
    region = {"box": {"origin": [2.0, 0.5], "size": [2.0, 0.1]}}
    for sides in (
        {"left": slow, "right": {"pressure": 0.0}}, {"left": {"inflow": slow["inflow"] | {"rest": "open"}}},
        {"left": slow, "right": {"inflow": {"speed": -0.1, "region": region}}},
    ):  # fmt: skip
        assert "no side is open" not in "".join(warned(scene(bar(), water(sides=sides))))


def jets(**speeds):
    """A solid of .1 m^2 in a box with sides of 4 m that speeds are given of."""
    return scene(bar(), water(sides={side: {"inflow": {"speed": v}} for side, v in speeds.items()}))


BALLS = {side: {"inflow": {"speed": 1.0, "region": {"ball": {"centre": [x, 0.0], "radius": 0.3}}}}
         for side, x in (("left", -1.0), ("right", 3.0))}  # fmt: skip
NET = {
    "one": (jets(left=1.0), "fluid.sides.left: what comes in can leave nowhere", "to nothing by t = 0.03 s"),
    "two": (jets(left=0.5, right=0.5), "fluid.sides.left, right: what comes in can", "to nothing by t = 0.03 s"),
    "more in than out": (jets(left=1.0, right=-0.98), "left, right: what comes in", "by 80% of their volume by t = 1"),
    "out": (jets(left=-1.0), "left: what is drawn out comes in nowhere", "by 100% of their volume by t = 0.03 s"),
    "it swings": (jets(left="pi/40*sin(2*pi*t)"), "left: what comes in", "squeezed to nothing by t = 0.5 s"),
    "parts of sides": (scene(bar(), water(sides=BALLS)), "left, right: what comes in", "to nothing by t = 0.09 s"),
    "a ramp": (
        scene(bar(), water(sides={"left": {"inflow": {"speed": 0.025, "ramp": 1.0}}})),
        "left: what comes in", "by 50% of their volume by t = 1 s",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("made", "said", "much"), NET.values(), ids=NET)
def test_of_a_closed_box_it_is_told_what_comes_in_net(made, said, much):
    (line,) = [line for line in warned(made)[0].splitlines() if "no side is open" in line]
    assert said in line and much in line


@pytest.mark.parametrize(
    ("speeds", "told"),
    [({"left": "sin(pi*y/2)"}, ""), ({"left": 0.0}, ""), ({"left": "6*(y+1)*(3-y)/16", "right": -1.0}, ""),
     ({"left": "1e-3*pi*sin(2*pi*t)"}, "left: no side is open: solids shrink by 4% of their volume by t = 0.5 s"),
     ({"left": "-1e-3*pi*sin(2*pi*t)"}, "left: no side is open: solids swell by 4% of their volume by t = 0.5 s")],
)  # fmt: skip
def test_what_comes_to_nothing_or_little_in_a_closed_box_is_not_warned_of(speeds, told):
    warnings, notes = warned(jets(**speeds))
    assert "no side is open" not in warnings
    assert told in notes if told else "no side is open" not in notes


@pytest.mark.parametrize(("across", "said"), [(3.98, "is 3.98 of"), (3.99996, "is 3.99996 of"), (3.84, "is 3.8 of")])
def test_what_is_too_few_across_is_said_in_digits_that_show_it(across, said):
    for size, advice in (((across, across), "1.1 times finer fluid.cells"), ((across, 10.0), "where it is thinnest")):
        size = [0.1 * side for side in size]
        told = "\n".join(warned(scene(bar((40, 40), size, None), water())))
        assert said in told and advice in told
        assert "4 of the fluid" not in told


def test_a_narrow_inflow_is_seen():
    inflow = {"inflow": {"speed": "50*exp(-((y - 0.77)/0.02)**2)"}}
    said = "".join(warned(scene(None, water(sides={"left": inflow, "right": "open"}))))
    assert float(said.split("CFL: ")[1].split()[0]) == pytest.approx(5.0, rel=0.05)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_bar_from_a_file_is_a_bar_wherever_it_lies(tmp_path, angle):
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 51), np.linspace(0, 0.04, 3), indexing="ij"))
    n = 3 * np.repeat(np.arange(50), 2) + np.tile(np.arange(2), 50)
    cells = np.concatenate((np.column_stack((n, n + 3, n + 4)), np.column_stack((n, n + 4, n + 1))))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    points = np.column_stack((np.column_stack((x, y)) @ turn, np.zeros(len(x))))
    meshio.write_points_cells(tmp_path / "bar.msh", points, [("triangle", cells)], file_format="gmsh")
    foot = {"ball": {"centre": [0.0, 0.0], "radius": 0.05}}
    solid = bar() | {"shape": {"mesh": "bar.msh"}, "supports": [{"where": foot, "fix": ["x", "y"]}]}
    made = scene(solid, directory=tmp_path)
    form = form_of(made.solids["b"], 2, read_files(made)[0]["b"])
    assert form.filled and form.lengths == pytest.approx([0.04, 1.0]) and form.bend(-1).across == pytest.approx(2.0)
    assert form.altitude == pytest.approx(0.02 / 2**0.5)
    span = widest_span(form, held(made.solids["b"], form, tmp_path))
    assert span.ends == ("clamped", "free") and span.length == pytest.approx(0.96, abs=0.01)
    assert "2 across it" in warned(made)[0]


def swing(solid, dt, steps):
    """Return the period of a solid that is thrown, by the instants at which its tip comes back, s."""
    at = {"of": "b", "at": [1.0, 0.05], "quantity": "displacement"}
    with prepared(scene(solid, dt=dt, time={"end": 10.0, "integrator": "midpoint"}, probes={"tip": at})) as sim:
        tip = [0.0]
        for _ in range(steps):
            sim.advance()
            tip.append(sim.probe()[1])
    back = np.flatnonzero(np.diff(np.sign(tip[1:])))
    return 2 * dt * float(np.diff(back).mean())


SWINGS = {
    "a cantilever": (CLAMP, "1e-4*x**2", ("clamped", "free")),
    "half of what is pinned": ([PIN | {"fix": ["y"]}, X_RIGHT], "1e-4*sin(pi*x/2)", ("guided", "pinned")),
    "half of what is clamped": ([*CLAMP, X_RIGHT], "1e-4*(1-cos(pi*x))", ("clamped", "guided")),
}


@pytest.mark.parametrize(("supports", "speed", "ends"), SWINGS.values(), ids=SWINGS)
def test_a_bar_swings_as_long_as_is_said_of_it(supports, speed, ends):
    thrown = bar((10, 1), supports=supports, elements="quadratic", initial={"velocity": [0.0, speed]})
    solid = scene(thrown).solids["b"]
    form = form_of(solid, 2, None)
    span = widest_span(form, held(solid, form, Path()))
    assert span == Span(pytest.approx(1.0), ends, 1)
    said = bending_period(solid, form, span)
    assert swing(thrown, said / 60, 130) == pytest.approx(said, rel=0.05)


@pytest.mark.parametrize("end", ["clamped", "free", "pinned"])
def test_half_of_a_short_bar_swings_as_long_as_all_of_it(end):
    """As shear counts there; by symmetry the middle is a guided end."""
    solid = scene(bar((40, 10), (1.0, 0.25))).solids["b"]
    form = form_of(solid, 2, None)
    half = Span(0.5, (min(end, "guided"), max(end, "guided")), 1)
    whole = Span(1.0, (end, end), 1)
    assert bending_period(solid, form, half) == pytest.approx(bending_period(solid, form, whole), rel=1e-4)


@pytest.mark.parametrize(
    "number, said",
    [(190.4, "190 steps"), (2.44, "2.4 steps"), (1.06, "1.1 steps"), (1.04, "1 step"), (1.0, "1 step")]
    + [(0.96, "1 step"), (0.94, "1/1.1 step"), (1 / 2.4, "1/2.4 step")],
)
def test_a_number_of_steps_reads_well_near_one(number, said):
    assert _steps(number) == said


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45])
def test_a_wave_crosses_an_element_at_the_speed_of_pressure(poisson):
    solid = scene(bar(cells=(50, 5), poisson=poisson)).solids["b"]
    modulus = 1e6 * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    assert wave_time(solid, form_of(solid, 2, None)) == pytest.approx(0.02 / 2**0.5 / math.sqrt(modulus / 1000))


def test_the_table_of_slowest_bendings_solves_the_equations_of_beams():
    root = {ends: math.sqrt(c) for ends, c in SLOWEST.items()}
    for ends, sign in ((("clamped", "free"), 1), (("clamped", "clamped"), -1), (("free", "free"), -1)):
        assert math.cos(root[ends]) * math.cosh(root[ends]) == pytest.approx(-sign, abs=2e-2)
    for ends in (("clamped", "pinned"), ("free", "pinned")):
        assert math.tan(root[ends]) == pytest.approx(math.tanh(root[ends]), abs=1e-3)
    for ends in (("clamped", "guided"), ("free", "guided")):
        assert math.tan(root[ends]) == pytest.approx(-math.tanh(root[ends]), abs=1e-3)
    assert math.cos(root["guided", "pinned"]) == pytest.approx(0.0) == math.sin(root["guided", "guided"])
    assert math.tan(SHEARED["free", "pinned"]) == pytest.approx(SHEARED["free", "pinned"], rel=1e-2)


def test_a_run_of_a_sound_scene_has_no_warning(tmp_path):
    made = scene(bar(), output={"accounts": False})
    assert run_scene(made, tmp_path / "out", 1, [], None, overwrite=False) == 0
    assert "warning" not in (tmp_path / "out" / "log.txt").read_text()
