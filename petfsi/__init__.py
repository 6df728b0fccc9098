"""Fluids and deformable solids that move each other, solved with PETSc."""

__version__ = "0.1.0"
