"""A stiff disk or ball let go in a round container of water: the first acceleration, against potential theory."""

import math

import pytest
from mpi4py import MPI

from petfsi.bench.case import MONOLITHIC, history, job


def first_acceleration(scene):
    """Return (m_s - m_f) g / (m_s + m_a) of a body of radius R at the centre of a container of radius B."""
    (body,) = scene.solids.values()
    R, B, rho = body.shape.ball.radius, scene.obstacles["container"].shape.ball.radius, scene.fluid.density
    d = scene.dim
    volume = {2: math.pi * R**2, 3: 4 / 3 * math.pi * R**3}[d]
    added = rho * volume / (d - 1) * (B**d + (d - 1) * R**d) / (B**d - R**d)
    solid, displaced = body.density * volume, rho * volume
    return (solid - displaced) * scene.gravity[1] / (solid + added)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("transfer, accuracy", [("cutcell", 5e-3), ("ray", 0.1)])
@pytest.mark.parametrize(
    "name, wanted, sets",
    [
        ("disk", -2.9015, {}),
        ("ball", -3.7694, {"fluid.cells": [32, 32, 32], "solids.ball.shape.ball.cells": 10}),
    ],
)
def test_the_first_acceleration_is_that_of_theory(name, wanted, sets, transfer, accuracy):
    """The ray transfer takes all or nothing of cells that are cut, and so is much farther away."""
    scene = job(MPI.COMM_WORLD, f"added-mass-{name}", {**sets, "coupling.transfer": transfer})
    assert first_acceleration(scene) == pytest.approx(wanted, abs=6e-5)
    velocity = history(MPI.COMM_WORLD, scene, MONOLITHIC, 1, "centre.y")[1]
    assert velocity / scene.time.dt == pytest.approx(first_acceleration(scene), rel=accuracy)
