"""Options before PETSc has them: where they are from, which are refused, and what goes with a type. About 5 s."""

import os
import random

import pytest

from petfsi.errors import InputError
from petfsi.solving import options
from petfsi.solving.option_rules import fault
from petfsi.solving.options import (
    COMMAND_LINE,
    ENVIRONMENT,
    from_file,
    from_words,
    resolve,
    resolve_stored,
    shipped_options,
)

P = "fieldsplit_pressure"
PRESSURE = f"fsi_{P}_"


def values(result):
    return {name: option.value for name, option in result.chosen.items()}


def written(folder, **files):
    for name, text in files.items():
        (folder / f"{name}.opts").write_text(text, encoding="utf-8")


# ---- what is refused ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "word",
    [
        *"-fsi_pc_python_type evil.thing|-FSI_PC_Python_Type evil|-fsi_ksp_monitor_python evil|-python evil.py".split(
            "|"
        ),
        *"-dll_append evil.so|-dll_prepend evil.so|-library_preload|-on_error_attach_debugger".split("|"),
        *"-start_in_debugger|-stop_for_debugger|-debugger_nodes 1|-mpi_linear_solver_server|-on_error_emacs x".split(
            "|"
        ),
        *"-log_view :f|-log_view f|-log_view ascii:f:ascii_xml|-log_trace f|-log f|-log_all|-info f|-info /tmp/f".split(
            "|"
        ),
        *"-history|-history f|-tee f|-malloc_view f|-malloc_dump f|-malloc_dump|-options_monitor|-options_view f".split(
            "|"
        ),
        *"-fsi_ksp_view :f|-fsi_ksp_view ascii:f|-fsi_ksp_view binary:f|-fsi_ksp_view hdf5:f|-fsi_ksp_view draw".split(
            "|"
        ),
        *"-fsi_ksp_view socket:1234|-fsi_ksp_view f|-fsi_ksp_view_mat matlab:f|-fsi_ksp_monitor ascii:f".split("|"),
        *"-fsi_ksp_monitor f|-fsi_ksp_converged_reason :f|-fsi_ksp_monitor_lg_range|-fsi_pc_mg_dump_binary".split("|"),
        *"-fsi_snes_linesearch_monitor f|-fsi_pc_asm_print_subdomains f|-fsi_mat_mumps_ooc_tmpdir f".split("|"),
        *"-fsi_mat_mumps_icntl_22 1|-fsi_mat_mumps_icntl_1 77|-fsi_pc_bddc_save f|-fsi_snes_mf_noise_file f".split("|"),
        *"-mat_view :f|-vec_view binary|-viewer_binary_filename f|-viewer_socket_machine h|-draw_save".split("|"),
        *"-prefix_push fsi_|-prefix_pop|-options_string_yaml x|-options_file_yaml f|-skip_petscrc 0|-alias x".split(
            "|"
        ),
    ],
)
def test_what_runs_code_or_names_a_file_is_refused(word):
    with pytest.raises(InputError) as told:
        resolve(word.split(), {})
    assert word.split()[0].lower() in str(told.value) and len(str(told.value).splitlines()) == 1
    with pytest.raises(InputError, match="PETSC_OPTIONS: "):
        resolve([], {ENVIRONMENT: word})


@pytest.mark.parametrize("word", ["", "::ascii_info_detail", "ascii", "ascii::ascii_info"])
def test_what_speaks_to_the_screen_is_not(word):
    names = "log_view fsi_ksp_view fsi_ksp_converged_reason fsi_fieldsplit_solid_ksp_view_mat".split()
    assert not any(fault(name, word) for name in names)
    # in other formats than its own PETSc has no monitor, and calls it all the same
    assert bool(fault("fsi_ksp_monitor", word)) == ("::" in word)
    assert not fault("info", ":ksp,pc") and not fault("fsi_ksp_monitor_pause_final", "1")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("ksp_rtol", "-1", "is out of range; wanted a number from 0 to 0.999"),
        ("ksp_rtol", "nan", "no numeric value"),
        ("ksp_atol", "-1e-3", "out of range; wanted a number of at least 0"),
        ("ksp_max_it", "1e3", "no integer value"),
        ("ksp_max_it", "99999999999999999999", "out of range"),
        ("ksp_max_it", "", "wants a value behind it"),
        ("pc_type", "", "wants a value behind it"),
        ("ksp_richardson_scale", "inf", "a number that is one, and finite"),
        ("ksp_chebyshev_eigenvalues", "0.4,1e999", "too large"),
        ("pc_factor_levels", "100000", "out of range"),
        ("pc_mg_levels", "0", "is out of range; wanted a whole number from 1 to 100"),
        # PETSc makes them all, deaf to signals: 23 GB, and no end
        ("pc_asm_blocks", "1000000", "is out of range; wanted a whole number from 1 to 10000"),
        ("fieldsplit_solid_pc_gasm_total_subdomains", "10001", "wanted a whole number from 1 to 10000"),
        ("pc_hypre_boomeramg_grid_sweeps_all", "1000000000", "wanted a whole number from 0 to 1000"),
        ("pc_mg_multiplicative_cycles", "1e9", "has no integer value; wanted a whole number from 0 to 1000"),
        ("pc_gamg_agg_nsmooths", "101", "wanted a whole number from 0 to 100"),
        ("fieldsplit_pressure_pc_factor_mat_solver_type", "SuperLU", "can end the process"),
        ("ksp_bcgsl_ell", "100000000", "out of range; wanted a whole number from 1 to 100"),
        ("ksp_fischer_guess", "1,100000000", "out of range"),
        ("pc_factor_shift_amount", "a b", "blanks, quotes, paths"),
        ("pc_type", "l\x00u", "blanks, quotes, paths"),
        ("pc_type", "/etc/passwd", "blanks, quotes, paths"),
        ("pc_type", "x" * 5000, "has 5,000 characters; at most 200"),
    ],
    ids=lambda text: text[:40],
)
def test_a_value_out_of_range_is_told_with_the_range(name, value, said):
    assert said in fault(f"fsi_{name}", value)
    assert not fault("fsi_pc_hypre_boomeramg_relax_type_coarse", "symmetric-SOR/Jacobi")
    assert not fault("fsi_pc_factor_levels", "0") and not fault("fsi_pc_factor_mat_solver_type", "superlu_dist")


def test_every_shipped_file_passes():
    for path in shipped_options():
        assert resolve(["-options_file", path.name], {}).chosen and not resolve(["-options_file", str(path)], {}).given


# ---- files --------------------------------------------------------------------------------------------------


def test_files_with_any_name_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a b.opts", "a#b.opts", "dürre 'x'.opts", "#.opts", "-x.opts"):
        (tmp_path / name).write_text("# one\n-fsi_ksp_rtol 1e-4 # two\n\n-FSI_KSP_Type 'cg'\n")
        read = from_file(name)
        assert [(o.name, o.value, o.line) for o in read] == [("fsi_ksp_rtol", "1e-4", 2), ("fsi_ksp_type", "cg", 4)]
    written(tmp_path, outer='-options_file "a b.opts"\n-options_file split.opts\n-fsi_ksp_max_it 3\n')
    chosen = resolve(["-options_file", "outer.opts"], {}).chosen
    assert [chosen[f"fsi_ksp_{name}"].origin for name in ("rtol", "max_it", "initial_guess_nonzero")] == [
        "a b.opts", "outer.opts", "split.opts",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("-options_file me.opts", "me.opts, line 1: -options_file me.opts: the file names itself"),
        (
            "-fsi_ksp_rtol 1\n-options_file other.opts",
            "other.opts, line 1: -options_file ./me.opts: the file names itself",
        ),
        ("-fsi_ksp_type cg gmres", "line 1: 'gmres' is no option"),
        ("fsi_ksp_type cg", "line 1: 'fsi_ksp_type cg' is no option"),
        ("-fsi_ksp_type cg\n-options_file", "line 2: -options_file: wants the name of a file"),
        ("-options_file /dev/zero", "is no file, but a device or pipe"),
        ("-options_file " + "x" * 5000, "cannot be read"),
        ("-options_file a\0b", "options_file a\\x00b: no such file"),
        ("-fsi_ksp_rtol 1e-4\n" * 2000, "2,000 options are given"),
        ("#" * 2_000_000, "larger than 1,000,000 bytes"),
    ],
    ids=lambda text: text[:40],
)
def test_a_file_that_is_none_is_refused(text, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, me=text, other="-options_file ./me.opts\n")
    with pytest.raises(InputError) as told:
        resolve(["-options_file", "me.opts"], {})
    assert said in str(told.value) and len(str(told.value)) < 600


# ---- who wins -----------------------------------------------------------------------------------------------


def test_each_layer_lies_over_the_one_before(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, mine="-options_file monolithic.opts\n-fsi_ksp_divtol 7e7\n")
    environment = {ENVIRONMENT: "-fsi_ksp_rtol 1e-4 -fsi_ksp_max_it 44 -fsi_ksp_divtol 5e5"}
    result = resolve(["-fsi_ksp_max_it", "55", "-options_file", "mine.opts"], environment)
    found = {name: (result.chosen[f"fsi_ksp_{name}"].value, result.chosen[f"fsi_ksp_{name}"].origin) for name in
             ("type", "rtol", "divtol", "max_it")}  # fmt: skip
    assert found == {
        "type": ("gcr", "monolithic.opts"),
        "rtol": ("1e-4", ENVIRONMENT),
        "divtol": ("7e7", "mine.opts"),
        "max_it": ("55", COMMAND_LINE),
    }
    assert "-fsi_ksp_rtol 1e-4  # PETSC_OPTIONS\n" in result.dump()
    notes = "\n".join(result.notes)
    assert "option -fsi_ksp_rtol 1e-4 (PETSC_OPTIONS), not 1e-9 (monolithic.opts)" in notes
    assert "option -fsi_ksp_max_it 55 (command line), not 44 (PETSC_OPTIONS)" in notes


def test_a_run_goes_on_with_what_it_began_with(tmp_path):
    environment = {ENVIRONMENT: "-fsi_ksp_rtol 1e-4 -fsi_ksp_max_it 44"}
    first = resolve(["-fsi_ksp_max_it", "55"], environment)
    path = tmp_path / "options.opts"
    path.write_text(first.dump())
    again = resolve_stored(["-fsi_ksp_divtol", "8"], environment, path, lambda *_: True)
    assert values(again) == values(first) | {"fsi_ksp_divtol": "8"}
    assert {n: o.origin for n, o in again.chosen.items()} == {n: o.origin for n, o in first.chosen.items()} | {
        "fsi_ksp_divtol": COMMAND_LINE
    }
    assert any("-fsi_ksp_max_it 44 is not read" in note for note in again.notes)
    assert {n for n, o in again.chosen.items() if not o.shipped} == {
        f"fsi_ksp_{n}" for n in ("rtol", "max_it", "divtol")
    }


def test_a_line_changed_by_hand_is_the_users(tmp_path):
    path = tmp_path / "options.opts"
    path.write_text(resolve([], {}).dump().replace("-fsi_ksp_max_it 30", "-fsi_ksp_maxit 60") + "-fsi_ksp_view\n")
    changed = resolve_stored([], {}, path, lambda *_: True).chosen
    assert (
        not changed["fsi_ksp_maxit"].shipped and not changed["fsi_ksp_view"].shipped and changed["fsi_ksp_rtol"].shipped
    )


# ---- what goes with a type ----------------------------------------------------------------------------------


HANGING = {
    "-fsi_pc_type lu": (f"pc_fieldsplit_type {P}_ksp_rtol {P}_mg_levels_pc_type", "ksp_rtol"),
    "-fsi_ksp_type preonly": ("ksp_rtol ksp_initial_guess_nonzero", f"pc_type {P}_ksp_type"),
    "-fsi_ksp_type fgmres": ("", "ksp_rtol ksp_max_it ksp_initial_guess_nonzero"),
    "-fsi_pc_fieldsplit_type additive": ("pc_fieldsplit_schur_fact_type", f"{P}_pc_type"),
    f"-fsi_{P}_ksp_type preonly": (f"{P}_ksp_norm_type", f"{P}_pc_type {P}_mg_levels_ksp_type"),
    f"-fsi_{P}_mg_levels_ksp_type cg": (f"{P}_mg_levels_ksp_chebyshev_eigenvalues", f"{P}_mg_levels_ksp_max_it"),
    f"-fsi_{P}_pc_type mg": ("", f"{P}_mg_levels_pc_type"),
    "-options_file monolithic-direct.opts -fsi_pc_factor_mat_solver_type petsc": ("mat_mumps_icntl_24", "pc_type"),
    "-options_file split.opts -fsi_ksp_type gmres": ("ksp_convergence_test ksp_max_it ksp_norm_type", "pc_type"),
}


@pytest.mark.parametrize("words", HANGING)
@pytest.mark.parametrize("environment", [False, True])
def test_a_type_takes_what_hung_on_the_one_before_it(words, environment):
    gone, kept = ([f"fsi_{name}" for name in names.split()] for names in HANGING[words])
    *files, name, value = words.split()
    result = resolve(files, {ENVIRONMENT: f"{name} {value}"}) if environment else resolve(words.split(), {})
    before = resolve(files, {}).chosen
    assert {*gone, *kept} <= {*before} and {*kept} <= {*result.chosen} and not {*gone} & {*result.chosen}
    note = next(note for note in result.notes if name in note)
    assert ("gone with it" in note) == bool(gone)


def test_what_is_given_beside_a_type_stays():
    words = f"-fsi_ksp_rtol 1e-3 -fsi_ksp_type preonly -fsi_pc_type lu -{PRESSURE}ksp_rtol 1e-2"
    assert values(resolve(words.split(), {}))["fsi_ksp_rtol"] == "1e-3"
    assert values(resolve(words.split(), {}))[f"{PRESSURE}ksp_rtol"] == "1e-2"


# ---- anything -----------------------------------------------------------------------------------------------


def test_whatever_is_given_is_taken_or_refused_on_a_screen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draw = random.Random(5)
    known = [option for path in shipped_options() for option in from_file(str(path))]
    names = [o.name for o in known] + "log_view history options_file prefix_push fsi_pc_python_type x".split()
    told = [o.value for o in known] + [
        "",
        "nan",
        "1e999",
        "-1",
        "9" * 400,
        "x" * 3000,
        ":f",
        "a b",
        '"',
        "'",
        "#",
        "ä",
        "\0",
    ]
    signs = "-_ #\"'\\$%:/\t\n\x00\x1b\u2028ä日" + "abc019"
    for _ in range(150):
        words = []
        for _ in range(draw.randint(1, 12)):
            word = draw.choice(names) if draw.random() < 0.9 else ""
            for _ in range(draw.choice([0, 0, 0, 1, 4])):
                at = draw.randint(0, len(word))
                word = word[:at] + draw.choice(signs) + word[at + draw.randint(0, 1) :]
            words += [f"-{word}", draw.choice(told)]
        text = " ".join(words)
        written(tmp_path, x=text.replace(" -", "\n-"))
        for given, environment in ((words, ""), (["-options_file", "x.opts"], ""), ([], text.replace("\0", ""))):
            try:
                result = resolve(given, {ENVIRONMENT: environment})
            except InputError as error:
                assert len(str(error)) < 2400 and str(error).isprintable() or "\n" in str(error), str(error)
                assert sum(1 + len(line) // 120 for line in str(error).splitlines()) <= 24, str(error)
            else:
                assert not any(fault(o.name, o.value) for o in result.chosen.values())
    assert os.listdir() == ["x.opts"]


def test_words_begin_with_a_dash_and_a_letter():
    assert [options.is_option(w) for w in ("-a", "--a", "-1", "-.5", "-inf", "-NaN", "-info", "a", "", "-")] == [
        True, True, False, False, False, False, True, False, False, False,
    ]  # fmt: skip
    assert [(o.name, o.value) for o in from_words(["-a", "-1e3", "-b", "-c", "d"])] == [
        ("a", "-1e3"),
        ("b", ""),
        ("c", "d"),
    ]
