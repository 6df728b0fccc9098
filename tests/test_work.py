"""The work of loads, supports, gravity and damping is of second order in the step, whatever the scheme."""

import numpy as np
import pytest
from mac_cases import reader
from scipy.sparse import csr_matrix
from step_cases import stored
from test_accounts import fluid, history, scene, simulation
from test_restart import STEPS, goes_on

from petfsi.errors import SolveError
from petfsi.fields.solid.elements import State
from petfsi.registry import INTEGRATORS
from petfsi.scene.load import scene_from_dict

OMEGA, WAY, PULL = 12.0, np.array([1e-3, -4e-4]), 5.0
PERIOD = 2 * np.pi / OMEGA
STILL = {"where": "left", "fix": ["x", "y"]}


def moved(quantity):
    """Return the supports of a plate whose right side goes the way WAY sin(omega t)."""
    size, shape = (WAY, "sin") if quantity == "displacement" else (OMEGA * WAY, "cos")
    given = {axis: f"{a!r}*{shape}({OMEGA}*t)" for axis, a in zip("xy", size.tolist(), strict=True)}
    return {"supports": [STILL, {"where": "right", "fix": ["x", "y"], quantity: given}]}


#: What drives a plate that is clamped on its left.
DRIVES = {
    "displacement": moved("displacement"),
    "velocity": moved("velocity"),
    "load": {"supports": [STILL], "loads": [{"where": "top", "traction": [0.0, f"{PULL}*sin({OMEGA}*t)"]}]},
    "gravity": {"supports": [STILL]},
}
COLUMN = {"displacement": "boundary_work", "velocity": "boundary_work", "load": "load_work", "gravity": "potential"}


def plate(integrator, steps, drive, damping):
    """A plate that swings with its drive, in so many steps a period."""
    shape = {"box": {"origin": [0.0, 0.0], "size": [1.0, 0.5], "cells": [2, 1]}}
    body = {"shape": shape, "density": 30.0, "young": 800.0, "poisson": 0.3, "material": "linear", "mass": "lumped"}
    gravity = {"gravity": [0.0, f"{PULL}*sin({OMEGA}*t)"]} if drive == "gravity" else {}
    return scene(integrator, PERIOD / steps, solids={"plate": body | DRIVES[drive] | {"damping": damping}}, **gravity)


def exactly(solid, drive, damping, rate=1j * OMEGA):
    """Return the amplitude X of a motion  Im(X exp(i omega t))  under the drive, and M, C, K.

    The derivative in time makes ``rate`` of X.
    """
    pattern, rest = solid._pattern, np.zeros_like(solid.displacement)
    values = np.empty(len(pattern.indices))
    a1 = damping.get("stiffness", 0.0)
    solid._elements.assemble(State(rest, rest, rest), -damping.get("mass", 0.0), 1.0 - a1, pattern, values, rest.copy())
    K = csr_matrix((values, pattern.indices, pattern.indptr)).toarray()
    M = np.diag(solid._elements.lumped_mass(len(rest)).ravel())
    C = damping.get("mass", 0.0) * M + a1 * K
    X, held = np.zeros(rest.shape, dtype=complex), solid._equation.is_held.ravel()
    if COLUMN[drive] == "boundary_work":
        X[np.isclose(solid.reference[:, 0], 1.0)] = WAY
    f = solid._loads._dead.forces(PERIOD / 4).ravel() if drive == "load" else np.zeros(rest.size)
    if drive == "gravity":
        f = PULL * M @ np.tile([0.0, 1.0], len(rest))
    A, X = K + rate * C + rate**2 * M, X.ravel()
    X[~held] = np.linalg.solve(A[np.ix_(~held, ~held)], (f - A @ X)[~held])
    return X, M, C, K


def errors(integrator, steps, drive, damping):
    """Return the largest errors of the drive's work and of ``dissipated`` in 1.3 periods, over the first energy."""
    with simulation(plate(integrator, steps, drive, damping)) as sim:
        solid = sim.solid
        X, M, C, K = exactly(solid, drive, damping)
        V = 1j * OMEGA * X
        solid.displacement[:], solid.velocity[:] = (np.imag(Z).reshape(-1, 2) for Z in (X, V))
        sim.accounts.start()

        def held(t):
            d, v = (np.imag(Z * np.exp(1j * OMEGA * t)) for Z in (X, V))
            return (v @ M @ v + d @ K @ d) / 2

        off = []
        for _ in range(round(1.3 * steps)):
            sim.advance()
            t, got = sim.time, sim.accounts.values
            turned = (np.exp(2j * OMEGA * t) - 1) / (2j * OMEGA)
            lost = (np.real(V.conj() @ C @ V) * t - np.real(V @ C @ V * turned)) / 2
            done = -got["potential"] if drive == "gravity" else got[COLUMN[drive]]
            off.append([done - (held(t) - held(0.0) + lost), got["dissipated"] - lost])
        return np.abs(off).max(axis=0) / held(0.0)


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint", "symplectic-euler"])
def test_work_has_an_order(integrator, drive):
    error = [errors(integrator, steps, drive, {})[0] for steps in (20, 40)]
    assert np.log2(error[0] / error[1]) > (0.8 if integrator == "newmark" else 1.9), error


@pytest.mark.parametrize("drive", ["load", "gravity"])
@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_what_damping_takes_is_of_second_order(integrator, drive):
    error = [errors(integrator, steps, drive, {"mass": 0.5, "stiffness": 0.004})[1] for steps in (20, 40)]
    assert np.log2(error[0] / error[1]) > 1.85, error


# ---- statics ------------------------------------------------------------------------------------------------


def bar(integrator, steps, way, material="linear", **more):
    """A bar that its right support stretches; where the load is a force, its right side is free."""
    right = {"where": "right", "fix": ["x"], "displacement": {"x": way}}
    shape = {"box": {"origin": [0.0, 0.0], "size": [2.0, 1.0], "cells": [4, 2]}}
    body = {
        "shape": shape, "density": 1.0, "young": 1000.0, "poisson": 0.0, "material": material,
        "supports": [STILL] if "loads" in more else [STILL, right],
    }  # fmt: skip
    data = scene(integrator, 1.0 / steps, solids={"bar": body | more})
    return data | {"time": data["time"] | {"end": 1.0}}


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("steps", [1, 3, 10])
def test_a_support_that_stretches_a_bar_pays_for_what_it_stores(steps):
    got = history(bar("static", steps, "0.02828427*t"), steps)
    np.testing.assert_allclose([got["boundary_work"][-1], got["elastic"][-1]], 0.5 * 500 * 0.02828427**2, rtol=1e-12)
    assert np.abs(got["energy_residual"]).max() < 1e-14


@pytest.mark.parametrize("integrator, order", [("newmark", 0.9), ("bdf2", 1.8)])
def test_the_same_in_motion_is_of_the_order_of_the_scheme(integrator, order):
    way = "0.02*(t - sin(2*pi*t)/(2*pi))"  # begins and ends at rest
    off = [history(bar(integrator, steps, way), steps)["energy_residual"][-1] for steps in (40, 80)]
    assert np.log2(off[0] / off[1]) > order, off
    assert abs(off[1]) < 2e-3 * 0.1


def test_a_jump_in_statics_has_half_of_its_force_as_its_mean():
    got = history(bar("static", 2, 0.02), 2)
    np.testing.assert_allclose(got["boundary_work"], [0.0, 0.1, 0.1], rtol=1e-12)
    np.testing.assert_allclose(got["elastic"], [0.0, 0.1, 0.1], rtol=1e-12)
    got = history(bar("static", 2, "0.01 + 0.02*(t > 0.75)"), 2)
    np.testing.assert_allclose(got["boundary_work"], [0.0, 0.025, 0.225], rtol=1e-12)


def test_a_weight_put_on_at_once_does_twice_what_is_stored():
    """Its work is force times way, however it comes there: half is set free, and statics have no use for it."""
    pull = [{"where": "right", "traction": [5.0, 0.0]}]
    got = history(bar("static", 1, 0.0, loads=pull), 1)
    np.testing.assert_allclose(got["load_work"][-1], 2 * got["elastic"][-1], rtol=1e-12)
    np.testing.assert_allclose(got["energy_residual"][-1], -got["elastic"][-1], rtol=1e-12)
    pull[0]["traction"][0] = "5*t"
    for steps in (1, 4):
        got = history(bar("static", steps, 0.0, loads=pull), steps)
        np.testing.assert_allclose(got["load_work"], got["elastic"], rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("drive", ["way", "pressure", "traction"])
def test_large_strains_are_paid_to_second_order(drive):
    kinds = {"pressure": {"pressure": "-80*t"}, "traction": {"traction": ["100*t", "100*t"], "follower": True}}
    more = {} if drive == "way" else {"loads": [{"where": "right"} | kinds[drive]]}
    off = []
    for steps in (4, 8):
        got = history(bar("static", steps, "0.6*t", "neohookean", **more), steps)
        off.append(got["energy_residual"][-1] / got["elastic"][-1])
    assert 1.7 < np.log2(off[0] / off[1]) < 2.3, off
    assert abs(off[1]) < 0.01


# ---- what schemes lose --------------------------------------------------------------------------------------


@pytest.mark.parametrize("drive", ["displacement", "load", "gravity"])
def test_bdf2_loses_its_own_loss_under_whatever_drives_it(drive):
    """Steps of theta = omega h, of which the formula makes delta(theta) where i theta is right.

    Then M delta^2/h^2 + K has the imaginary part M Im(delta^2)/h^2, which takes energy as a damping would.
    """
    steps = 20
    theta, h = 2 * np.pi / steps, PERIOD / steps
    delta = 1.5 - 2 * np.exp(-1j * theta) + 0.5 * np.exp(-2j * theta)
    with simulation(plate("bdf2", steps, drive, {})) as sim:
        solid = sim.solid
        X, M, _, _ = exactly(solid, drive, {}, delta / h)
        now, before = (
            [np.imag(Z * turned).reshape(-1, 2) for Z in (X, delta / h * X)] for turned in (1.0, np.exp(-1j * theta))
        )
        (solid.displacement, solid.velocity), solid._past, solid._past_dt = now, tuple(before), h
        sim.accounts.start()
        rows = []
        for _ in range(2 * steps + 1):
            sim.advance()
            rows.append(sim.accounts.values)
    taken = steps / 2 * np.sin(theta) * np.imag(delta**2) / h**2 * np.real(X.conj() @ M @ X)
    for n in (0, 10, steps):
        change = rows[n + steps]["energy_residual"] - rows[n]["energy_residual"]
        np.testing.assert_allclose(change, -taken, rtol=1e-8)
    assert 0.01 < taken / rows[0]["kinetic"] < 1.0


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["bdf2", "static"])
def test_a_load_without_a_value_at_time_zero_is_that_of_the_first_step(integrator):
    pull = [{"where": "right", "traction": ["5 + 0*x/t", 0.0]}]
    got = history(bar(integrator, 10, 0.0, loads=pull), 2)
    constant = history(bar(integrator, 10, 0.0, loads=[{"where": "right", "traction": [5.0, 0.0]}]), 2)
    np.testing.assert_allclose(got["load_work"], constant["load_work"], rtol=1e-12)


def test_a_plate_that_a_load_swings_far_loses_what_one_that_swings_little_does():
    """By a quarter of its length, 40 steps a period: midpoint keeps the energy, bdf2 takes what it always does."""

    def lost(integrator, pull, material):
        body = {
            "shape": {"box": {"origin": [0.0, 0.0], "size": [1.0, 0.1], "cells": [20, 2]}}, "supports": [STILL],
            "density": 1000.0, "young": 1e6, "poisson": 0.3, "material": material,
            "loads": [{"where": "top", "traction": [0.0, f"{pull}*sin(2*t)"]}],
        }  # fmt: skip
        got = history(scene(integrator, np.pi / 40, solids={"plate": body}), 40)
        return got["energy_residual"] / np.abs(got["load_work"]).max()

    assert np.abs(lost("midpoint", 100.0, "green")).max() < 0.01
    little = lost("bdf2", 1.0, "linear")
    assert little[-1] < -0.02
    np.testing.assert_allclose(lost("bdf2", 100.0, "green"), little, atol=0.005)


# ---- in a fluid ---------------------------------------------------------------------------------------------


def paddle(steps, transfer):
    """A block that its supports push through a closed box of water, little enough that no face opens or closes."""
    push = {"where": "all", "fix": ["x", "y"], "displacement": {"x": "1e-6*t**3"}}
    body = {
        "shape": {"box": {"origin": [5 / 12, 0.25], "size": [2 / 12, 0.25], "cells": [2, 3]}},
        "density": 800.0, "young": 1e5, "poisson": 0.3, "supports": [push],
    }  # fmt: skip
    return scene("bdf2", 1 / steps, transfer, fluid=fluid((12, 12)), solids={"block": body})


def layer(steps, transfer):
    """A layer between waters that are open above and below, pressed from above."""
    rails = [{"where": side, "fix": ["x"]} for side in ("left", "right")]
    body = {
        "shape": {"box": {"origin": [0.0, 0.23], "size": [1.0, 0.2], "cells": [4, 3]}},
        "density": 800.0, "young": 1e5, "poisson": 0.3, "supports": [*rails, {"where": "bottom", "fix": ["x", "y"]}],
        "loads": [{"where": "top", "traction": [0.0, "0.1*(1 - cos(8*t))"]}],
    }  # fmt: skip
    water = fluid((4, 16), sides={"top": "open", "bottom": "open"})
    return scene("bdf2", 1 / steps, transfer, fluid=water, solids={"layer": body})


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("make", [paddle, layer])
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_what_drives_water_is_entered_to_second_order(transfer, make):
    off = []
    for steps in (10, 20):
        got = history(make(steps, transfer), steps)
        driven = np.abs(got["load_work" if make is layer else "boundary_work"]).max()
        off.append(abs(got["energy_residual"][-1]) / driven)
    assert np.log2(off[0] / off[1]) > 1.8 and off[1] < 0.01, off


# ---- state --------------------------------------------------------------------------------------------------


def everything(integrator):
    """A plate and a beam with moving supports, loads that follow, and gravity that changes, in water but in statics."""
    box = {"box": {"origin": [0.31, 0.32], "size": [0.3, 0.1], "cells": [4, 2]}}
    common = {"density": 1500.0, "young": 1e5, "poisson": 0.3}
    shaken = {"where": "left", "fix": ["x", "y"], "displacement": {"x": "0.01*sin(9*t)"}}
    loads = [{"where": "top", "pressure": "300*t", "follower": True}, {"at": [0.61, 0.42], "force": ["20*t", 3.0]}]
    blade = {"start": [0.4, 0.7], "end": [0.7, 0.7], "thickness": 0.05, "elements": 4}
    swung = {"where": "start", "fix": ["x", "y", "angle"], "displacement": {"angle": "0.3*t*t"}}
    solids = {
        "plate": common | {"shape": box, "material": "neohookean", "supports": [shaken], "loads": loads},
        "blade": common | {"shape": {"beam": blade}, "supports": [swung], "body_force": [0.0, "90*t"]},
    }
    data = scene(integrator, 0.01, gravity=["t", -0.5], solids=solids)
    return data if integrator == "static" else data | {"fluid": fluid((20, 20))}


@pytest.mark.parametrize("integrator", sorted(set(INTEGRATORS) - {"symplectic-euler"}))
def test_work_goes_on_bit_for_bit(integrator):
    data = everything(integrator)
    data["time"] |= {"dt": "(1 + 0.4*sin(20*t))/100"}
    sim = goes_on(scene_from_dict(data), "-options_file", "monolithic.opts", before=2, after=2)
    assert all(sim.accounts.values[name] for name in ("potential", "load_work", "boundary_work"))


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("integrator", ["bdf2", "static"])
def test_what_is_kept_comes_back_on_several_ranks(integrator):
    """MUMPS does not repeat itself there, so that the steps that follow cannot be held against each other."""
    with simulation(everything(integrator)) as sim, simulation(everything(integrator)) as again:
        for _ in range(2):
            sim.advance()
        kept = stored(sim)
        again.restore(sim.step, sim.time, sim.dt, lambda group: reader(kept[group]))
        back = stored(again)["accounts"]
    assert {f"{kind}_before_{name}" for kind in sim.solid.kinds for name in sim.solid.acting} <= back.keys()
    for name, values in kept["accounts"].items():
        np.testing.assert_array_equal(back[name], values, err_msg=name)


@pytest.mark.parallel([1, 2])
def test_explicit_work_goes_on_bit_for_bit():
    data = everything("symplectic-euler")
    del data["fluid"], data["solids"]["blade"]
    data["time"] |= STEPS
    sim = goes_on(scene_from_dict(data), before=2, after=2)
    assert all(sim.accounts.values[name] for name in ("potential", "load_work", "boundary_work"))


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_a_step_taken_again_in_halves_has_their_work(integrator):
    short = everything(integrator)
    short["time"]["dt"] = "0.01 - 0.005*(t > 0.005)"
    with simulation(everything(integrator)) as whole, simulation(short) as halves:
        for sim in (whole, halves, halves, halves):
            sim.advance()
        judge, failed = whole.solid.judge, []

        def fails_once(x, dt):
            if not failed:
                failed.append(dt)
                raise SolveError("not this time")
            judge(x, dt)

        whole.solid.judge = fails_once
        whole.advance()
        assert whole.substeps == 2 and whole.time == pytest.approx(halves.time)
        got, wanted = whole.accounts.values, halves.accounts.values
    for name in ("potential", "load_work", "boundary_work", "energy_residual"):
        assert got[name] == pytest.approx(wanted[name], rel=1e-7, abs=1e-9 * abs(wanted["potential"])), name
