"""From a scene to its fields and couplings; what a scene does not contain is not imported."""

from __future__ import annotations

from mpi4py import MPI

from petfsi.couplings.base import Coupling
from petfsi.fields.base import Field
from petfsi.fields.solids import SolidField
from petfsi.registry import COUPLINGS, FLUIDS, JOINT, SOLIDS, find
from petfsi.scene.schema import Scene


def build_fields(comm: MPI.Comm, scene: Scene) -> list[Field]:
    """Return the scene's fields, in the order of the nest: solid, pressure. Collective."""
    fields: list[Field] = []
    if scene.solids:
        fields.append(_build_solid(comm, scene))
    if scene.fluid:
        fields.append(find(FLUIDS[scene.fluid.kind].field)(comm, scene))
    return fields


def _build_solid(comm: MPI.Comm, scene: Scene) -> SolidField:
    """Return all solids of the scene as one field, those of each kind in a field of its own where there are several."""
    kinds = {name: solid.shape.beam.theory if solid.shape.beam else "simplex" for name, solid in scene.solids.items()}
    present = list(dict.fromkeys(kinds.values()))
    if len(present) == 1:
        return find(SOLIDS[present[0]])(comm, scene)
    return find(JOINT)(comm, scene, kinds, {kind: find(SOLIDS[kind]) for kind in present})


def build_couplings(scene: Scene, fields: list[Field]) -> list[Coupling]:
    """Return the couplings between the scene's fields. Collective."""
    if len(fields) < 2:
        return []
    assert scene.fluid is not None
    solid, fluid = fields
    return [find(COUPLINGS[scene.fluid.kind][scene.transfer])(fluid, solid, scene.coupling)]
