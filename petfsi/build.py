"""From a scene to its fields and couplings; what a scene does not contain is not imported."""

from __future__ import annotations

from importlib import import_module

from mpi4py import MPI

from petfsi.couplings.base import Coupling
from petfsi.fields.base import Field
from petfsi.scene.schema import Scene

#: Where each kind of field and coupling lives; a new one is its file and a line here.
FLUIDS = {"mac": "petfsi.fields.mac.fluid:MacFluid"}
SOLIDS = {"simplex": "petfsi.fields.solid.solid:SimplexSolid", "beam": "petfsi.fields.beam.beam:BeamSolid"}
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
        kind = "beam" if any(solid.shape.beam for solid in scene.solids.values()) else "simplex"
        fields.append(_class(SOLIDS[kind])(comm, scene))
    if scene.fluid:
        fields.append(_class(FLUIDS[scene.fluid.kind])(comm, scene))
    return fields


def build_couplings(scene: Scene, fields: list[Field]) -> list[Coupling]:
    """Return the couplings between the scene's fields. Collective."""
    if len(fields) < 2:
        return []
    solid, fluid = fields
    return [_class(COUPLINGS[scene.coupling.transfer])(fluid, solid, scene.coupling)]
