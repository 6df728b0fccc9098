"""From a scene to its fields and couplings; what a scene does not contain is not imported."""

from __future__ import annotations

from importlib import import_module

from mpi4py import MPI

from petfsi.couplings.base import Coupling
from petfsi.fields.base import Field, SolidField
from petfsi.scene.schema import Scene

#: Where each kind of field and coupling lives; a new one is its file and a line here. Kinds of solids are joined.
FLUIDS = {"mac": "petfsi.fields.mac.fluid:MacFluid"}
SOLIDS = {
    "simplex": "petfsi.fields.solid.solid:SimplexSolid",
    "timoshenko": "petfsi.fields.beam.beam:BeamSolid",
    "euler-bernoulli": "petfsi.fields.beam.beam:BeamSolid",
}
JOINT = "petfsi.fields.joint:JointSolid"
COUPLINGS = {
    "cutcell": "petfsi.couplings.cutcell:CutCellCoupling",
    "ray": "petfsi.couplings.ray:RayCoupling",
}


def _class(place: str) -> type:
    module, name = place.split(":")
    return getattr(import_module(module), name)


def build_fields(comm: MPI.Comm, scene: Scene) -> list[Field]:
    """Return the scene's fields, in the order of the nest: solid, pressure. Collective."""
    fields: list[Field] = []
    if scene.solids:
        fields.append(_build_solid(comm, scene))
    if scene.fluid:
        fields.append(_class(FLUIDS[scene.fluid.kind])(comm, scene))
    return fields


def _build_solid(comm: MPI.Comm, scene: Scene) -> SolidField:
    """Return all solids of the scene as one field, those of each kind in a field of its own where there are several."""
    kinds = {name: solid.shape.beam.theory if solid.shape.beam else "simplex" for name, solid in scene.solids.items()}
    present = list(dict.fromkeys(kinds.values()))
    if len(present) == 1:
        return _class(SOLIDS[present[0]])(comm, scene)
    return _class(JOINT)(comm, scene, kinds, {kind: _class(SOLIDS[kind]) for kind in present})


def build_couplings(scene: Scene, fields: list[Field]) -> list[Coupling]:
    """Return the couplings between the scene's fields. Collective."""
    if len(fields) < 2:
        return []
    solid, fluid = fields
    return [_class(COUPLINGS[scene.coupling.transfer])(fluid, solid, scene.coupling)]
