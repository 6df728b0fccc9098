"""Bodies under water: still water around them, a flap that leaks nothing, walls that they do not feel. About 40 s."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from test_sph_solids import DIRECT, prepared

from petfsi.bench.case import only_options
from petfsi.errors import InputError, SolveError
from petfsi.fields.sph.start import Start
from petfsi.scene.load import scene_from_dict

G = 9.81
HELD = [{"where": "all", "fix": ["x", "y"]}]


def scene(shape, end, dx=0.04, depth=1.0, solid=(), solids=None, energy_limit=1, **fluid):
    body = {"shape": shape, "density": 1000.0, "young": 1e9, "poisson": 0.3, **dict(solid or {"supports": HELD})}
    water = {"kind": "sph", "density": 1000.0, "origin": [0.0, 0.0], "size": [1.0, 1.2], "spacing": dx}
    water |= {"fill": [{"box": {"origin": [0.0, 0.0], "size": [1.0, depth]}}], "sides": {"top": "open"}, **fluid}
    time = {"end": end, "dt": "auto", "integrator": "newmark", "energy_limit": energy_limit}
    solids = solids or {"body": body}
    return scene_from_dict({"dim": 2, "gravity": [0.0, -G], "time": time, "fluid": water, "solids": solids})


def energy(fluid):
    mine = fluid.swarm.owned
    return 0.5 * float(fluid.swarm["m"][mine] @ np.sum(fluid.swarm["v"][mine] ** 2, axis=1))


def forces(sim):
    found = []
    while not sim.finished:
        sim.advance()
        found.append(sim.fluid.skin.force.sum(axis=0))
    return np.array(found)


@pytest.mark.parametrize("origin, size", [((0.32, 0.4), (0.32, 0.24)), ((0.337, 0.413), (0.33, 0.21))])
def test_water_around_a_held_box_stays_still_and_bears_it(origin, size):
    """Seen twice from beyond its corners, the box drove currents of 8 J, and was borne by two thirds of its water."""
    with only_options(DIRECT):
        sim = prepared(scene({"box": {"origin": list(origin), "size": list(size), "cells": [4, 4]}}, 1.0))
        force = forces(sim)[-200:].mean(axis=0)
    assert energy(sim.fluid) < 1e-5 * 1000.0 * G
    assert force[1] == pytest.approx(1000.0 * G * size[0] * size[1], rel=0.02)
    assert abs(force[0]) < 5e-3 * force[1]


def test_water_around_a_turned_triangle_stays_still_and_bears_it(tmp_path):
    corners = np.array([[0.15, 0.25], [0.85, 0.33], [0.42, 0.82]])
    s = np.linspace(0.0, 1.0, 9)
    points = [(1 - a - b) * corners[0] + a * corners[1] + b * corners[2] for a in s for b in s[: 9 - round(8 * a)]]
    place = {(i, j): sum(9 - k for k in range(i)) + j for i in range(9) for j in range(9 - i)}
    cells = [[place[i, j], place[i + 1, j], place[i, j + 1]] for i in range(8) for j in range(8 - i)]
    cells += [[place[i + 1, j], place[i + 1, j + 1], place[i, j + 1]] for i in range(8) for j in range(7 - i)]
    meshio.write_points_cells(
        tmp_path / "t.msh", np.pad(points, ((0, 0), (0, 1))), {"triangle": cells}, file_format="gmsh"
    )
    with only_options(DIRECT):
        sim = prepared(scene({"mesh": str(tmp_path / "t.msh")}, 1.4))
        force = forces(sim)
    force = force[len(force) // 3 :].mean(axis=0)
    a, b = corners[1] - corners[0], corners[2] - corners[0]
    assert energy(sim.fluid) < 2e-4 * 1000.0 * G  # what the gaps around it gave at the start still swings
    assert force[1] == pytest.approx(1000.0 * G * 0.5 * (a[0] * b[1] - a[1] * b[0]), rel=0.04)


def test_a_plate_of_no_thickness_under_water_lasts():
    """Its currents were ever faster, and the run ended within a second."""
    beam = {"beam": {"start": [0.48, 0.2], "end": [0.48, 0.8], "thickness": 0.004, "elements": 10}}
    held = {"supports": [{"where": "all", "fix": ["x", "y", "angle"]}], "young": 1e12}
    with only_options(DIRECT):
        sim = prepared(scene(beam, 1.1, solid=held))
        force = forces(sim)
    assert energy(sim.fluid) < 3e-4 * 1000.0 * G
    assert abs(force[len(force) // 2 :, 0].mean()) < 0.01 * 1000.0 * G * 0.6


def flap(amplitude, hinge=0.1, length=0.48, dx=0.024):
    turn = f"{amplitude}*sin(2*pi*t)"
    x = f"(y-{hinge})*sin({turn}) + (x-1)*(cos({turn})-1)"
    y = f"(y-{hinge})*(cos({turn})-1) - (x-1)*sin({turn})"
    everywhere = {"box": {"origin": [0.9, 0.0], "size": [0.2, 1.0]}}
    swung = {"supports": [{"where": everywhere, "fix": ["x", "y"], "displacement": {"x": x, "y": y}}]}
    shape = {"box": {"origin": [0.995, hinge], "size": [0.01, length], "cells": [1, 24]}}
    fill = [{"box": {"origin": [0.0, 0.0], "size": [2.0, 0.5]}}]
    return scene(shape, 0.6, dx, solid=swung, size=[2.0, 1.0], fill=fill)


def test_a_flap_swung_in_water_lets_nothing_through():
    """At 0.9 m/s, 0.3 rad at 1 Hz; whether something crosses it is seen in the frame that turns with it."""
    hinge, length, amplitude = 0.1, 0.48, 0.3

    def turned(fluid, t):
        a, x = amplitude * np.sin(2 * np.pi * t), fluid.swarm["x"] - [1.0, hinge]
        order = np.argsort(fluid.swarm["id"])
        across, along = x[:, 0] * np.cos(a) - x[:, 1] * np.sin(a), x[:, 0] * np.sin(a) + x[:, 1] * np.cos(a)
        return across[order], along[order]

    with only_options(DIRECT):
        sim = prepared(flap(amplitude), MPI.COMM_SELF)
        before, leaks, nearest = turned(sim.fluid, 0.0), 0, np.inf
        while not sim.finished:
            sim.advance()
            now = turned(sim.fluid, sim.time)
            crossed = np.flatnonzero(before[0] * now[0] < 0.0)
            part = before[0][crossed] / (before[0][crossed] - now[0][crossed])
            where = before[1][crossed] + part * (now[1] - before[1])[crossed]
            leaks += np.count_nonzero((where > 0.0) & (where < length))
            nearest = min(nearest, np.abs(now[0][(now[1] > 0) & (now[1] < length)]).min())
            before = now
    assert leaks == 0
    assert nearest < 0.024  # there was something to let through
    assert sim.fluid.law.pressure(sim.fluid.swarm["rho"]).max() < 3.0 * 1000.0 * G * 0.5


def inside(x, low, high, by):
    return int(np.all((x > np.array(low) + by) & (x < np.array(high) - by), axis=1).sum())


def test_a_body_lifted_off_the_floor_is_not_hollow():
    """Its bottom was dry at the start; the force swung by thousands of N, and four particles were in it."""
    box = {"box": {"origin": [0.32, 0.0], "size": [0.36, 0.2], "cells": [3, 2]}}
    lifted = [{"where": "all", "fix": ["x", "y"], "velocity": {"y": "0.3*min(1,t/0.2)"}}]
    with only_options(DIRECT):
        sim = prepared(scene(box, 0.8, depth=0.6, solid={"supports": lifted}))
        forces(sim)
    low = sim.fluid.skin.points.min(axis=0)
    assert low[1] > 0.2
    assert inside(sim.fluid.swarm["x"], low, low + [0.36, 0.2], 0.01) == 0


def test_two_bodies_that_touch_are_both_filled():
    grid = {"cells": [5, 5]}
    left = {"shape": {"box": {"origin": [0.3, 0.3], "size": [0.2, 0.2]} | grid}, "density": 1.0, "young": 1e6}
    right = {"shape": {"box": {"origin": [0.5, 0.3], "size": [0.2, 0.2]} | grid}, "density": 1.0, "young": 1e6}
    bodies = {name: body | {"poisson": 0.3, "supports": HELD} for name, body in (("l", left), ("r", right))}
    sim = prepared(scene({"box": {"origin": [0.3, 0.3], "size": [0.2, 0.2]} | grid}, 0.1, solids=bodies))
    skin = sim.fluid.skin
    assert len(skin.x) == 50 and skin.depth.min() > 0.0
    places = np.stack(np.meshgrid(0.32 + 0.04 * np.arange(10), 0.32 + 0.04 * np.arange(5)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(skin.x[np.lexsort(skin.x.round(6).T)], places, atol=1e-9)


@pytest.mark.parallel([1, 2])
def test_a_body_that_goes_into_the_floor_stops_the_run():
    box = {"box": {"origin": [0.4, 0.12], "size": [0.2, 0.2], "cells": [2, 2]}}
    with only_options(DIRECT):
        # particles that are squeezed between the two make energy before
        fallen = scene(box, 1.0, solid={"density": 5000.0, "initial": {"velocity": [0.0, -1.0]}}, energy_limit=-1)
        sim = prepared(fallen)
        with pytest.raises(SolveError, match=r"body leaves .* through fluid\.sides\.bottom at \(.*, 0\) m"):
            while not sim.finished:
                sim.advance()


def test_sound_that_is_too_slow_is_remarked_on_once():
    box = {"box": {"origin": [0.4, 0.4], "size": [0.2, 0.2], "cells": [2, 2]}}
    told = []
    with only_options(DIRECT):
        sim = prepared(scene(box, 0.05, sound_speed=6.0))
        sim.report = told.append
        while not sim.finished:
            sim.advance()
    assert len(told) == 1 and "fluid.sound_speed = 6 m/s is too low" in told[0]


def test_an_obstacle_too_thin_to_part_water_is_told_of():
    def notes(width):
        wall = {"shape": {"box": {"origin": [0.48, 0.0], "size": [width, 1.2]}}}
        water = {"kind": "sph", "density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.2], "spacing": 0.04}
        water["fill"] = [{"box": {"origin": [0.0, 0.0], "size": [1.0, 0.8]}}]
        time = {"end": 1.0, "dt": "auto"}
        table = {"dim": 2, "gravity": [0.0, -G], "time": time, "fluid": water, "obstacles": {"wall": wall}}
        return [note for note in Start(scene_from_dict(table)).notes if "thinner" in note]

    assert "obstacles.wall: is thinner than particles see, 0.12 m" in notes(0.08)[0]
    assert not notes(0.16)


def test_an_obstacle_is_not_called_like_a_side():
    table = {"dim": 2, "time": {"end": 1.0, "dt": "auto"}, "obstacles": {"left": {"shape": {"ball": {}}}}}
    table["obstacles"]["left"]["shape"]["ball"] = {"centre": [0.5, 0.5], "radius": 0.1}
    table["fluid"] = {"kind": "sph", "density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.2], "spacing": 0.04}
    table["fluid"] |= {"sound_speed": 1.0, "fill": [{"box": {"origin": [0.0, 0.0], "size": [1.0, 0.8]}}]}
    with pytest.raises(InputError, match="'left' is a side of the fluid"):
        scene_from_dict(table)
