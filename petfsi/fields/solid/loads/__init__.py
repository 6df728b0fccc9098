"""Body forces, tractions, pressures and forces at points, dead or turning with the surface."""

from petfsi.fields.solid.loads.loads import Body, Loads

__all__ = ["Body", "Loads"]
