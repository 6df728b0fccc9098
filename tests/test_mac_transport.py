"""The fluid's time schemes on flows with exact solutions: order in time and space, and forces at their instant."""

import numpy as np
import pytest
from mac_cases import PERIODIC, crossings, make_fluid, set_velocity, solid_box, step, whole, whole_state
from mpi4py import MPI

SECOND = ["bdf2", "midpoint"]
END = 0.25


def vortices(drift):
    """Taylor's and Green's vortices on a uniform flow; an exact solution of Euler's equations, by axis as text."""
    x, y = (f"2*pi*({axis} - {speed}*t)" for axis, speed in zip("xy", drift, strict=True))
    return [f"{drift[0]} + sin({x})*cos({y})", f"{drift[1]} - cos({x})*sin({y})"]


def lengths(n, uneven):
    """Return n steps to END; uneven ones alternate in the ratio 5 to 3."""
    h = 1.0 + uneven * 0.25 * (-1.0) ** np.arange(n)
    return END * h / h.sum()


def vortex_error(integrator, n, steps, drift=(1.0, 0.5), uneven=False, comm=MPI.COMM_SELF, **fluid):
    """Return the root mean square error of the velocity at END."""
    start = [text.replace("*t)", "*0)") for text in vortices(drift)]
    fluid = make_fluid(
        (n, n), comm, sides=PERIODIC, integrator=integrator, initial={"velocity": start}, density=1.0, **fluid
    )
    t = 0.0
    for h in lengths(steps, uneven):
        step(fluid, t, h)
        t += h
    squares = 0.0
    for axis, text in enumerate(vortices(drift)):
        x, y, _ = fluid.grid.coordinates(axis)
        names = {"x": x, "y": y, "t": END, "pi": np.pi, "sin": np.sin, "cos": np.cos}
        own = fluid.grid.owned(axis)
        squares += np.sum((fluid.velocity[axis] - eval(text, names))[own] ** 2)
    return np.sqrt(comm.allreduce(squares) / n**2)


@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize("integrator", SECOND)
def test_drifting_vortices_converge_with_order_two_in_time(integrator, uneven):
    errors = [vortex_error(integrator, 96, steps, uneven=uneven) for steps in (12, 48)]
    assert np.log(errors[0] / errors[1]) / np.log(4) == pytest.approx(2.0, abs=0.1), errors
    assert errors[0] < 0.02


def test_newmark_keeps_order_one():
    errors = [vortex_error("newmark", 48, steps) for steps in (24, 48)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.1), errors


@pytest.mark.parametrize("drift", [(0.0, 0.0), (1.0, 0.5)], ids=["standing", "drifting"])
@pytest.mark.parametrize("integrator", SECOND)
def test_vortices_converge_with_more_than_order_two_in_space(integrator, drift):
    errors = [vortex_error(integrator, n, 80, drift) for n in (8, 16, 32)]
    assert np.diff(-np.log2(errors)).min() > 2.5, errors
    assert errors[-1] < 2e-3


def test_linear_interpolation_is_of_order_one():
    coarse, fine, cubic = (
        vortex_error("bdf2", n, n, advection=a) for n, a in ((32, "linear"), (64, "linear"), (64, "cubic"))
    )
    assert np.log2(coarse / fine) == pytest.approx(1.0, abs=0.2)
    assert cubic < 0.1 * fine


@pytest.mark.parametrize("integrator", ["newmark", "bdf2", "midpoint", "symplectic-euler"])
def test_uniform_flow_feels_a_force_at_its_instant(integrator):
    """v' = t; each scheme's error is known in closed form."""
    fluid = make_fluid((8, 8), gravity=["t", 0.0], sides=PERIODIC, integrator=integrator)
    h, n = 0.1, 7
    for number in range(n):
        step(fluid, number * h, h)
    t = n * h
    # at the end of a step midpoint's velocity is on the line through means of t^2/2 over the ends of steps
    first = t**2 / 2 + t * h / 2
    wanted = {"newmark": first, "symplectic-euler": first, "midpoint": t**2 / 2 - h**2 / 4}
    # the recurrence 3 e_{n+1} = 4 e_n - e_{n-1} of the error from e_0 = 0, e_1 = h^2/2
    wanted["bdf2"] = t**2 / 2 + h**2 / 2 * 1.5 * (1 - 3.0**-n)
    own = fluid.grid.owned(0)
    np.testing.assert_allclose(fluid.velocity[0][own], wanted[integrator], rtol=1e-12)
    assert np.abs(fluid.velocity[1]).max() < 1e-13


@pytest.mark.parametrize("integrator", SECOND)
def test_a_jet_and_its_smoke_follow_time_to_second_order(integrator):
    """Plug flow at the speed 1 + t through a channel carries an edge of smoke by t + t^2/2."""
    jet = {"left": {"inflow": {"speed": "1 + t", "smoke": 0.0}}, "right": "open"}
    fluid = make_fluid(
        (80, 6), size=[4.0, 0.3], sides=jet, integrator=integrator, density=1.0,
        smoke={"initial": "x"}, initial={"velocity": [1.0, 0.0]},
    )  # fmt: skip
    h, n = 0.1, 5
    for number in range(n):
        step(fluid, number * h, h)
    t = h * n
    smoke = whole(fluid.comm, fluid.state()["smoke"])
    x = (np.arange(80) + 0.5) * 0.05
    beyond = (x > 1.5) & (x < 3.5)
    shift = (x[:, None] - smoke)[beyond]
    assert np.ptp(shift) < 1e-9
    # the first step's path knows the velocity at its begin alone: h^2/2 is lost, once
    assert shift.mean() == pytest.approx(t + t**2 / 2 - h**2 / 2, abs=1e-9)
    speed = fluid.velocity[0][fluid.grid.owned(0)]
    np.testing.assert_allclose(speed, 1 + t, rtol=1e-7)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("integrator", SECOND)
def test_ranks_agree_also_where_sweeps_are_many(integrator, dim):
    cells = (26, 24, 18)[:dim]
    sides = {"left": "periodic", "right": "periodic", "top": "open"}
    velocity = ["sin(2*pi*x)*cos(3*y)+0.5", "0.4*cos(2*pi*x)*sin(2*y)", "0.3*cos(4*x)*y"][:dim]
    post = {"post": {"shape": {"ball": {"centre": [0.7, 0.5, 0.4][:dim], "radius": 0.2}}}}
    states = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        fluid = make_fluid(
            cells, comm, sides=sides, initial={"velocity": velocity}, obstacles=post, integrator=integrator,
            smoke={"initial": "x"},
        )  # fmt: skip
        t, dt = 0.0, 5.0 / crossings(fluid)
        for h in (dt, 0.7 * dt, 0.9 * dt):
            fluid.predict(t, h)
            fluid.assemble(t, h)
            fluid.accept(fluid.unknown(), t, h)  # no pressure: what was carried itself
            t += h
        states.append(whole_state(fluid))
    for name, array in states[0].items():
        assert np.abs(array - states[1][name]).max() < 1e-12, name


@pytest.mark.parametrize("integrator", SECOND)
def test_uniform_flow_stays_uniform_around_a_body_that_moves_with_it(integrator):
    """Faces open and close as the body passes; nothing may notice."""
    fluid = make_fluid((24, 16), sides=PERIODIC, integrator=integrator)
    set_velocity(fluid, [lambda x, y, z: 1.0 + 0 * x * y, lambda x, y, z: -0.5 + 0 * x * y])
    t, h = 0.0, 0.03
    for number in range(6):
        left = 0.3 + number * h
        fluid.predict(t, h)
        fluid.immerse(solid_box(fluid, [left, 0.3], [left + 0.3, 0.6]), None)
        for axis, speed in enumerate((1.0, -0.5)):
            fluid.boundary_velocity[axis][fluid.face_kind[axis] == 4] = speed
        fluid.accept(0 * fluid.unknown(), t, h)
        t += h
        for axis, speed in enumerate((1.0, -0.5)):
            known = fluid.face_kind[axis] != 0
            np.testing.assert_allclose(fluid.velocity[axis][known], speed, rtol=1e-12)
