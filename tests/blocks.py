"""A scene that runs in a moment: a block held by its left side falls, without a fluid."""

#: Its two by two elements.
SQUARE = "{ box = { origin = [0.0, 0.0], size = [1.0, 1.0], cells = [2, 2] } }"


def falling_block(end: float, dt: float, gravity: str = "[0.0, -1.0]", shape: str = SQUARE, more: str = "") -> str:
    """Return the scene's text; ``gravity`` and ``shape`` are TOML, ``more`` are tables."""
    return f"""
dim = 2
gravity = {gravity}
[time]
end = {end}
dt = {dt}
[solids.block]
shape = {shape}
density = 20.0
young = 1e4
poisson = 0.3
supports = [{{ where = "left", fix = ["x", "y"] }}]
{more}
"""
