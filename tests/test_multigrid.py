"""Multigrid for the pressure, the stand-in for the Schur complement, and how the default solver fares with them."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from mac_cases import make_fluid
from mpi4py import MPI
from petsc4py import PETSc

from petfsi.bench.case import Case, only_options
from petfsi.bench.solver import first_solve
from petfsi.bench.solver import scene as falling_bar
from petfsi.bench.stretched import scene as long_cells
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation
from petfsi.solving.multigrid import COARSEST, Hierarchy, Lattice, line_weights

DEFAULT, DIRECT = "monolithic.opts", "monolithic-direct.opts"
PERIODIC = {"left": "periodic", "right": "periodic"}


# ---- transfers ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n, periodic", [(8, False), (9, False), (8, True), (9, True)])
def test_interpolation_along_a_line_keeps_straight_lines(n, periodic):
    parent, other, weight = line_weights(n, periodic)
    centre = np.array([np.mean(np.arange(n)[2 * c : 2 * c + 2] + 0.5) for c in range((n + 1) // 2)])
    value = (1 - weight) * centre[parent] + weight * centre[other]
    assert np.all((0 <= weight) & (weight <= 0.5))
    np.testing.assert_allclose(value[1 : 2 * (n // 2) - 1], np.arange(1, 2 * (n // 2) - 1) + 0.5)
    if periodic:
        assert other[0] == len(centre) - 1 and weight[0] > 0
    else:
        assert weight[0] == 0 and weight[2 * (n // 2) - 1 + n % 2] == 0


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize(
    "cells, sides", [((45, 30), {}), ((32, 16), PERIODIC), ((13, 21, 8), {}), ((24, 1), {})], ids=str
)
def test_transfers_keep_constants_down_to_the_coarsest_grid(cells, sides):
    fluid = make_fluid(cells, sides=sides)
    hierarchy = Hierarchy(fluid)
    rows = fluid.layout.n_global
    for transfer in hierarchy.transfers:
        for mat in (transfer.linear, transfer.constant):
            assert mat.getSize()[0] == rows
            one, sums = mat.createVecs()
            one.set(1.0)
            mat.mult(one, sums)
            np.testing.assert_allclose(sums.array, 1.0, atol=1e-14)
        rows = transfer.linear.getSize()[1]
    assert rows <= COARSEST ** len(cells)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("cells", [(45, 30), (13, 21, 8)], ids=str)
def test_ranks_interpolate_as_one_rank_does(cells):
    together, alone = make_fluid(cells), make_fluid(cells, comm=MPI.COMM_SELF)
    results = []
    for fluid in (together, alone):
        grid = fluid.grid
        x = np.meshgrid(*(grid.cell_centres(a) for a in range(3)), indexing="ij", sparse=True)
        values = grid.zeros_cells() + np.cos(3 * x[0]) * np.sin(5 * x[1] + x[2])
        fine = Hierarchy(fluid).transfers[0]
        vec, back = fine.linear.createVecLeft(), fine.linear.createVecRight()
        vec.array = grid.to_vec(values)
        fine.constant.multTranspose(vec, back)
        fine.linear.mult(back, vec)
        grid.from_vec(vec.array, values)
        results.append(values)
    part = tuple(slice(g, g + n) for g, n in zip(alone.grid.ghost, alone.grid.owned_shape, strict=True))
    own = tuple(slice(a, b) for a, b in zip(together.grid.lo, together.grid.hi, strict=True))
    np.testing.assert_allclose(results[0][together.grid.owned(None)], results[1][part][own], atol=1e-13)


# ---- the default solver -------------------------------------------------------------------------------------


def solved(scene, options, *more, comm=MPI.COMM_WORLD, steps=1):
    with only_options(["-options_file", options, *more]):
        sim = Simulation(comm, scene)
        sim.prepare()
        sim.counts, solve = [], sim.solver.linear.solve

        def counted(*args, **more):
            iterations, norms = solve(*args, **more)
            sim.counts.append(iterations)
            return iterations, norms

        sim.solver.linear.solve = counted
        for _ in range(steps):
            sim.advance()
        values = dict(zip((f.name for f in sim.fields), sim.system.values(), strict=True))
        outcome = sim.outcome
        sim.solver.reset()
    return outcome, values, sim


@pytest.mark.parametrize(
    "rho, r, most",
    [(1e3, 1.0, 25), (1.0, 1.0, 25), (1.0, 1e6, 25), (0.1, 1e2, 25), (0.1, 1e8, 25), (1e-3, 1.0, 25), (1e-3, 1e2, 40)],
)
def test_iterations_stay_bounded_whatever_the_material(rho, r, most):
    case = Case(MPI.COMM_SELF, True)
    found = first_solve(case, falling_bar(case, 32, rho, r, 0.01), DEFAULT)
    assert 0 < found["iterations"] <= most and found["residual"] <= 1e-8


def test_iterations_do_not_grow_with_the_grid():
    counts, case = [], Case(MPI.COMM_SELF, True)
    for n in (16, 32, 48):
        counts.append(first_solve(case, falling_bar(case, n, 1.0, 1e2, 0.01), DEFAULT)["iterations"])
    assert max(counts) - counts[0] <= 4, counts


def test_the_step_does_not_matter():
    counts = []
    for dt in (1e-4, 1e-2, 1.0):
        scene = falling_bar(Case(MPI.COMM_SELF, True), 16, 1.0, 1e4, dt)
        counts.append(solved(scene, DEFAULT, "-fsi_ksp_rtol", "1e-8")[0].iterations)
    assert max(counts) - min(counts) <= 1, counts


@pytest.mark.parallel([2, 3])
def test_ranks_take_as_many_iterations_as_one():
    scene = falling_bar(Case(MPI.COMM_WORLD, True), 24, 1.0, 1e2, 0.01)
    alone = solved(scene, DEFAULT, comm=MPI.COMM_SELF)[0].iterations
    assert abs(solved(scene, DEFAULT)[0].iterations - alone) <= 2


# ---- closed regions -----------------------------------------------------------------------------------------

WALL = {"shape": {"box": {"origin": [1.02, -0.1], "size": [0.07, 1.2]}}}
HOLLOW = {
    "shape": {
        "box": {"origin": [0.31, 0.27], "size": [0.4, 0.4], "cells": [12, 12]},
        "cavity": {"origin": [0.41, 0.37], "size": [0.2, 0.2]},
    },
    "density": 1100.0, "young": 1e6, "poisson": 0.3, "interior": "fluid",
    "initial": {"velocity": ["0.1*sin(5*y)", "0.1*cos(4*x)"]},
}  # fmt: skip


def regions_scene(wall, hollow, top="slip", velocity=None, gravity=(0.3, -9.81)):
    """A box 2 m by 1 m; the wall leaves a room at its right that no solid touches."""
    sides = {"left": "slip", "right": "slip", "bottom": "slip", "top": top}
    fluid = {"origin": [0.0, 0.0], "size": [2.0, 1.0], "density": 1000.0, "cells": [64, 32], "sides": sides}
    scene = {
        "dim": 2,
        "gravity": list(gravity),
        "time": {"end": 1.0, "dt": 0.01, "integrator": "newmark"},
        "fluid": fluid,
    }
    scene |= {"coupling": {"transfer": "cutcell"}, "obstacles": {"wall": WALL} if wall else {}}
    solid = HOLLOW | ({"initial": {"velocity": velocity}} if velocity else {})
    return Scene.model_validate(scene | ({"solids": {"box": solid}} if hollow else {}))


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("wall, hollow, top", [(True, True, "slip"), (False, True, "open"), (False, True, "slip")])
def test_rigid_and_elastic_cavities_are_solved_as_a_factorisation_does(wall, hollow, top):
    scene = regions_scene(wall, hollow, top)
    outcome, ours, sim = solved(scene, DEFAULT, steps=2)
    _, theirs, _ = solved(scene, DIRECT, steps=2)
    # a step takes several solves, to close the volume
    assert outcome.residual <= 1e-8 and len(sim.counts) > 2 and max(sim.counts) <= 40
    speed = np.abs(theirs["solid"]).max(initial=0.0)
    np.testing.assert_allclose(ours["solid"], theirs["solid"], atol=1e-6 * MPI.COMM_WORLD.allreduce(speed, MPI.MAX))
    rigid = [members for members, touched in sim.fluid.closed_regions(sim.couplings[0].touched) if not touched]
    assert len(rigid) == wall


@pytest.mark.parallel([1, 2])
def test_rigid_rooms_alone_are_solved(wall=True):
    outcome, values, _ = solved(regions_scene(True, False), DEFAULT)
    assert outcome.residual <= 1e-8 and outcome.iterations <= 20
    assert np.isfinite(values["pressure"]).all()


SHEET = Path(__file__).parent / "scenes" / "sheet.toml"


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_divided_cells_are_solved_as_a_factorisation_does(integrator):
    data = tomllib.loads(SHEET.read_text()) | {"time": {"end": 1.0, "dt": 0.01, "integrator": integrator}}
    outcome, ours, sim = solved(Scene.model_validate(data), DEFAULT, steps=8)
    _, theirs, _ = solved(Scene.model_validate(data), DIRECT, steps=8)
    divided = 0 if sim.fluid.extras is None else len(sim.fluid.extras.cell)
    assert MPI.COMM_WORLD.allreduce(divided) >= 8
    assert outcome.residual <= 1e-8 and outcome.iterations <= 20
    for name, values in ours.items():
        largest = MPI.COMM_WORLD.allreduce(np.abs(theirs[name]).max(initial=0.0), MPI.MAX)
        np.testing.assert_allclose(values, theirs[name], atol=1e-6 * largest)


# ---- options ------------------------------------------------------------------------------------------------

PRESSURE = "-fsi_fieldsplit_pressure_"


@pytest.mark.parametrize(
    "more",
    [
        [f"{PRESSURE}pc_type", "hypre"],
        [f"{PRESSURE}pc_type", "gamg", f"{PRESSURE}pc_use_amat", "0"],
        [f"{PRESSURE}pc_mg_galerkin", "both"],
        [f"{PRESSURE}pc_mg_levels", "2", f"{PRESSURE}mg_coarse_pc_type", "redundant"],
        [f"{PRESSURE}mg_levels_pc_type", "jacobi"],
        [f"{PRESSURE}mg_levels_pc_type", "sor"],
        [f"{PRESSURE}schur_faint", "0", f"{PRESSURE}mg_levels_walls_from", "0"],
    ],
    ids=" ".join,
)
def test_preconditioners_are_a_matter_of_options(more):
    scene = regions_scene(False, True, "open")
    _, ours, _ = solved(scene, DEFAULT, *more)
    _, theirs, _ = solved(scene, DIRECT)
    np.testing.assert_allclose(ours["solid"], theirs["solid"], atol=1e-6 * np.abs(theirs["solid"]).max())


def test_too_many_levels_are_refused():
    from petfsi.errors import InputError

    with pytest.raises(InputError, match="pc_mg_levels 9: must be from 2 to 5"):
        solved(regions_scene(False, True, "open"), DEFAULT, f"{PRESSURE}pc_mg_levels", "9")


def test_options_of_one_solver_do_not_leak():
    before = PETSc.Options().getAll()
    solved(regions_scene(False, True, "open"), DEFAULT, f"{PRESSURE}mg_levels_walls_from", "0")
    assert PETSc.Options().getAll() == before


# ---- reuse and modes ----------------------------------------------------------------------------------------


@pytest.mark.parallel([1, 2])
def test_a_light_body_needs_its_motions():
    scene = falling_bar(Case(MPI.COMM_WORLD, True), 24, 1e-3, 1e6, 0.01)
    with_modes = solved(scene, DEFAULT, "-fsi_ksp_rtol", "1e-8")[0].iterations
    without = solved(scene, DEFAULT, "-fsi_ksp_rtol", "1e-8", f"{PRESSURE}modes_degree", "-1")[0].iterations
    assert with_modes < without - 4


def builds(monkeypatch, scene, *more, steps=8):
    from petfsi.solving.schur import SchurStandIn

    count = []
    refresh = SchurStandIn.refresh
    monkeypatch.setattr(SchurStandIn, "refresh", lambda self: (count.append(1), refresh(self)))
    solved(scene, DEFAULT, *more, steps=steps)
    return len(count)


def test_a_preconditioner_is_kept_while_little_changes_and_not_longer(monkeypatch):
    quiet = regions_scene(False, True, "open", ["1e-7*sin(5*y)", "0.0"], (0.0, 0.0))
    assert builds(monkeypatch, quiet) <= 4
    assert builds(monkeypatch, quiet, f"{PRESSURE}lag_change", "0") >= 8
    assert builds(monkeypatch, regions_scene(False, True, "open")) >= 6


# ---- stretched cells and tiny grids -------------------------------------------------------------------------


def test_grids_are_coarsened_along_the_short_sides_of_cells_until_these_are_as_long_as_wide():
    level, seen = Lattice([np.array([0, 64]), np.array([0, 33])], (False, False), (10.0, 1.0)), []
    while max(level.cells) > 1:
        level = level.halved()
        seen.append(level.cells)
    assert seen == [(64, 17), (64, 9), (64, 5), (32, 3), (16, 2), (8, 1), (4, 1), (2, 1), (1, 1)]


SOLVERS = {"mg": [], "hypre": [f"{PRESSURE}pc_type", "hypre"], "gamg": [f"{PRESSURE}pc_type", "gamg"], "direct": None}
LONG = [(1, 1), (5, 1), (1, 20), (80, 1), (1, 400), (1, 5, 1), (20, 1, 20), (1, 80, 400)]


@pytest.mark.parametrize("ratios", LONG, ids=str)
@pytest.mark.parametrize("sides", [{"right": "open"}, {}, PERIODIC | {"top": "open"}], ids=str)
def test_cells_may_be_long_along_any_axis(ratios, sides):
    cells = (37, 24) if len(ratios) == 2 else (10, 13, 16)
    outcome, _, sim = solved(long_cells(cells, ratios, sides), DEFAULT)
    # pressures are larger than their differences across cells by the square of the ratio, and their round-off
    least = sim.system.round_off() / sim.system.rhs.norm()
    assert outcome.iterations <= 14
    assert outcome.residual <= 2 * max(1e-12, least) <= 2e-12 * max(ratios) ** 2


@pytest.mark.parametrize("ratio", [20, 80])
@pytest.mark.parametrize("density, most", [(1e3, 20), (1.0, 40), (1e-3, 60)], ids=str)
def test_plates_along_long_cells_are_solved_as_a_factorisation_does(ratio, density, most):
    scene = long_cells((32, 32), (ratio, 1), {"right": "open"}, density)
    outcome, ours, _ = solved(scene, DEFAULT)
    _, theirs, _ = solved(scene, DIRECT)
    assert outcome.iterations <= most
    for name in ours:
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-6 * np.abs(theirs[name]).max())


@pytest.mark.parametrize("name", ["hypre", "gamg"])
@pytest.mark.parametrize("ratios", [(1, 1), (80, 1), (1, 400), (20, 1, 20)], ids=str)
def test_algebraic_preconditioners_are_usable_in_long_cells(ratios, name):
    cells = (48, 48) if len(ratios) == 2 else (12, 12, 12)
    for density, most in ((None, 30), (1e3, 30), (1.0, 60)):
        outcome = solved(long_cells(cells, ratios, {"right": "open"}, density), DEFAULT, *SOLVERS[name])[0]
        assert outcome.iterations <= most


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("density", [None, 1e3, 1.0])
def test_ranks_take_as_many_iterations_in_long_cells_as_one(density):
    scene = long_cells((20, 36), (20, 1), {"right": "open"}, density)
    alone = solved(scene, DEFAULT, comm=MPI.COMM_SELF)[0].iterations
    assert abs(solved(scene, DEFAULT)[0].iterations - alone) <= 3


TINY = [(1, 1), (1, 2), (2, 1), (1, 5), (4, 4), (5, 3), (1, 1, 1), (3, 2, 1), (2, 5, 3)]


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize(
    "sides", [{}, {"left": {"inflow": {"speed": "0.1*(1-y)"}}, "right": "open"}], ids=["closed", "flow"]
)
@pytest.mark.parametrize("cells", TINY, ids=str)
def test_tiny_grids_are_solved(cells, sides, solid):
    dim = len(cells)
    fluid = {"origin": [0.0] * dim, "size": [1.0, 0.4, 0.6][:dim], "density": 1000.0, "cells": list(cells)}
    walls = dict.fromkeys(("left", "right", "bottom", "top", "back", "front")[: 2 * dim], "slip")
    scene = {
        "dim": dim,
        "time": {"end": 1.0, "dt": 0.02, "integrator": "bdf2"},
        "fluid": fluid | {"sides": walls | sides},
    }
    scene |= {"gravity": [0.1] * (dim - 1) + [-9.81], "coupling": {"transfer": "cutcell"}}
    if solid:
        box = {"origin": [0.33, 0.13, 0.2][:dim], "size": [0.3, 0.12, 0.18][:dim], "cells": [2] * dim}
        scene["solids"] = {"box": {"shape": {"box": box}, "density": 1200.0, "young": 1e8, "poisson": 0.3}}
    found = {}
    for name, more in SOLVERS.items():
        found[name] = solved(Scene.model_validate(scene), DIRECT if more is None else DEFAULT, *(more or []), steps=2)[
            1
        ]
    last = "solid" if solid else "pressure"
    exact = found.pop("direct")[last]
    for values in found.values():
        shift = 0.0 if solid or sides else np.mean(values[last] - exact)  # of a closed region any constant will do
        np.testing.assert_allclose(values[last] - shift, exact, atol=1e-6 * np.abs(exact).max(initial=1e-6))
