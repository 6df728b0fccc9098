"""Sides of the particles' box: inflows, open sides, sides that move; exact flows, ranks, restart. About 30 s."""

import numpy as np
import pytest
from petsc4py import PETSc  # noqa: F401 - starts MPI's partner before the fields do
from test_sph import SELF, WORLD, Stored, owned, prepared, scene, whole

from petfsi.errors import InputError
from petfsi.scene.load import dump_scene, load_scene, scene_from_dict

U = 1.0


def jet(speed=U, **more):
    return {"inflow": {"speed": speed, **more}}


def channel(sides=None, length=0.6, width=0.4, dx=0.05, dim=2, **more):
    """A channel full of what goes along x."""
    size = [length, width, width][:dim]
    fluid = {"size": size, "spacing": dx, "sound_speed": 10.0, "fill": [{"box": {"origin": [0.0] * dim, "size": size}}]}
    fluid |= {"sides": {"left": jet(), "right": "open", **(sides or {})}, "initial": {"velocity": [U, 0.0, 0.0][:dim]}}
    return scene(dim, **{"end": 1.0} | fluid | more)


def run(sim):
    while not sim.finished:
        sim.advance()
    return sim


def balance(sim, start):
    """Return by how much the mass in the box is not what it was, with what came and without what went, kg."""
    now = sim.fluid.tally()
    return now["mass"] - start["mass"] - now["mass_in"] + now["mass_out"]


# ---- exact flows -------------------------------------------------------------------------------------------------

PERIODIC = dict.fromkeys(("bottom", "top"), "periodic")


@pytest.mark.parallel([1, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_plug_flow_goes_on_to_round_off(dim):
    """For two box lengths; what came and went is the speed times the area times the time."""
    across = PERIODIC | (dict.fromkeys(("back", "front"), "periodic") if dim == 3 else {})
    sim = prepared(channel(across, dim=dim, dx=0.05 if dim == 2 else 0.1, end=0.9 if dim == 2 else 0.3))
    start = sim.fluid.tally()
    run(sim)
    now, area = sim.fluid.tally(), 0.4 ** (dim - 1)
    still = owned(sim, "v") - U * np.eye(dim)[0]
    assert np.abs(still).max(initial=0.0) < 1e-12
    assert np.abs(owned(sim, "rho") - 1000.0).max(initial=0.0) < 1e-9
    assert now["mass_in"] == pytest.approx(1000 * U * area * sim.time, abs=0.51 * 1000 * area * sim.fluid.spacing)
    assert abs(balance(sim, start)) < 1e-9
    values = sim.accounts.values
    assert abs(values["energy_residual"]) < 1e-9 * values["kinetic"]


def test_a_plug_flow_between_slip_walls_is_steady():
    """As far as it is without openings: the wall particles stand still, which is felt by a thousandth."""
    sim = run(prepared(channel(end=1.2)))
    assert np.abs(owned(sim, "v") - [U, 0.0]).max() < 3e-3
    assert sim.fluid.tally()["mass"] == pytest.approx(240.0, abs=0.1)
    assert abs(sim.accounts.values["energy_residual"]) < 1e-4 * sim.accounts.values["kinetic"]


def test_a_viscous_flow_through_a_channel_has_its_profile_and_its_pressure():
    """Poiseuille at Re 5, p = 12 nu rho U (L - x) / W^2, from a parabola that comes in."""
    n, width, nu = 16, 0.4, 0.08
    profile = f"6*{U}*y/{width}*(1 - y/{width})"
    sides = {"left": jet(profile), "bottom": "no-slip", "top": "no-slip"}
    probes = {
        f"p{k}": {"of": "fluid", "at": [at, width / 2], "quantity": "pressure"} for k, at in enumerate((0.15, 0.45))
    }
    made = channel(
        sides, 0.6, width, width / n, viscosity=1000 * nu, sound_speed=20.0, initial={"velocity": [profile, 0.0]},
        probes=probes, end=1.2,
    )  # fmt: skip
    sim = prepared(made)
    start = sim.fluid.tally()
    run(sim)
    x, v = owned(sim, "x"), owned(sim, "v")
    inside = (x[:, 0] > 0) & (x[:, 0] < 0.6)
    exact = 6 * U * x[:, 1] / width * (1 - x[:, 1] / width)
    assert np.abs(v[inside] - np.stack([exact, 0 * exact], axis=1)[inside]).max() < 0.02 * 1.5 * U
    fall = np.subtract(*sim.probe()) / 0.3
    assert fall == pytest.approx(12 * nu * 1000 * U / width**2, rel=0.02)
    assert abs(balance(sim, start)) < 1e-9
    passed = sim.fluid.tally()["mass_out"] / (1000 * U * width * sim.time)
    assert passed == pytest.approx(1.0, abs=0.02)
    assert abs(sim.accounts.values["energy_residual"]) < 2e-3 * sim.accounts.values["boundary_work"]


def test_what_comes_in_over_a_part_of_a_side_fills_a_tank():
    """As much as it should; energy is accounted for."""
    part = jet(U, region={"box": {"origin": [-0.1, 0.0], "size": [0.2, 0.16]}}, ramp=0.1)
    fill = [{"box": {"origin": [0.0, 0.0], "size": [0.6, 0.16]}}]
    made = channel(
        {"left": part, "right": "slip"}, dx=0.02, fill=fill, initial={}, gravity=[0.0, -9.81], end=0.4, sound_speed=20.0
    )
    sim = prepared(made)
    start = sim.fluid.tally()
    run(sim)
    values = sim.accounts.values
    assert sim.fluid.tally()["mass_in"] == pytest.approx(1000 * 0.16 * U * (0.4 - 0.05), abs=0.6 * 1000 * 0.16 * 0.02)
    assert abs(balance(sim, start)) < 1e-9
    assert abs(values["energy_residual"]) < 0.02 * values["boundary_work"]


def test_what_falls_beyond_an_open_side_is_taken_out_below_the_box_too():
    made = channel(
        {"left": "slip"}, 0.6, 0.2, initial={"velocity": [0.3, 0.0]}, gravity=[0.0, -9.81], sound_speed=20.0, end=0.6
    )
    sim = prepared(made)
    start = sim.fluid.tally()
    run(sim)
    assert sim.fluid.tally()["mass"] < 0.85 * start["mass"]
    assert abs(balance(sim, start)) < 1e-9


def test_a_plate_that_moves_draws_the_fluid_along():
    """Couette flow, and in a closed cavity a lid, whose work is what viscosity takes and the flow has.

    All but what walls at rest give in its corners: 7% here, 5% at half the spacing.
    """
    lid = {"no-slip": {"velocity": [U, 0.0]}}
    sides = {"left": "periodic", "right": "periodic", "bottom": "no-slip", "top": lid}
    sim = run(prepared(channel(sides, width=0.4, dx=0.025, viscosity=200.0, initial={}, end=0.6)))
    assert np.abs(owned(sim, "v")[:, 0] - U * owned(sim, "x")[:, 1] / 0.4).max(initial=0.0) < 0.01
    values = sim.accounts.values
    assert abs(values["energy_residual"]) < 0.02 * values["boundary_work"]
    closed = dict.fromkeys(("left", "right", "bottom"), "no-slip") | {"top": lid}
    sim = run(prepared(channel(closed, dx=0.025, viscosity=20.0, initial={}, end=0.4)))
    values = sim.accounts.values
    assert values["boundary_work"] > values["kinetic"] > 0
    assert abs(values["energy_residual"]) < 0.1 * values["boundary_work"]


# ---- ranks and restart -------------------------------------------------------------------------------------------

POST = {"post": {"shape": {"ball": {"centre": [0.3, 0.1], "radius": 0.06}}}}
SCENES = {
    "profile": channel({"left": jet("1.5*y/0.4 + 0.2*sin(9*t)", ramp=0.05)}, obstacles=POST, end=0.35),
    "back and forth": channel({"left": jet("cos(20*t)")}, end=0.35),
    "jet": scene(
        gravity=[0.0, -9.81], end=0.2, size=[0.6, 0.6], spacing=0.05, viscosity=2.0,
        fill=[{"box": {"origin": [0.0, 0.0], "size": [0.6, 0.1]}}],
        sides={"left": jet(2.0, region={"box": {"origin": [-0.1, 0.2], "size": [0.2, 0.2]}}, rest="no-slip"),
               "bottom": {"no-slip": {"velocity": ["1 + x*t", 0.0]}}, "top": "open",
               "right": jet(-1.0, region={"box": {"origin": [0.5, 0.0], "size": [0.2, 0.1]}}, rest="open")},
    ),
    "3d": channel({"left": jet("1 + z", region={"ball": {"centre": [0.0, 0.2, 0.2], "radius": 0.16}})}, dim=3, dx=0.1,
                  end=0.2),
}  # fmt: skip


@pytest.mark.parallel([2, 3, 4])
@pytest.mark.parametrize("name", SCENES)
def test_ranks_agree_bit_for_bit_while_particles_come_and_go(name):
    one, many = (whole(run(prepared(SCENES[name], comm))) for comm in (SELF, WORLD))
    for key, value in one.items():
        np.testing.assert_array_equal(many[key], value, err_msg=key)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("name", ["profile", "jet"])
def test_a_run_resumed_between_any_two_steps_goes_on_bit_for_bit(name):
    """Over steps in which particles come, one after another."""
    made = SCENES[name]
    straight = prepared(made, SELF)
    for _ in range(12):
        straight.advance()
    before = whole(straight)["passed"][1]  # the next id, after the length
    for _ in range(9):
        stored, here = Stored(straight), (straight.step, straight.time, straight.dt)
        straight.forget()  # as after a checkpoint
        resumed = prepared(made, WORLD)
        resumed.restore(*here, stored.group)
        for sim in (straight, resumed):
            sim.advance()
        one, many = whole(straight), whole(resumed)
        for key, value in one.items():
            np.testing.assert_array_equal(many[key], value, err_msg=key)
        assert straight.fluid.tally() == pytest.approx(resumed.fluid.tally(), rel=1e-12)
    assert whole(straight)["passed"][1] > before


# ---- what cannot be ----------------------------------------------------------------------------------------------

PLATE = {"no-slip": {"velocity": [1.0, 0.0]}}


@pytest.mark.parametrize("side, more, told", [
    ({"left": {}}, {}, r"fluid.sides.left = {}: must be 'slip', .* or a table of one key \(or { inflow"),
    ({"left": PLATE | jet()}, {}, "must be 'slip', .* or a table of one key"),
    ({"left": jet("z")}, {}, "inflow.speed = \"z\": unknown name 'z'"),
    ({"left": jet(rest="shut")}, {}, "inflow.rest = \"shut\": must be 'slip', 'no-slip' or 'open'"),
    ({"left": jet(ramp=-1.0)}, {}, "inflow.ramp = -1.0: must be 0 or more"),
    ({"left": jet(smoke=1.0)}, {}, "inflow.smoke = 1.0: does not belong here; known here are speed, region"),
    ({"left": jet(region={"mesh": "a.msh"})}, {}, "inflow.region.mesh = .*must be a box"),
    ({"left": jet(region={"box": {"origin": [0.2, 0.0], "size": [0.1, 0.1]}})}, {}, "region: no particle has room"),
    ({"left": jet("1/(t - 1)")}, {}, "inflow.speed = .* is inf at t = 1"),
    ({"bottom": PLATE}, {}, "no-slip.velocity = .*: moves no fluid, whose viscosity is 0"),
    ({"left": PLATE}, {"viscosity": 1.0}, "left.no-slip.velocity.0 = 1.0: must be 0: a side moves in its own plane"),
    ({"top": {"no-slip": {"velocity": [1.0]}}}, {"viscosity": 1.0}, "must have 2 items, as dim = 2"),
    ({"top": {"no-slip": {"velocity": ["q", 0.0]}}}, {"viscosity": 1.0}, "no-slip.velocity.0 = \"q\": unknown name"),
    ({"top": {"no-slip": {"speed": 1.0}}}, {"viscosity": 1.0}, "no-slip.velocity: is missing"),
])  # fmt: skip
def test_a_side_that_cannot_be_is_refused(side, more, told):
    with pytest.raises(InputError, match=told):
        prepared(channel(side, **more), SELF)


def test_a_sound_speed_too_low_for_what_comes_in_is_told():
    assert "less than 10 times what comes in" in " ".join(prepared(channel(sound_speed=8.0), SELF).fluid.notes)
    assert prepared(channel({"left": jet("2*sin(pi*t)")}, sound_speed=None, initial={}), SELF).fluid.law.c == 20.0


def test_a_scene_with_such_sides_is_written_as_it_was_read(tmp_path):
    made = channel({"top": PLATE, "left": jet("1 + t", ramp=0.1)}, viscosity=1.0)
    (tmp_path / "scene.toml").write_text(dump_scene(made))
    assert load_scene(tmp_path / "scene.toml") == made


@pytest.mark.parallel([1, 2])
def test_what_flies_over_the_rim_of_an_open_box_is_gone():
    """It fell behind the wall, and stopped the run."""
    fluid = {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "spacing": 0.04}
    fluid |= {"pressure": "none", "initial": {"velocity": ["where(y>0.5,1.0,0)", "where(y>0.5,2.0,0)"]}}
    ball = {"ball": {"centre": [0.7, 0.85], "radius": 0.08}}
    fluid |= {"fill": [{"box": {"origin": [0.0, 0.0], "size": [1.0, 0.2]}}, ball], "sides": {"top": "open"}}
    time = {"end": 0.6, "dt": "auto"}
    sim = prepared(scene_from_dict({"dim": 2, "gravity": [0.0, -9.81], "time": time, "fluid": fluid}))
    start = sim.fluid.tally()
    run(sim)
    assert 0.3 < sim.fluid.tally()["mass_out"] / (1000.0 * np.pi * 0.08**2) < 0.7  # half of it falls back
    assert abs(balance(sim, start)) < 1e-9
