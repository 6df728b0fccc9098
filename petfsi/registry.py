"""What scenes may name, and where it lives: a new fluid, coupling, material or integrator is a line here."""

from __future__ import annotations

from importlib import import_module
from typing import Any

FLUIDS = {
    "mac": "petfsi.fields.mac.fluid:MacFluid",
    "sph": "petfsi.fields.sph.fluid:SphFluid",
}
COUPLINGS = {
    "cutcell": "petfsi.couplings.cutcell:CutCellCoupling",
    "ray": "petfsi.couplings.ray:RayCoupling",
    "pressure": "petfsi.couplings.particles:PressureTransfer",
    "repulsion": "petfsi.couplings.repulsion:RepulsionTransfer",
}
INTEGRATORS = {
    "newmark": "petfsi.integrators:Newmark",
    "bdf2": "petfsi.integrators:Bdf2",
    "midpoint": "petfsi.integrators:Midpoint",
    "symplectic-euler": "petfsi.integrators:SymplecticEuler",
    "static": "petfsi.integrators:Static",
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
