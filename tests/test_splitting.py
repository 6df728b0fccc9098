"""Time splitting, in PETSc options alone: it grows and decays as linear theory says, and iterated it is monolithic."""

import numpy as np
import pytest
from mpi4py import MPI

from petfsi.bench import theory
from petfsi.bench.case import ITERATED, MONOLITHIC, history
from petfsi.bench.splitting import DT, Layer, growth_of_own_matrices, measure_growth
from petfsi.errors import SolveError

COMM = MPI.COMM_SELF
CELLS = 64


@pytest.mark.parametrize(
    ("mass_ratio", "stiffness", "damping", "grows"),
    [
        (1.5, 0.01, (0.0, 0.0), True),
        (3.0, 4.0, (0.5, 0.0), True),
        (1.5, 4.0, (0.0, 0.5), False),
    ],
)
def test_one_mode_grows_as_theory_says(tmp_path, mass_ratio, stiffness, damping, grows):
    layer = Layer.one_mode(mass_ratio, stiffness, damping, CELLS)
    growth = measure_growth(COMM, layer.scene(COMM, tmp_path), steps=12, order=3)
    assert growth == pytest.approx(layer.growth(), rel=0.03)
    assert (growth > 1) == grows


def test_a_soft_mode_grows_by_the_ratio_of_masses_at_any_step():
    for stiffness in (1e-4, 1e-2):
        assert theory.split_growth(1.0, stiffness / DT**2, 3.0, DT) == pytest.approx(3.0, rel=0.005)
    assert theory.split_growth(1.0, 1e-4 / DT**2, 0.9, DT) < 1


def test_the_same_recurrence_holds_of_the_programs_own_matrices(tmp_path):
    """Four elements through the layer, where triangles and one-dimensional elements differ."""
    layer = Layer(density=9000.0, modulus=4e7, stiffness_damping=0.002, elements=4, cells=16)
    scene = layer.scene(COMM, tmp_path)
    assert measure_growth(COMM, scene, steps=100, order=6) == pytest.approx(growth_of_own_matrices(scene), rel=1e-5)


@pytest.mark.parametrize("factor", [0.3, 0.7])
def test_iterated_splitting_is_the_monolithic_solve(tmp_path, factor):
    layer = Layer.one_mode(factor * 1.25, 0.5, (0.0, 0.0), CELLS)
    scene = layer.scene(COMM, tmp_path)
    reference = history(COMM, scene, MONOLITHIC, 10)
    iterated = history(COMM, scene, ITERATED, 10)
    assert np.abs(iterated - reference).max() < 1e-7 * np.abs(reference).max()


def test_iterated_splitting_that_expands_is_an_error(tmp_path):
    layer = Layer.one_mode(2.0 * 1.25, 0.5, (0.0, 0.0), CELLS)
    assert theory.contraction(layer.mass, layer.stiffness, layer.added_mass, DT) == pytest.approx(2.0)
    with pytest.raises(SolveError, match="DIVERGED_DTOL"):
        history(COMM, layer.scene(COMM, tmp_path), ITERATED, 3)
