"""Explicit steps: their limit, what becomes of steps above it, and the energy below it. About 15 s."""

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from step_cases import block, loaded, motion, prepared, stepped

from petfsi.errors import InputError, SolveError
from petfsi.fields.solid.elements import State
from petfsi.integrators.symplectic import SymplecticEuler

JOBS = Path(__file__).parents[1] / "jobs"
BODY = {"cells": (4, 3), "size": (2.0, 1.0)}
SWING = {"velocity": ["0.05*x", "0.2*x"]}


def explicit(time=None, **more):
    return block(**(BODY | more), time={"integrator": "symplectic-euler", "dt": 1e-3, "end": 1e3} | (time or {}))


def true_limit(scene):
    """Return 2 over the root of the largest eigenvalue of the free nodes' M^-1 K' at the start, by brute force."""
    with prepared(scene, comm=MPI.COMM_SELF) as sim:
        solid = sim.solid
        mass = solid._equation.lumped.mass.ravel()
        free = ~solid._equation.is_held.ravel()
        d, K = solid.displacement, []
        for e in np.eye(len(mass)) * 1e-6:
            forces = [np.empty_like(d) for _ in range(2)]
            for sign, b in zip((1, -1), forces, strict=True):
                solid._elements.forces(State(d + sign * e.reshape(d.shape), 0 * d, 0 * d), b)
            K.append((forces[1] - forces[0]).ravel() / 2e-6)
        K = np.array(K)[:, free][free]
        root = np.sqrt(mass[free])
        np.testing.assert_allclose(K, K.T, atol=1e-6 * np.abs(K).max())
        return 2 / np.sqrt(np.linalg.eigvalsh(K / np.outer(root, root))[-1])


@pytest.mark.parametrize("mass_damping, a1", [(0.0, 0.0), (0.0, 0.03), (5.0, 0.0), (5.0, 0.03)])
def test_the_stable_step_of_a_damped_mode_is_where_its_growth_begins(mass_damping, a1):
    omega2 = 400.0

    def radius(h):
        # u' = (u - h (omega2 d + a1 omega2 u)) / (1 + h a0), d' = d + h u'
        row = np.array([-h * omega2, 1 - h * a1 * omega2]) / (1 + h * mass_damping)
        return np.abs(np.linalg.eigvals([[1 + h * row[0], h * row[1]], row])).max()

    h = SymplecticEuler().stable_step(omega2, a1)
    assert radius(0.999 * h) <= 1 + 1e-12
    if mass_damping == 0:
        assert radius(1.001 * h) > 1 and h <= SymplecticEuler().stable_step(omega2, 0.0)
    assert SymplecticEuler().stable_step(0.0, a1) == np.inf and SymplecticEuler().stable_step(np.nan, a1) == 0.0


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("elements", ["linear", "quadratic"])
def test_the_limit_is_within_a_fifth_of_the_true_one(elements):
    scene = explicit(elements=elements, initial={"displacement": ["0.1*x*x", "0.1*x*y"]})
    true = true_limit(scene)
    with prepared(scene) as sim:
        assert 0.95 * true < sim.solid.stable_step() <= true


@pytest.mark.parametrize("material", ["linear", "neohookean"])
def test_a_step_above_the_limit_is_refused_at_the_start(material):
    scene = explicit(material=material, initial=SWING)
    above = explicit({"dt": 1.02 * true_limit(scene)}, material=material, initial=SWING)
    with pytest.raises(InputError, match=r"time.dt = .*stable step of symplectic-euler is .*above_limit"):
        with prepared(above):
            pass


@pytest.mark.parallel([1, 2])
def test_a_limit_that_falls_below_the_step_ends_the_run():
    """Neo-Hookean elements stiffen when they are pressed together."""
    pressed = {"velocity": ["-x", 0.0]}
    with prepared(explicit(initial=pressed)) as sim:
        limit = sim.solid.stable_step()
    with prepared(explicit({"dt": 0.97 * limit}, initial=pressed)) as sim:
        with pytest.raises(SolveError, match=r"a step of .* s: the stable step of symplectic-euler is"):
            for _ in range(60):
                sim.advance()
        assert sim.step > 0
    with prepared(explicit({"dt": 0.97 * limit, "above_limit": "subcycle"}, initial=pressed)) as sim:
        most = 0
        for _ in range(20):
            sim.advance()
            most = max(most, sim.substeps)
        assert most >= 2 and sim.solid.quality() > 0


def test_sub_steps_are_steps():
    """Bit for bit, also in the accounts."""
    one = explicit(material="linear", initial=SWING, gravity=["t", -1.0])
    h = 1.5 * true_limit(one)
    divided = stepped(explicit({"dt": h, "above_limit": "subcycle"}, material="linear", initial=SWING), 8)
    assert divided.substeps == 2
    short = stepped(explicit({"dt": h / 2}, material="linear", initial=SWING), 16)
    assert divided.time == short.time and np.array_equal(motion(divided), motion(short))
    assert divided.accounts.values == short.accounts.values


def test_a_step_of_very_many_sub_steps_is_refused_by_their_number():
    """Some 1e5 of them in one step look as if the run hung; a light solid of a fluid's scene asks for such a number."""
    limit = true_limit(explicit())
    with pytest.raises(InputError, match=r"time.dt = .*symplectic-euler is .* s at t = 0 s, .* 10,000 at most; set"):
        with prepared(explicit({"dt": 9100 * limit, "end": 1e5 * limit, "above_limit": "subcycle"})):
            pass
    with prepared(explicit({"dt": 8000 * limit, "end": 1e5 * limit, "above_limit": "subcycle"})) as sim:
        assert sim.stable.count(0.0, 8000 * limit) > 8000
        assert any("sub-steps, as the stable one asks for" in note for note in sim.notes)
        with pytest.raises(SolveError, match=r"a step of .* at t = 1 s, .* 10,000 at most; set"):
            sim.stable.count(1.0, 1e5 * limit)


@pytest.mark.parallel([1, 2])
def test_a_long_step_is_divided_anew_on_its_way():
    """The block is stretched and bent on the way, and its waves become faster: its tip swings by more than a metre."""

    def swung(dt, n):
        sets = f"time.dt={dt}", "solids.block.shape.box.cells=[8, 2]"
        with prepared(loaded(JOBS / "neohookean.toml", *sets)) as sim:
            take, lengths = sim._take, []
            sim._take = lambda begin, length, retries: (lengths.append(length), take(begin, length, retries))
            for _ in range(n):
                sim.advance()
        return motion(sim), np.array(lengths)

    (long, parts), (short, _) = swung(0.8, 1), swung(0.01, 80)
    assert len(np.unique(parts)) > 5 and np.all(np.diff(parts) <= 0) and parts.sum() == pytest.approx(0.8, rel=1e-12)
    assert np.abs(long - short).max() < 0.01 * np.abs(short).max()


def energies(scene, n, every, bypass=False):
    """Return kinetic + elastic energy over that of the start, now and then."""
    with prepared(scene) as sim:
        if bypass:
            sim.stable.limited = False
        first = sum(sim.solid.energies().values())
        seen = []
        for step in range(n):
            sim.advance()
            if step % every == 0:
                seen.append(sum(sim.solid.energies().values()) / first)
    return np.array(seen)


def near_limit(part, **more):
    """Return a scene with steps of a part of the true limit, but for the first one, which is looked at."""
    more |= {"output": {"accounts": False}, "initial": SWING}
    h = true_limit(explicit(**more))
    return explicit({"dt": f"{h}*(0.9 + {part - 0.9}*heaviside(t - 1e-9))"}, **more)


def test_the_energy_stays_bounded_just_below_the_limit_and_not_above():
    linear = {"material": "linear"}
    below = energies(near_limit(0.98, **linear), 10_000, 10)
    assert 0.2 < below.min() and below.max() < 5
    # no trend: the last thousand steps are as the first ones
    assert np.mean(below[-100:]) == pytest.approx(np.mean(below[:100]), rel=0.1)
    with pytest.raises(SolveError, match="blown up"):
        energies(near_limit(1.03, **linear), 10_000, 10, bypass=True)


@pytest.mark.slow
@pytest.mark.parametrize("material, part", [("linear", 0.98), ("neohookean", 0.9)])
def test_the_energy_stays_bounded_for_long(material, part):
    below = energies(near_limit(part, material=material), 100_000, 50)
    assert 0.2 < below.min() and below.max() < 5
    assert np.mean(below[-200:]) == pytest.approx(np.mean(below[:200]), rel=0.1)


def coupled(name, integrator, h, n, *sets):
    path = Path(__file__).parent / "scenes" / f"{name}.toml"
    return stepped(loaded(path, f"time.integrator={integrator}", f"time.dt={h}", *sets), n)


def displacement(sim):
    both = motion(sim)
    return both[: len(both) // 2]


@pytest.mark.parallel([1, 3])
def test_coupled_explicit_steps_agree_with_implicit_ones():
    """To first order, with the same mass."""
    sets = ("solids.bar.density=2000", "solids.bar.damping={}", "solids.bar.mass=lumped")
    gaps = []
    for h, n in ((1 / 480, 16), (1 / 960, 32)):
        sims = [coupled("bar2d", integrator, h, n, *sets) for integrator in ("symplectic-euler", "bdf2")]
        explicit, exact = map(displacement, sims)
        gaps.append(np.abs(explicit - exact).max() / np.abs(exact).max())
        assert sims[0].divergence() < 1e-6
    assert gaps[0] < 0.1 and np.log2(gaps[0] / gaps[1]) == pytest.approx(1.0, abs=0.3), gaps


@pytest.mark.parallel([1, 2])
def test_the_diagonal_block_survives_unknowns_of_the_fluid_that_come_and_go():
    """Cells that the sheet divides differ from step to step; A, scaled in place, is neither made nor scaled again."""
    sets = ("solids.sheet.mass=lumped", "solids.sheet.young=1e5")
    sims = {
        name: coupled("sheet", name, 2e-4, 60, *sets, "fluid.initial.velocity=['3.0', '0']")
        for name in ("symplectic-euler", "bdf2")
    }
    explicit, exact = map(displacement, sims.values())
    assert sims["symplectic-euler"].fluid.pattern_version > 3 and np.abs(exact).max() > 0.02
    assert np.abs(explicit - exact).max() < 0.1 * np.abs(exact).max()
