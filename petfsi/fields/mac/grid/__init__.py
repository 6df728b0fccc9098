"""The regular staggered grid and its sides: who owns what of it, and what its cells and faces are."""
