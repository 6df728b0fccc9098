"""Deformable solids of linear simplices."""

from petfsi.fields.solid.solid import SimplexSolid

__all__ = ["SimplexSolid"]
