"""What a jet's region takes of the faces of a side: exact areas and centroids, and so the flux that is asked for."""

import numpy as np
import pytest
from mac_cases import make_fluid, make_scene
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.mac.fluid import MacFluid
from petfsi.geometry.openings import parts_within
from petfsi.geometry.shapes import inside
from petfsi.scene.checks import problems
from petfsi.scene.schema import Scene
from petfsi.scene.tables import Shape


def rectangles(n, dim, axis, at):
    """The faces of a unit cube's side, n across."""
    index = np.stack(np.meshgrid(*[range(1 if b == axis else n) for b in range(dim)], indexing="ij"), -1)
    low = index.reshape(-1, dim) / n
    high = low + 1 / n
    low[:, axis] = high[:, axis] = at
    return low, high


def sampled(shape, axis, at, low, high, m=100):
    parts, centroids = [], []
    for one, other in zip(low, high, strict=True):
        lines = [a + (np.arange(m) + 0.5) / m * (b - a) for a, b in zip(one, other, strict=True)]
        lines[axis] = np.array([at])
        points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, len(one))
        here = inside(shape, points)
        parts.append(here.mean())
        centroids.append(points[here].mean(axis=0) if here.any() else np.full(len(one), np.nan))
    return np.array(parts), np.array(centroids)


def random_shape(kind, rng, dim, axis, at, number):
    centre = rng.uniform(0, 1, dim)
    centre[axis] = at + rng.uniform(-0.2, 0.2)
    if kind == "ball":
        return Shape(ball={"centre": list(centre), "radius": rng.uniform(0.21, 0.6)})
    if kind == "box":
        size = rng.uniform(0.41, 0.8, dim)
        return Shape(box={"origin": list(centre - size / 2), "size": list(size)})
    if kind == "halfspace":
        return Shape(halfspace={"point": list(centre), "normal": list(rng.normal(size=dim))})
    along = [0.5 * rng.normal(size=3), 0.5 * np.eye(3)[axis], 0.5 * np.eye(3)[(axis + 1) % 3]][number % 3]
    ends = {"start": list(centre - along), "end": list(centre + along)}
    return Shape(cylinder=ends | {"radius": rng.uniform(0.21, 0.4)})


@pytest.mark.parametrize("kind", ["box", "ball", "halfspace", "cylinder"])
def test_parts_of_faces_and_their_centroids_are_what_samples_say(kind):
    rng = np.random.default_rng(7)
    for number in range(9):
        dim = 3 if kind == "cylinder" else 2 + number % 2
        axis, at = int(rng.integers(dim)), float(rng.integers(2))
        shape = random_shape(kind, rng, dim, axis, at, number)
        low, high = rectangles(5, dim, axis, at)
        part, centroid = parts_within(shape, axis, at, low, high)
        wanted, middle = sampled(shape, axis, at, low, high)
        assert np.abs(part - wanted).max() < 0.006
        some = part > 0.05
        assert np.abs(centroid - middle)[some].max(initial=0.0) < 0.002


def test_a_slanting_cylinder_is_cut_in_an_ellipse():
    rng = np.random.default_rng(3)
    low, high = rectangles(17, 3, 0, 0.0)
    for lean in (0.0, 1e-12, 1e-3, 0.3, 0.7):
        direction = np.array([np.sqrt(1 - lean**2), *(lean * np.array([0.6, 0.8]))])
        centre, radius = np.array([0.0, *rng.uniform(0.4, 0.6, 2)]), rng.uniform(0.05, 0.15)
        ends = {"start": list(centre - direction), "end": list(centre + direction)}
        part, _ = parts_within(Shape(cylinder=ends | {"radius": radius}), 0, 0.0, low, high)
        assert part.sum() / 17**2 == pytest.approx(np.pi * radius**2 / direction[0], rel=1e-12)


def flux(fluid):
    """What comes in, m^2/s or m^3/s."""
    return fluid.comm.allreduce(fluid.inflow().sum())


def random_region(rng, dim, kind):
    """Return a region about the left side of the unit box, and the area that it takes of it."""
    if kind == "box":
        low = rng.uniform(-0.1, 0.9, dim)
        high = low + rng.uniform(0.11, 0.9, dim)
        low[0], high[0] = -rng.uniform(0.0, 1.0), rng.uniform(0.0, 1.0)
        area = np.prod((np.minimum(high, 1.0) - np.maximum(low, 0.0))[1:])
        return {"box": {"origin": list(low), "size": list(high - low)}}, area
    radius = rng.uniform(0.005, 0.5)
    centre = rng.uniform(radius, 1.0 - radius, dim)
    centre[0] = 0.9 * radius * rng.uniform(-1, 1)
    square = radius**2 - centre[0] ** 2
    return {"ball": {"centre": list(centre), "radius": radius}}, 2 * np.sqrt(square) if dim == 2 else np.pi * square


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["box", "ball"])
def test_a_jet_brings_exactly_the_flux_of_its_region(dim, kind):
    rng = np.random.default_rng(5)
    for _ in range(50 if MPI.COMM_WORLD.size == 1 else 3):
        cells = rng.integers(18, 24, dim) if dim == 2 else rng.integers(6, 14, dim)
        cells[0] = 18
        region, area = random_region(rng, dim, kind)
        sides = {"left": {"inflow": {"speed": 2.0, "region": region}}, "right": "open"}
        fluid = make_fluid(tuple(int(n) for n in cells), sides=sides)
        assert flux(fluid) == pytest.approx(2.0 * area, rel=1e-12)


def test_a_region_comes_in_through_its_images_around_a_periodic_border_too():
    region = {"box": {"origin": [-0.1, -0.23], "size": [0.2, 0.36]}}
    sides = {"bottom": "periodic", "top": "periodic", "right": "open"}
    fluid = make_fluid((8, 8), sides=sides | {"left": {"inflow": {"speed": 1.0, "region": region}}})
    assert flux(fluid) == pytest.approx(0.36, rel=1e-13)


def test_a_profile_is_taken_at_the_centroids_of_the_parts():
    """Second order: a parabola, a quarter of a cell beyond faces."""
    errors = []
    for n in (8, 16, 32):
        region = {"box": {"origin": [-0.1, 0.0], "size": [0.2, 0.5 + 0.25 / n]}}
        jet = {"speed": "1 - y**2", "region": region}
        fluid = make_fluid((n, n), sides={"left": {"inflow": jet}, "right": "open"})
        top = 0.5 + 0.25 / n
        errors.append(abs(flux(fluid) - (top - top**3 / 3)))
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.1)


def through_walls(rng, number):
    """Return a scene with a bar or disk through the left side and a jet, its ends, and whether the body covers it."""
    n, middle = int(rng.integers(6, 12)), rng.uniform(0.2, 0.8)
    low = rng.uniform(0.0, 0.8)
    high = rng.uniform(low + 0.01, 0.99)
    if number % 3 == 0:
        low, high = min(low, middle - 0.1), middle  # it ends within the body
    if number % 2:
        radius = rng.uniform(0.05, 0.3)
        body = {"ball": {"centre": [rng.uniform(-0.5, 0.5) * radius, middle], "radius": radius}}
        thickness = 2.0 * np.sqrt(radius**2 - body["ball"]["centre"][0] ** 2)
    else:
        thickness = rng.choice([0.003, 0.01, 0.13, 0.3])
        body = {"box": {"origin": [-1.0, middle - thickness / 2], "size": [1.0 + rng.uniform(0.2, 0.5), thickness]}}
    region = {"box": {"origin": [-0.1, low], "size": [0.2, high - low]}}
    sides = {"left": {"inflow": {"speed": 2.0, "region": region}}, "right": "open"}
    fluid = {"density": 1.0, "origin": [0.0, 0.0], "size": [1.0, 1.0], "cells": [18, n], "sides": sides}
    data = {"dim": 2, "time": {"end": 1.0, "dt": 0.1, "integrator": "bdf2"}, "fluid": fluid}
    covered = middle - thickness / 2 < low and high < middle + thickness / 2
    return Scene.model_validate(data | {"obstacles": {"body": {"shape": body}}}), low, high, covered


@pytest.mark.parallel([1, 2])
def test_a_jet_brings_exactly_the_flux_of_what_walls_leave_of_its_region():
    rng = np.random.default_rng(0)
    for number in range(40 if MPI.COMM_WORLD.size == 1 else 6):
        scene, low, high, covered = through_walls(rng, number)
        if covered:
            with pytest.raises(InputError, match="obstacles cover all of it"):
                MacFluid(MPI.COMM_WORLD, scene)
            continue
        fluid = MacFluid(MPI.COMM_WORLD, scene)
        fluid.surroundings.evaluate(0.0)
        fluid.surroundings.prescribe(fluid.face_kind, fluid.boundary_velocity)
        points, facets = fluid.surface
        one, other = points[facets[:, 0]], points[facets[:, 1]]
        through = one[:, 0] * other[:, 0] < 0
        share = one[through, 0] / (one[through, 0] - other[through, 0])
        bottom, top = np.sort(one[through, 1] + share * (other[through, 1] - one[through, 1]))
        wanted = 2.0 * (high - low - max(0.0, min(top, high) - max(bottom, low)))
        assert flux(fluid) == pytest.approx(wanted, abs=1e-12)


def through_a_side(region, body, cells):
    """Return what a jet of 1 m/s brings through its region of the left side beside a body."""
    sides = {"left": {"inflow": {"speed": 1.0, "region": region}}, "right": "open"}
    fluid = {"density": 1.0, "origin": [0.0] * 3, "size": [1.0] * 3, "cells": cells, "sides": sides}
    data = {"dim": 3, "time": {"end": 1.0, "dt": 0.1, "integrator": "bdf2"}, "fluid": fluid}
    fluid = MacFluid(MPI.COMM_WORLD, Scene.model_validate(data | {"obstacles": {"body": {"shape": body}}}))
    fluid.surroundings.evaluate(0.0)
    fluid.surroundings.prescribe(fluid.face_kind, fluid.boundary_velocity)
    return flux(fluid)


def test_it_does_so_beside_bars_and_sheets_in_space():
    rng = np.random.default_rng(2)
    for number in range(20):
        region, area = random_region(rng, 3, ("box", "ball")[number % 2])
        low, size = rng.uniform(0.1, 0.6, 3), rng.uniform(0.03, 0.35, 3)
        size[1] = (size[1], 0.003)[number // 2 % 2]
        low[0], size[0] = -0.5, 0.8
        end = (low + size) * [0.0, 1.0, 1.0]
        part, _ = parts_within(Shape.model_validate(region), 0, 0.0, low[None] * [0.0, 1.0, 1.0], end[None])
        body = {"box": {"origin": list(low), "size": list(size)}}
        flow = through_a_side(region, body, [6, *rng.integers(5, 10, 2).tolist()])
        assert flow == pytest.approx(area - part[0] * size[1] * size[2], abs=1e-12)


def test_two_halves_of_a_side_bring_what_all_of_it_does_beside_a_ball():
    rng = np.random.default_rng(4)
    for _ in range(6):
        centre, radius = rng.uniform(0.3, 0.7, 3), rng.uniform(0.1, 0.3)
        centre[0] = radius * rng.uniform(-0.5, 0.5)
        normal, point = rng.normal(size=3), centre + 0.5 * radius * rng.uniform(-1, 1, 3)
        body, cells = {"ball": {"centre": list(centre), "radius": radius}}, [6, *rng.integers(5, 10, 2).tolist()]
        halves = ({"halfspace": {"point": list(point), "normal": list(sign * normal)}} for sign in (1, -1))
        every = {"box": {"origin": [-1.0] * 3, "size": [3.0] * 3}}
        flows = [through_a_side(region, body, cells) for region in (*halves, every)]
        assert flows[0] + flows[1] == pytest.approx(flows[2], abs=1e-12) and min(flows[:2]) > 0.0


@pytest.mark.parametrize(
    "region",
    [
        {"ball": {"centre": [-0.2, 0.5], "radius": 0.1}},
        {"box": {"origin": [0.1, 0.0], "size": [0.2, 0.5]}},
        {"box": {"origin": [-0.1, 1.1], "size": [0.2, 0.5]}},
        {"halfspace": {"point": [-0.1, 0.0], "normal": [1.0, 0.0]}},
    ],
    ids=str,
)
def test_a_region_that_meets_no_part_of_its_side_is_named(region):
    sides = {"left": {"inflow": {"speed": 1.0, "region": region}}, "right": "open"}
    scene = make_scene((8, 8), sides=sides)
    assert [str(problem).split(" = ")[0] for problem in problems(scene)] == [
        f"fluid.sides.left.inflow.region.{next(iter(region))}"
    ]
    with pytest.raises(InputError, match="fluid.sides.left.inflow.region: meets no part of the side"):
        make_fluid((8, 8), sides=sides)


def test_regions_that_meet_a_part_of_their_sides_are_not_named():
    rng = np.random.default_rng(11)
    for number in range(40):
        dim = 2 + number % 2
        region = random_region(rng, dim, ("box", "ball")[number // 2 % 2])[0]
        assert not problems(
            make_scene((8,) * dim, sides={"left": {"inflow": {"speed": 1.0, "region": region}}, "right": "open"})
        )
