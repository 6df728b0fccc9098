"""A material, an integrator, a kind of fluid and a coupling are each a file and a line of the registry."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import environment

from petfsi.output.history import read_history

#: One file for three of them; each could stand in its own.
MINE = """
import numpy as np
from petfsi.couplings.cutcell import CutCellCoupling
from petfsi.fields.solid.materials.linear import linear
from petfsi.integrators.base import Integrator, Motion, Stage

def twice_as_stiff(H, lame, mu, tangent=True):
    return linear(H, 2 * lame, 2 * mu, tangent)


class BackwardEuler(Integrator):
    order = 1

    def factor(self, h, past_dt):
        return h

    def stage(self, motion, h):
        d = motion.displacement
        return Stage(a=1 / h, k=h, inertia=motion.velocity / h, tangent_at=d, shift=np.zeros_like(d))

    def finish(self, motion, stage, w, h):
        return Motion(motion.displacement + h * w, w, (), h)


class Mine(CutCellCoupling):
    pass
"""
#: The table is read with every scene; what computes is imported when a scene is of that kind.
POND = """
from petfsi.scene.fluids import MacFluid


class Pond(MacFluid):
    form = "<pond>"


def pond(comm, scene):
    from petfsi.fields.mac import fluid

    class PondField(fluid.MacFluid):
        def remark(self):
            return "the pond is calm"

    return PondField(comm, scene)


def plan(scene):
    from petfsi.runs.plan_fluids import grid_plan

    return grid_plan(scene)


def skipped(scene):
    return ["waves: it is a pond"]
"""
LINES = {
    "material": 'registry.MATERIALS["twice"] = "mine:twice_as_stiff"',
    "integrator": 'registry.INTEGRATORS["backward-euler"] = "mine:BackwardEuler"',
    "fluid": 'registry.FLUIDS["pond"] = registry.FluidKind("pond:pond", "pond:Pond", "pond:plan", "pond:skipped")',
    "coupling": 'registry.COUPLINGS["mac"]["mine"] = "mine:Mine"',
}
BODY = """
[solids.b]
shape = { box = { origin = [0.3, 0], size = [0.4, 0.3], cells = [4, 3] } }
density = 800.0
young = 1e5
poisson = 0.3
material = "linear"
supports = [{ where = "bottom", fix = ["x", "y"] }]
loads = [{ where = "top", traction = [100.0, 0.0] }]
[probes.tip]
of = "b"
at = [0.7, 0.3]
quantity = "displacement"
"""
WATER = """
[fluid]
density = 1000.0
origin = [0, 0]
size = [1, 1]
cells = [8, 8]
initial = { velocity = ["0.1*sin(pi*x)*cos(pi*y)", "-0.1*cos(pi*x)*sin(pi*y)"] }
"""
TIME = 'dim = 2\n[time]\nend = 0.05\ndt = 0.01\nintegrator = "bdf2"\n'
#: By what is added: the scene, how it names it, and a scene of what petfsi has that does the same.
SCENES = {
    "material": (TIME + BODY, ["solids.b.material=twice"], ["solids.b.young=2e5"]),
    "integrator": (TIME + BODY, ["time.integrator=backward-euler"], ["time.integrator=bdf2", "time.end=0.01"]),
    "fluid": (TIME + WATER, ["fluid.kind=pond"], []),
    "coupling": (TIME + BODY + WATER, ["coupling.transfer=mine"], ["coupling.transfer=cutcell"]),
}


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """Run every scene with what is added, in one process that knows of it from its start."""
    home = tmp_path_factory.mktemp("mine")
    (home / "mine.py").write_text(MINE)
    (home / "pond.py").write_text(POND)
    run = ["from petfsi import registry", *LINES.values(), "from petfsi import cli", "codes = []"]
    for name, (scene, sets, _) in SCENES.items():
        (home / f"{name}.toml").write_text(scene)
        words = ["run", f"{name}.toml", "--out", name, *(word for one in sets for word in ("--set", one))]
        run.append(f"codes.append(cli.main({words!r}))")
    code = "; ".join([*run, "raise SystemExit(max(codes))"])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=home, capture_output=True, text=True, env=environment(), timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return home


@pytest.mark.parametrize("name", SCENES)
def test_one_file_and_one_line_are_enough(mine, here, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    scene, _, sets = SCENES[name]
    Path("scene.toml").write_text(scene)
    done = here("run", "scene.toml", "--out", "out", *(word for one in sets for word in ("--set", one)))
    assert done.returncode == 0, done.stderr
    added, known = read_history(mine / name / "history.csv"), read_history(Path("out/history.csv"))
    compared = [column for column in known if column.startswith(("tip", "kinetic", "momentum"))]
    assert len(compared) > 1
    for column in compared:  # the first step of BDF2 is backward Euler's
        np.testing.assert_allclose(added[column][: len(known["step"])], known[column], rtol=1e-9, atol=1e-12)
    said = (mine / name / "log.txt").read_text()
    assert ("the pond is calm" in said) == (name == "fluid")
