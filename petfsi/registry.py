"""What scenes may name, and where it lives: a new fluid, coupling or material is its file and a line here."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple


class FluidKind(NamedTuple):
    """Where a kind of fluid has its field, its table in a scene, its part of the plan, and what it has no need of."""

    field: str
    table: str
    plan: str
    skipped: str


FLUIDS = {
    "mac": FluidKind(
        "petfsi.fields.mac.fluid:MacFluid",
        "petfsi.scene.fluids:MacFluid",
        "petfsi.runs.plan_fluids:grid_plan",
        "petfsi.runs.plan_fluids:grid_skipped",
    ),
    "sph": FluidKind(
        "petfsi.fields.sph.fluid:SphFluid",
        "petfsi.scene.fluids:SphFluid",
        "petfsi.runs.plan_fluids:particle_plan",
        "petfsi.runs.plan_fluids:particle_skipped",
    ),
}
#: By the kind of fluid, the default first.
COUPLINGS = {
    "mac": {
        "cutcell": "petfsi.couplings.cutcell:CutCellCoupling",
        "ray": "petfsi.couplings.ray:RayCoupling",
    },
    "sph": {
        "pressure": "petfsi.couplings.particles:PressureTransfer",
        "repulsion": "petfsi.couplings.repulsion:RepulsionTransfer",
    },
}
INTEGRATORS = {
    "newmark": "petfsi.integrators.newmark:Newmark",
    "bdf2": "petfsi.integrators.bdf2:Bdf2",
    "midpoint": "petfsi.integrators.midpoint:Midpoint",
    "symplectic-euler": "petfsi.integrators.symplectic:SymplecticEuler",
    "static": "petfsi.integrators.static:Static",
}
MATERIALS = {
    "green": "petfsi.fields.solid.materials.green:green",
    "neohookean": "petfsi.fields.solid.materials.neohookean:neohookean",
    "stable-neohookean": "petfsi.fields.solid.materials.stable:stable_neohookean",
    "linear": "petfsi.fields.solid.materials.linear:linear",
}
#: Materials whose elements may turn inside out on their way: back they come, or strain means nothing to them.
INVERTIBLE = {"stable-neohookean", "linear"}
#: Kinds of solids; those that a scene has several of are joined to one field.
SOLIDS = {
    "simplex": "petfsi.fields.solid.solid:SimplexSolid",
    "timoshenko": "petfsi.fields.beam.beam:BeamSolid",
    "euler-bernoulli": "petfsi.fields.beam.beam:BeamSolid",
}
JOINT = "petfsi.fields.joint:JointSolid"


def find(place: str) -> Any:
    """Import what stands at ``"module:name"``."""
    module, name = place.split(":")
    return getattr(import_module(module), name)
