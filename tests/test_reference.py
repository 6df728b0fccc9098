"""``petfsi help``: what the keys of a scene mean, read off the models."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from processes import environment

from petfsi.errors import InputError
from petfsi.registry import FLUIDS, INTEGRATORS, MATERIALS
from petfsi.scene import reference
from petfsi.scene.keys import every_key
from petfsi.scene.schema import TRANSFERS

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"^```toml\n(.*?)^```", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)
SCENES = {f"README {n}": block for n, block in enumerate(BLOCKS)}
SCENES |= {
    path.stem: path.read_text()
    for folder in ("jobs", "tests/scenes")
    for path in sorted((ROOT / folder).glob("*.toml"))
}
#: README shows these in comments alone.
ASIDE = ("fluid.sides.right.pressure", "fluid.sides.right.entering", "fluid.sides.right.hydrostatic",
         "fluid.sides.left.inflow.along", "solids.layer.shape.mesh", "solids.layer.shape.cells",
         "solids.layer.shape.ball.cells", "solids.layer.supports.0.where.tag", "obstacles.post.outside")  # fmt: skip
EVERY = every_key()
TOLD = " ".join(reference.reference().split())


def named(key):
    return ".".join(key.path)


def keys_of(value, path=()):
    """Return the dotted paths of all keys in a scene, list items numbered."""
    if isinstance(value, dict):
        return [key for name, inner in value.items() for key in [(*path, name), *keys_of(inner, (*path, name))]]
    if isinstance(value, list):
        return [key for n, inner in enumerate(value) for key in keys_of(inner, (*path, str(n)))]
    return []


# ---- every key ----------------------------------------------------------------------------------------------


def test_every_key_has_a_meaning_whose_first_sentence_fits_on_a_line():
    assert not {named(key) for key in EVERY if not reference.meaning(key.field).endswith(".")}
    assert not {named(key) for key in EVERY if len(reference.brief(key.field)) > 80}


def test_what_may_be_left_out_says_what_is_so_then():
    silent = [key for key in EVERY if not key.field.is_required() and key.field.default is None]
    words = re.compile("[Ll]eft out|^One of the (shapes|loads)")
    assert silent and not {named(key) for key in silent if not words.search(reference.meaning(key.field))}


def test_every_key_is_told_once_at_the_first_place_of_its_table():
    assert not {named(key) for key in EVERY if reference.meaning(key.field) not in TOLD}
    lines = reference.reference().splitlines()
    assert max(map(len, lines)) <= reference.WIDTH
    titles = [line for line in lines if line.startswith("[")]
    assert "[solids.NAME.shape.box]" in titles and "[solids.NAME.shape.cavity]" not in titles
    assert [line for line in lines if "radius = " in line] == ["  radius = a number, greater than 0 (m); required"] * 2


@pytest.mark.parametrize("scene", SCENES)
def test_every_key_of_a_scene_can_be_looked_up(scene):
    for path in {*keys_of(tomllib.loads(SCENES[scene])), *(tuple(key.split(".")) for key in ASIDE)}:
        found = reference._standing_at(path)
        assert found and all(reference.meaning(key.field) in TOLD for key in found), path
        assert reference.explain(".".join(path)).startswith(named(found[0]) + " "), path


def test_what_a_registry_has_may_be_chosen():
    for key, names in {"integrator": INTEGRATORS, "material": MATERIALS, "transfer": TRANSFERS, "kind": FLUIDS}.items():
        assert all(f"'{name}'" in reference.explain(key) for name in names)


# ---- one key ------------------------------------------------------------------------------------------------

LEAVES = {
    "solids.layer.young": ["solids.NAME.young = a number, greater than 0 (Pa); required", "E/(1 - nu^2)"],
    "young": ["solids.NAME.young = a number"],
    "poisson": ["greater than -1 and less than 0.5; required"],
    "time.retries": ["a whole number, 0 or more and 20 or less (how often a step that fails is halved); default 3"],
    "dim": ["2 or 3; required"],
    "title": ['a text; default ""'],
    "gravity.1": ["gravity = a list of numbers or expressions (m/s^2; may depend on t); may be left out", "is none"],
    "fluid.cells": ['fluid.cells (kind = "mac") = a list of whole numbers, 1 or more; required'],
    "fluid.viscosity": ['(kind = "mac") = a number (Pa s)', '(kind = "sph") = a number, 0 or more (Pa s); default 0.0'],
    "fluid.density": ["fluid.density = a number, greater than 0 (kg/m^3); required"],
    "shape.ball.cells": ["solids.NAME.shape.ball.cells = a whole number, 2 or more and a multiple of 2"],
    "solids.a.supports.0.fix": ["supports.N.fix = a list of 'x', 'y', 'z' or 'angle', not empty"],
    "solids.a.supports.fix": ["solids.NAME.supports.N.fix = "],
    "solids.a.supports.0.velocity.x": ["supports.N.velocity = numbers or expressions by 'x', 'y', 'z' or 'angle'"],
    "solids.a.loads.3.pressure": ["presses on the body where it is positive", "against the outward normal", "left of"],
    "thickness": ["EI = E h^3/12", "For plane strain give young = E/(1 - nu^2)"],
    "probes.NAME.of": ["probes.NAME.of = a text"],
    "checkpoint.keep": ["1 or more; default 3"],
    "output.accounts": ["true or false; default true"],
}
TABLES = {
    "fluid": ["[fluid]\n", '[fluid]  (kind = "mac")', '[fluid]  (kind = "sph")', "\n  kind ", "\n  cells "],
    "fluid.sides": ["\n  left, right, bottom, top, back, front  What fluid", "back, front  What particles"],
    "[fluid.sides]": ["fluid.sides "],
    "fluid.sides.top": ["'slip', 'open', 'hydrostatic' or 'periodic', or a table", "'slip', 'no-slip', 'open' or",
                        "\n  inflow ", "\n  pressure ", "\n  hydrostatic ", "\n  no-slip "],
    "solids": ["[solids.NAME]\n  A deformable body", "\n  young       Young's modulus E."],
    "solids.x": ["[solids.NAME]\n  A deformable body"],
    "solids.x.supports": ["a list of tables", "[solids.NAME.supports.N]", "\n  fix "],
    "supports.2": ["[solids.NAME.supports.N]"],
    "where": ["2 keys end in 'where':", "solids.NAME.loads.N.where"],
    "solids.x.loads.0.where": ["loads.N.where]", "\n  box ", "\n  tag "],
    "cells": ["4 keys end in 'cells':", '  fluid.cells  (kind = "mac")   How', "\n  solids.NAME.shape.ball.cells  How"],
    "inflow": ["fluid.sides.left.inflow]", "\n  speed   ", "\n  along "],
}  # fmt: skip


@pytest.mark.parametrize("key", LEAVES | TABLES)
def test_a_key_is_explained(key, here):
    done = here("help", key)
    plain = done.stdout if key in TABLES else " ".join(done.stdout.split())
    assert (done.returncode, done.stderr) == (0, "")
    assert not [words for words in (LEAVES | TABLES)[key] if words not in plain], done.stdout


@pytest.mark.parametrize(
    "key, said",
    [
        ("fluid.vicosity", "no setting 'vicosity'; did you mean 'viscosity' (Pa s)?"),
        ("fluid.spacng", "did you mean 'fluid.spacing'?"),
        ("yung", "did you mean 'solids.NAME.young'?"),
        ("solids.a.supports.0.fixed", "did you mean 'fix'"),
        ("sides.tpo", "did you mean 'top'"),
        ("time.dt.x", "time.dt is no table"),
        ("solids.a.sides", "did you mean 'fluid.sides'?"),
        ("solids.a.gravity", "it stands at the top of the scene"),
        ("qqqqqq", "known here are title, dim, gravity"),
        ("fluid.", "no setting ''"),
        (".", "no setting '.'"),
        ("../x", "no setting '../x'"),
        ("supports.x.fix", "no setting 'x'"),
        ("\x1b[2J", "\\x1b"),
        ("x" * 5000, "..."),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_name(key, said, here):
    done = here("help", key)
    assert done.returncode == 2 and done.stdout == "" and said in done.stderr and len(done.stderr) < 400
    assert "'petfsi help' lists every key" in done.stderr and "\x1b" not in done.stderr


def test_help_of_nothing_tells_all_and_help_of_a_command_tells_of_that(here):
    assert " ".join(here("help").stdout.split()) == TOLD
    assert "Usage: petfsi run SCENE [OPTIONS]" in here("help", "run").stdout
    assert here("help", "fluid", "solids").returncode == 2


def test_help_imports_nothing_heavy():
    code = "import sys; from petfsi import cli; cli.main(['help', 'young']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=True)
    loaded = set(done.stdout.split())
    assert "petfsi.scene.reference" in loaded
    assert not loaded & {"numpy", "scipy", "numba", "petsc4py", "mpi4py", "h5py", "matplotlib", "rich"}


def test_a_key_that_nobody_explains_is_found_out(monkeypatch):
    monkeypatch.setattr(reference, "every_key", lambda: [key for key in EVERY if key.path[-1] != "young"])
    with pytest.raises(InputError, match="solids.layer.young"):
        reference.explain("solids.layer.young")
    assert "Young's modulus" not in " ".join(reference.reference().split())
