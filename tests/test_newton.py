"""Newton's method around the linear solve, statics, and steps that fail and are taken again. About 20 s."""

import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from processes import environment
from step_cases import SWING, block, loaded, motion, prepared, stepped

from petfsi.errors import InputError, SolveError
from petfsi.integrators.base import integrator as scheme
from petfsi.output.history import read_history

SCENES = Path(__file__).parent / "scenes"
BAR = SCENES / "bar2d.toml"
PETFSI = Path(sys.executable).with_name("petfsi")
NEWTON = ("-fsi_snes_type", "newtonls")
DIRECT = ("-options_file", "monolithic-direct.opts")


def swing(integrator, n, *options):
    scene = block(time={"dt": 1.0 / n, "integrator": integrator}, initial=SWING, mass="lumped")
    return motion(stepped(scene, n, *options))


@pytest.fixture(scope="module")
def exact():
    """Return the swing's end; its own error is some hundredth of those measured against it."""
    return swing("midpoint", 1000)


@pytest.mark.parametrize("options", [(), NEWTON], ids=["ksponly", "newtonls"])
@pytest.mark.parametrize(
    "integrator, n", [("newmark", 320), ("bdf2", 100), ("midpoint", 50), ("symplectic-euler", 160)]
)
def test_every_integrator_keeps_its_order_on_a_nonlinear_swing(integrator, n, options, exact):
    errors = [np.linalg.norm(swing(integrator, m, *options) - exact) for m in (n, 2 * n)]
    assert np.linalg.norm(exact) > 3 * errors[0] > 0.01
    assert np.log2(errors[0] / errors[1]) == pytest.approx(scheme(integrator).order, abs=0.1), errors


def energies(material, dt, n, *options):
    """Return kinetic + elastic energy of a block that swings by midpoint, over that of the start, after each step."""
    time = {"dt": dt, "integrator": "midpoint", "end": 1e4}
    scene = block(time=time, initial=SWING, mass="lumped", material=material, output={"accounts": False})
    with prepared(scene, *options) as sim:
        first, seen = sum(sim.solid.energies().values()), []
        for _ in range(n):
            sim.advance()
            seen.append(sum(sim.solid.energies().values()) / first)
    return np.array(seen)


def test_the_energy_of_a_nonlinear_swing_stays_where_newton_iterates():
    """Some 30 steps a period; it swings by the error of second order and has no trend."""
    seen = energies("neohookean", 0.05, 1000, *NEWTON)
    assert np.abs(seen - 1).max() < 0.02 and abs(seen[-200:].mean() - seen[:200].mean()) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "material, dt, options, swing",
    [("neohookean", 0.05, NEWTON, 0.02), ("green", 0.05, NEWTON, 0.04)]
    + [("neohookean", 0.025, (), 0.01), ("green", 0.025, (), 0.01)],
)
def test_the_energy_of_a_nonlinear_swing_stays_for_long(material, dt, options, swing):
    """Linearised once a step it drifts: at 0.05 s by 11 % and 33 %."""
    seen = energies(material, dt, 10_000, *options)
    assert np.abs(seen - 1).max() < swing and abs(seen[-500:].mean() - seen[:500].mean()) < 0.01


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
def test_one_iteration_is_the_linearised_step(integrator):
    scene = block((3, 2), time={"integrator": integrator, "dt": 0.05}, initial=SWING)
    one = stepped(scene, 4, *NEWTON, "-fsi_snes_rtol", "0.99")
    assert one.outcome.newton == 1
    np.testing.assert_allclose(motion(one), motion(stepped(scene, 4)), atol=1e-12)


def petfsi(*words):
    return subprocess.run(
        [str(PETFSI), *map(str, words)], capture_output=True, text=True, timeout=120, env=environment()
    )


def test_the_monitor_shows_quadratic_convergence(tmp_path):
    """Of statics under a large load."""
    square = "solids.strip.shape.box={origin=[0, 0], size=[1.0, 1.0], cells=[8, 8]}"
    sets = [square, "time.integrator=static", "solids.strip.material=neohookean", "gravity=[0, -300]"]
    words = [word for text in sets for word in ("--set", text)]
    done = petfsi("run", SCENES / "beam.toml", "--out", tmp_path / "run", "--steps", 1, *words,
                  "-fsi_snes_monitor", "-fsi_snes_linesearch_type", "basic")  # fmt: skip
    assert done.returncode == 0, done.stderr
    norms = np.array([float(n) for n in re.findall(r"SNES Function norm (\S+)", done.stdout)])
    history = read_history(tmp_path / "run" / "history.csv")
    assert history["newton"].tolist() == [0, len(norms) - 1] and abs(history["tip.y"][1]) > 0.3
    # before round-off, and where the method has found the valley
    fast = norms[(norms < 1e-1 * norms[0]) & (norms > 1e-9 * norms[0])]
    assert len(fast) >= 3 and norms[-1] < 1e-12 * norms[0]
    steps = np.diff(np.log(fast))
    assert (steps[1:] / steps[:-1]).max() > 1.5
    assert norms[-2] / norms[0] < (norms[-3] / norms[0]) ** 1.5


@pytest.mark.parallel([1, 2, 3])
def test_every_solver_and_rank_finds_the_same_coupled_solution():
    scene = loaded(BAR, "time.integrator=bdf2", "solids.bar.density=2000", "solids.bar.young=3e5")
    sims = {
        name: stepped(scene, 4, "-options_file", f"{name}.opts", *NEWTON)
        for name in ("monolithic-direct", "monolithic", "split-iterated")
    }
    want = motion(sims["monolithic-direct"])
    for sim in sims.values():
        assert sim.outcome.newton >= 2 and sim.divergence() < 1e-9
        np.testing.assert_allclose(motion(sim), want, atol=1e-9 * np.abs(want).max())
    once = motion(stepped(scene, 4, *DIRECT))
    # what a linearisation about a second-order guess leaves out
    assert 1e-9 < np.abs(once - want).max() / np.abs(want).max() < 1e-2


def test_a_step_that_newton_cannot_take_says_why():
    with prepared(block(time={"integrator": "static", "dt": 1.0, "retries": 1}, gravity=[0.0, -1e4]), *NEWTON) as sim:
        told = []
        sim.report = told.append
        with pytest.raises(SolveError, match=r"solver 'fsi_snes_' stopped with DIVERGED_\w+ after .*by field: solid"):
            sim.advance()
        assert len(told) == 1 and "step of 1 s is taken again as two halves" in told[0]


@pytest.mark.parametrize(
    "options, said",
    [
        (("-fsi_snes_type", "newtontr"), "must be ksponly or newtonls"),
        (("-fsi_snes_monitor",), "it needs -fsi_snes_type newtonls"),
        ((*NEWTON, "-fsi_snes_rtoll", "1e-3"), "did you mean -fsi_snes_rtol"),
    ],
)
def test_wrong_options_are_refused(options, said):
    with pytest.raises(InputError, match=said), prepared(block(), *options):
        pass


def test_a_split_step_cannot_carry_newton():
    with pytest.raises(InputError, match=r"try split-iterated.opts"):
        with prepared(loaded(BAR), "-options_file", "split.opts", *NEWTON):
            pass


# ---- statics ------------------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("options", [(), ("-fsi_snes_type", "ksponly")], ids=["newtonls", "ksponly"])
def test_linear_statics_assemble_and_factor_once(options):
    scene = block((4, 3), material="linear", gravity=["t", "-2*t"], time={"integrator": "static", "dt": 0.2})
    with prepared(scene, *options) as sim:
        set_up, count = sim.solver.linear.set_up, []
        sim.solver.linear.set_up = lambda: (count.append(1), set_up())
        displacements = []
        for _ in range(5):
            sim.advance()
            displacements.append(motion(sim)[: -len(motion(sim)) // 2])
    assert sim.solid.n_assembled == 1 and not count
    for n, displacement in enumerate(displacements, start=1):
        np.testing.assert_allclose(displacement, n * displacements[0], atol=1e-13)
    assert sim.accounts.values["kinetic"] == 0.0


@pytest.mark.parallel([1, 3])
def test_load_steps_do_not_matter_to_equilibrium():
    """Nor the line search; at rest the residual is round-off, and nothing is done."""
    scene = block((6, 6), gravity=[0.0, "-0.5*min(t, 1)"], time={"integrator": "static", "dt": 0.25, "end": 2.0})
    four = stepped(scene, 4)
    long = block((6, 6), gravity=[0.0, "-0.5*min(t, 1)"], time={"integrator": "static", "dt": 1.0})
    one = stepped(long, 1, "-fsi_snes_linesearch_type", "basic")
    np.testing.assert_allclose(motion(one), motion(four), atol=1e-8)
    assert np.abs(motion(one)).max() > 0.02
    held = stepped(scene, 6)
    assert held.outcome.newton <= 1 and held.outcome.residual < 1e-10
    np.testing.assert_allclose(motion(held), motion(four), atol=1e-9)


# ---- steps taken again --------------------------------------------------------------------------------------


@contextmanager
def failing(sim, numbers):
    """Let the solves of these numbers fail when they are done.

    Only inside: a solver that held itself would be freed when Python finds the time, on another rank at another one.
    """
    solve, count = sim.solver.solve, [0]

    def solve_or_fail(*arguments):
        count[0] += 1
        outcome = solve(*arguments)
        if count[0] in numbers:
            raise SolveError("made up")
        return outcome

    sim.solver.solve = solve_or_fail
    yield
    del sim.solver.solve


def run(name, dt, n, fails=(), *sets):
    with prepared(loaded(SCENES / name, f"time.dt='{dt}'", *sets), *DIRECT) as sim:
        substeps = []
        with failing(sim, fails):
            for _ in range(n):
                sim.advance()
                substeps.append(sim.substeps)
    return sim, substeps


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint"])
@pytest.mark.parametrize("name, transfer", [("bar2d", "cutcell"), ("bar2d", "ray"), ("sheet", "cutcell"),
                                            ("tank", "cutcell"), ("beam", "cutcell")])  # fmt: skip
def test_a_step_taken_again_leaves_no_trace(name, transfer, integrator):
    """Bit for bit as if the scene had asked for the shorter steps; on ranks, where MUMPS sums in no order, alike."""
    h = 1 / 32 if name in ("bar2d", "tank") else 1 / 128
    sets = (f"time.integrator={integrator}", f"coupling.transfer={transfer}")
    again, substeps = run(f"{name}.toml", f"{h}", 4, (3, 5), *sets)
    assert substeps == [1, 1, 3, 1]
    # of the third step the first half is taken, and the second one in halves
    asked, _ = run(f"{name}.toml", f"{h} - {h / 2}*heaviside(t - {1.5 * h}) - {h / 4}*heaviside(t - {2.25 * h})"
                   f" + {0.75 * h}*heaviside(t - {2.875 * h})", 6, (), *sets)  # fmt: skip
    assert again.time == asked.time
    for field, arrays in asked.state().items():
        # the clock of equal steps is not that of steps that an expression gives
        for key, slab in arrays.items() if field != "clock" else ():
            other = again.state()[field][key].data
            # what is nought but for round-off, as the sideways part of an upright wall, has no size of its own; in the
            # books it is left of momenta as large as the others
            alike = arrays.values() if field == "accounts" else [slab]
            largest = max(np.abs(part.data).max(initial=0.0) for part in alike)
            size = asked.comm.allreduce(largest, op=MPI.MAX)
            slack = 0.0 if asked.comm.size == 1 else 1e-9 * size + 1e-15
            np.testing.assert_allclose(other, slab.data, rtol=0, atol=slack, err_msg=f"{field} {key}")


def test_a_step_is_halved_no_more_often_than_the_scene_says():
    with prepared(block(time={"retries": 2, "dt": 0.125}, initial=SWING)) as sim:
        told = []
        sim.report = told.append
        with failing(sim, range(3, 100)):
            sim.advance()
            sim.advance()
            with pytest.raises(SolveError, match="made up"):
                sim.advance()
    assert [re.search(r"step of (\S+) s", line)[1] for line in told] == ["0.125", "0.0625"]
