"""The physical parts: fluids and solids, each with its unknowns, block and state."""
