"""Surfaces through the grid: which cells and faces they cut, divide, cover and leave again."""
