"""Quadratic solids and a fluid: faces let through, and bear, what their own shape functions say."""

from dataclasses import dataclass

import numpy as np
import pytest
from cut_cases import grid, piece_residuals, rotation
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import simulation
from petfsi.bench.column import Column
from petfsi.fields.solid.loads.simplices import Simplices
from petfsi.fields.solid.materials import lame_parameters
from petfsi.geometry.balls import unit_ball
from petfsi.geometry.clipping import cut
from petfsi.geometry.quadratic import Curved, facet_parts, facets_with_middles, part_forms, with_middles
from petfsi.geometry.surfaces import boundary_facets
from petfsi.scene.schema import Scene

DIRECT = "monolithic-direct.opts"
RHO, G = 1000.0, 9.81
DIMS = pytest.mark.parametrize("dim", [2, 3])


def quadratic_ball(dim, rng, centre):
    """Return a turned ball's points, quadratic facets, their flat parts and how these move."""
    points, cells = unit_ball(dim, 4)
    points, elements = with_middles(0.31 * points @ rotation(rng, dim), cells)
    whole = facets_with_middles(boundary_facets(points, elements[:, : dim + 1]), elements)
    return points + centre, whole, *facet_parts(whole, dim)


# ---- shape functions on parts -------------------------------------------------------------------------------


@DIMS
def test_parts_have_the_functions_of_the_whole(dim):
    points, whole, facets, curved = quadratic_ball(dim, np.random.default_rng(1), np.zeros(dim))
    facet = np.repeat(np.arange(len(facets)), dim)
    corners = np.tile(np.eye(dim), (len(facets), 1))
    values = curved.values(facet, corners)
    assert np.array_equal(values, curved.nodes[facet] == facets.reshape(-1, 1))
    # any quadratic function of place is what they make of its values at the nodes
    weights = np.random.default_rng(2).dirichlet(np.ones(dim), len(facets))
    x = np.einsum("ni,nia->na", weights, points[facets])
    square = (points @ np.arange(1, dim + 1) + 0.3) ** 2
    found = np.sum(curved.values(np.arange(len(facets)), weights) * square[curved.nodes], axis=1)
    assert found == pytest.approx((x @ np.arange(1, dim + 1) + 0.3) ** 2, abs=1e-14)


@DIMS
def test_means_over_pieces_are_those_of_many_points(dim):
    part = np.arange(len(part_forms(dim)))
    curved = Curved(np.zeros((len(part), part_forms(dim).shape[1]), dtype=int), part)
    centre = np.full((len(part), dim), 1 / dim)
    # the mean over a whole part, by a rule of degree two
    near = {2: 0.5 - 0.5 / np.sqrt(3), 3: 1 / 6}[dim]
    points = near + (1 - dim * near) * np.eye(dim)
    exact = np.mean([curved.values(part, np.tile(p, (len(part), 1))) for p in points], axis=0)
    assert curved.means(part, centre, np.ones(len(part))) == pytest.approx(exact, abs=1e-15)
    # a piece half as large lies four times as near to its middle's value
    middle = curved.values(part, centre)
    half = curved.means(part, centre, np.full(len(part), 2)) - middle
    assert half == pytest.approx((exact - middle) / 4, abs=1e-15)


# ---- integrals over patches ---------------------------------------------------------------------------------


@DIMS
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("periodic", [False, True])
def test_patches_of_a_face_add_up_to_the_consistent_load(dim, seed, periodic):
    """Under a uniform and a linear pressure, however the grid cuts the face, and over a seam."""
    rng = np.random.default_rng(seed)
    cells = [9, 7, 8][:dim]
    dx = rng.uniform(0.1, 0.2, dim)
    centre = 0.5 * dx * cells + rng.uniform(-0.05, 0.05, dim)
    points, whole, facets, curved = quadratic_ball(dim, rng, centre)
    shift = np.zeros(dim)
    if periodic:
        shift[0] = -centre[0]
    lattice = grid(cells, periodic=[periodic] + [False] * (dim - 1), dx=dx)
    cuts = cut(points + shift, facets, lattice, part=curved.part)
    parent = cuts.facet // len(part_forms(dim))
    expected = Simplices(points, whole, dim, 2)
    found = np.zeros((len(whole), whole.shape[1]))
    np.add.at(found, parent, cuts.integrals)
    area = expected.weights.sum(axis=1, keepdims=True)
    load = np.array([1, 1, 4]) / 6 if dim == 2 else np.array([0, 0, 0, 1, 1, 1]) / 3
    assert found == pytest.approx(area * load, abs=1e-14)
    # the first moments of an image are about the centre of the cell that it lies in
    index = np.column_stack(np.unravel_index(cuts.cell, lattice.shape))
    middle = (index + 0.5) * dx
    if periodic:
        middle[:, 0] -= np.where(middle[:, 0] > 0.5 * cells[0] * dx[0], cells[0] * dx[0], 0.0)
    moments = np.zeros((*found.shape, dim))
    np.add.at(moments, parent, cuts.moments + cuts.integrals[:, :, None] * (middle - shift)[:, None, :])
    for a, x in enumerate(list(expected.coordinates.values())[1:]):
        exact = np.einsum("nq,qk,nq->nk", expected.weights, expected.values, x)
        assert moments[:, :, a] == pytest.approx(exact, abs=1e-14)


@DIMS
def test_cells_close_where_faces_are_bent_and_linear_facets_stay_as_they_are(dim):
    rng = np.random.default_rng(5)
    cells = [9, 9, 9][:dim]
    points, _, facets, curved = quadratic_ball(dim, rng, 0.55 + np.zeros(dim))
    used = np.unique(facets)
    points[used] += rng.uniform(-0.02, 0.02, (len(used), dim))
    lattice = grid(cells, dx=0.13)
    bent = cut(points, facets, lattice, part=curved.part)
    flat = cut(points, facets, lattice)
    assert np.abs(piece_residuals(bent, lattice)).max() < 1e-12
    assert bent.integrals.sum(axis=1) == pytest.approx(flat.integrals.sum(axis=1), abs=1e-16)
    assert bent.moments.sum(axis=1) == pytest.approx(flat.moments.sum(axis=1), abs=1e-16)
    assert curved.to_corners(bent.facet, bent.integrals) == pytest.approx(flat.integrals, abs=1e-16)
    # beside others that are parts
    some = np.where(np.arange(len(facets)) % 2, curved.part, -1)
    mixed = cut(points, facets, lattice, part=some)
    linear = some[mixed.facet] < 0
    assert np.array_equal(mixed.integrals[linear, :dim], flat.integrals[linear])
    assert not mixed.integrals[linear, dim:].any()
    found = curved._replace(part=some).to_corners(mixed.facet, mixed.integrals)
    assert found == pytest.approx(flat.integrals, abs=1e-16)
    assert np.array_equal(mixed.integrals[~linear], bent.integrals[~linear])
    # a rank may have none of them
    away = cut(points, facets, grid(cells, lo=[8] * dim, hi=cells, dx=0.13), part=curved.part)
    assert away.moments.shape == (0, curved.nodes.shape[1], dim)


def let_through(points, facets, curved, lattice):
    """Return the sum of ∫ N_i n dA over all patches by node, and the volume that the cut leaves out."""
    cuts = cut(curved.vertices(points), facets, lattice, part=curved.part)
    flux = np.zeros_like(points)
    np.add.at(flux, curved.nodes[cuts.facet], cuts.integrals[:, :, None] * cuts.normals[cuts.facet][:, None, :])
    return flux, (1.0 - cuts.volume).sum() * np.prod(lattice.dx)


@DIMS
@pytest.mark.parametrize("bent", [0.0, 1e-3, 1e-2])
def test_what_bent_faces_let_through_is_how_the_enclosed_volume_changes(dim, bent):
    """In 2D exactly; in 3D up to how far faces are bent."""
    rng = np.random.default_rng(7)
    points, _, facets, curved = quadratic_ball(dim, rng, 0.55 + np.zeros(dim))
    lattice = grid([9, 9, 9][:dim], dx=0.13)
    points = points + rng.uniform(-bent, bent, points.shape)
    way = rng.uniform(-1, 1, points.shape)
    flux, _ = let_through(points, facets, curved, lattice)
    # a polynomial of degree dim, which these differences take exactly
    v = [let_through(points + k * 5e-3 * way, facets, curved, lattice)[1] for k in (-2, -1, 1, 2)]
    rate = (8 * (v[2] - v[1]) - (v[3] - v[0])) / (12 * 5e-3)
    slack = 1e-11 if dim == 2 or bent == 0 else 0.3 * bent
    assert np.sum(flux * way) == pytest.approx(rate, abs=slack * np.abs(flux * way).sum())


# ---- in a run -----------------------------------------------------------------------------------------------


def make_scene(dim, solids, transfer="cutcell", sides=None, gravity=None, dt=0.01, size=None, cells=None, flow=None):
    size, cells = size or [1.0] * dim, cells or [12, 19, 11][:dim]
    fluid = {"density": RHO, "origin": [0.0] * dim, "size": size, "cells": cells, "sides": sides or {}}
    if flow:
        fluid["initial"] = {"velocity": flow}
    scene = {"dim": dim, "time": {"end": 1e3, "dt": dt, "integrator": "bdf2"}, "fluid": fluid, "solids": solids}
    return Scene.model_validate(scene | {"coupling": {"transfer": transfer}, "gravity": gravity})


def ball(dim, elements="quadratic", cells=4, **more):
    shape = {"ball": {"centre": [0.51, 0.47, 0.53][:dim], "radius": 0.3, "cells": cells}}
    return {"shape": shape, "density": RHO, "young": 1e6, "poisson": 0.3, "elements": elements, **more}


def unscaled(sim):
    """Return J and D1 H as arrays, SI."""
    (coupling,), fluid, solid = sim.couplings, sim.fluid, sim.solid
    force = coupling.force_block.copy().convert("dense").getDenseArray()
    flux = coupling.flux_block.copy().convert("dense").getDenseArray()
    return -force / (solid.row_scale * fluid.col_scale), flux / (fluid.row_scale * solid.col_scale)


def surface_loads(solid, facets, nodes):
    """Return -∮ N_i n dA of a solid's surface points, by quadrature over the whole quadratic facets at rest."""
    x = solid.surface_positions()
    whole = Simplices(x, nodes, facets.shape[1], 2)
    loads = np.zeros_like(x)
    np.add.at(loads, nodes, -np.einsum("nq,qk,na->nka", whole.weights, whole.values, whole.reference_normals()[:, 0]))
    return loads


@DIMS
@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_a_uniform_pressure_loads_corners_and_middles_as_it_should(dim, transfer):
    with simulation(MPI.COMM_SELF, make_scene(dim, {"b": ball(dim)}, transfer), DIRECT) as sim:
        J, flux = unscaled(sim)
        if transfer == "cutcell":
            assert np.abs(J - flux.T).max() <= 1e-15 * np.abs(J).max()
        surface = sim.solid.surface()
        nodes = surface.nodes[:: len(part_forms(dim))]
        loads = surface_loads(sim.solid, surface.facets, nodes)
        found = surface.point_map @ J.sum(axis=1)
        assert found == pytest.approx(loads.ravel(), abs=1e-14)
        # each node of a surface is the point of one node of the mesh, and others bear nothing
        assert np.abs(J.sum(axis=1)).sum() == pytest.approx(np.abs(loads).sum(), rel=1e-12)


@DIMS
def test_what_a_quadratic_motion_pushes_out_is_the_integral_of_its_divergence(dim):
    with simulation(MPI.COMM_SELF, make_scene(dim, {"b": ball(dim)}), DIRECT) as sim:
        _, flux = unscaled(sim)
        x = sim.solid.reference
        u = np.zeros_like(x)
        u[:, 0], u[:, 1] = x[:, 0] ** 2, x[:, 0] * x[:, 1]
        outflow = (flux @ u.ravel()).sum()
        centre = np.array([0.51, 0.47, 0.53])
        assert outflow == pytest.approx(-3 * centre[0] * sim.solid.volumes()["b"], rel=1e-12)


@DIMS
@pytest.mark.parallel([1, 2, 3])
def test_a_body_of_the_fluids_density_in_fluid_at_rest_has_the_exact_field(dim):
    """Open below, so that what the fluid's unknowns hold is uniform and what its weight adds is linear.

    The stress is that of the fluid, p = -rho g y in all directions, and the strain e = -p / (dim lambda + 2 mu) in
    all directions, too: a quadratic displacement, with elements whose faces stand at any angle to the grid.
    """
    young = 1e14  # so stiff that what the displacement does to the geometry is below round-off
    solids = {"b": ball(dim, young=young, material="linear")}
    gravity = [0.0, -G, 0.0][:dim]
    scene = make_scene(dim, solids, sides={"bottom": "open"}, gravity=gravity, dt=1e-3)
    with simulation(MPI.COMM_WORLD, scene, DIRECT) as sim:
        for _ in range(6):
            sim.advance()
        solid = sim.solid
        x, d = (solid.comm.allgather(part) for part in (solid.reference, solid.displacement))
    x, d = np.concatenate(x), np.concatenate(d)
    lame, mu = lame_parameters(young, 0.3)
    slope = RHO * G / (dim * lame + 2 * mu)
    exact = slope * x[:, 1:2] * x
    exact[:, 1] -= 0.5 * slope * (x**2).sum(axis=1)
    rigid = [np.tile(axis, (len(x), 1)) for axis in np.eye(dim)]
    for a, b in [(0, 1), (1, 2), (2, 0)][: 1 if dim == 2 else 3]:
        rigid.append(np.zeros_like(x))
        rigid[-1][:, a], rigid[-1][:, b] = -x[:, b], x[:, a]
    modes = np.array(rigid).reshape(len(rigid), -1).T
    rest = (d - exact).ravel()
    rest -= modes @ np.linalg.lstsq(modes, rest, rcond=None)[0]
    assert np.abs(rest).max() < 1e-10 * np.abs(exact).max()


BLOCK = {"density": RHO, "young": 1e6, "poisson": 0.3}
SEVERAL = {
    "brick": {"shape": {"box": {"origin": [0.11, 0.13], "size": [0.31, 0.27], "cells": [2, 2]}}},
    "disk": {"shape": {"ball": {"centre": [0.73, 0.47], "radius": 0.2, "cells": 4}}, "elements": "quadratic"},
    "beam": {"shape": {"beam": {"start": [0.12, 0.61], "end": [0.41, 0.83], "thickness": 0.11, "elements": 3}}},
}


def several(*names, **more):
    return {name: BLOCK | SEVERAL[name] | more for name in names}


@pytest.mark.parametrize("transfer", ["cutcell", "ray"])
def test_bodies_of_several_orders_and_beams_are_coupled_as_if_each_were_alone(transfer):
    with simulation(MPI.COMM_SELF, make_scene(2, several(*SEVERAL), transfer, cells=[20, 21]), DIRECT) as sim:
        together = unscaled(sim)
        pieces = sim.solid._pieces
        assert [part.surface().nodes.shape[1] for part in sim.solid.parts] == [3, 2]
    for piece, names in zip(pieces, (("brick", "disk"), ("beam",)), strict=True):
        with simulation(MPI.COMM_SELF, make_scene(2, several(*names), transfer, cells=[20, 21]), DIRECT) as sim:
            J, flux = unscaled(sim)
        # further pieces of cells, at corners, are numbered behind the cells
        assert together[0][piece, :420] == pytest.approx(J[:, :420], abs=1e-15)
        assert together[1][:420, piece] == pytest.approx(flux[:420], abs=1e-15)


@pytest.mark.parallel([1, 2, 3])
def test_fluid_and_bodies_of_several_orders_that_move_alike_go_on_so():
    speed = [0.37, 0.21]
    bodies = several("brick", "disk", initial={"velocity": speed})
    sides = dict.fromkeys(("left", "right", "bottom", "top"), "periodic")
    scene = make_scene(2, bodies, sides=sides, dt=0.02, cells=[24, 20], flow=speed)
    with simulation(MPI.COMM_WORLD, scene, "monolithic.opts") as sim:
        for _ in range(30):
            sim.advance()
        for a in range(2):
            assert np.abs(sim.fluid.velocity[a][sim.fluid.grid.owned(a)] - speed[a]).max() < 1e-10
        assert np.abs(sim.solid.velocity - speed).max(initial=0.0) < 1e-10


@pytest.mark.parallel([1, 2])
def test_a_layer_of_quadratic_tetrahedra_sags_as_its_column_weighs():
    """On rollers all round, and so with nothing sideways."""
    rollers = [{"where": "bottom", "fix": ["x", "y", "z"]}]
    rollers += [{"where": side, "fix": ["x"]} for side in ("left", "right")]
    rollers += [{"where": side, "fix": ["z"]} for side in ("back", "front")]
    layer = {
        "shape": {"box": {"origin": [0.0, 0.0, 0.0], "size": [0.5, 0.53, 0.5], "cells": [2, 4, 2]}},
        "elements": "quadratic", "density": 0.001, "young": 1e8, "poisson": 0.3, "material": "linear",
        "supports": rollers,
    }  # fmt: skip
    more = {"gravity": [0.0, -G, 0.0], "dt": 10.0, "size": [0.5, 2.0, 0.5], "cells": [5, 16, 3]}
    with simulation(MPI.COMM_WORLD, make_scene(3, {"s": layer}, sides={"top": "open"}, **more), DIRECT) as sim:
        for _ in range(4):
            sim.advance()
        d = sim.solid.probe("s", [0.25, 0.53, 0.25], "displacement")
    # under a column that reaches down to where the layer's top comes to rest, and the layer's own weight
    slope = RHO * G * 0.53 / (1e8 * 0.7 / (1.3 * 0.4))
    assert d[1] == pytest.approx(-slope * (1.47 + 0.5e-6 * 0.53) / (1 - slope), rel=1e-10)
    assert np.abs(d[[0, 2]]).max() < 1e-13


# ---- the column's frequency ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layer(Column):
    """A column whose layer has ``elements`` quadratic triangles across and up, whatever the grid."""

    elements: int = 1

    def scene(self, comm, dt):
        scene = super().scene(comm, dt)
        layer = scene.solids["layer"].model_dump(exclude_unset=True)
        layer["shape"]["box"]["cells"] = [self.elements, self.elements]
        return Scene.model_validate(
            scene.model_dump(exclude_unset=True) | {"solids": {"layer": layer | {"elements": "quadratic"}}}
        )


def mode_error(column):
    dt, omega, _ = column.measure(MPI.COMM_SELF, 40)
    return theory.undo(column.integrator, omega, dt) / column.omega - 1


def test_a_quadratic_layer_under_water_swings_with_order_four_in_its_own_mesh():
    errors = [mode_error(Layer(1.0, 32, 4, elements=n)) for n in (1, 2)]
    assert abs(errors[0]) < 1e-4
    assert theory.orders(errors, [2, 1])[-1] > 3.5


@pytest.mark.parametrize("cells", [8, 9, 16, 17])
def test_the_grid_adds_nothing_to_a_quadratic_layers_frequency(cells):
    assert abs(mode_error(Layer(1.0, cells, 4, elements=4))) < 1e-6
