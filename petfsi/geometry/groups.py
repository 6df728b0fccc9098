"""The groups that mesh files know, by name or number: gmsh's, medit's, MED's, Abaqus's, FEniCS's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from petfsi.geometry.splitting import KINDS

if TYPE_CHECKING:
    import meshio

#: Numbers by cell or point that name groups, those that come first before the others.
_NUMBERS = ("gmsh:physical", "medit:ref", "cell_tags", "point_tags")
#: What numbers else there may be and mean something else.
_NO_GROUPS = ("gmsh:geometrical", "gmsh:dim_tags", "obj:group_ids")
#: Numbers that have more values than this are no groups.
MOST = 10_000


def cell_groups(mesh: meshio.Mesh, dim: int) -> dict[str, list[np.ndarray]]:
    """Return the groups of cells of a dimension: by name, the numbers of those in it within each block.

    Names are those of the format's sets and of gmsh's physical groups; numbers without a name stand for themselves.
    Where no array is known to hold groups, the only array of whole numbers does, as in FEniCS's files.
    """
    names = {int(tag): name for name, (tag, of) in mesh.field_data.items() if int(of) == dim}
    fits = [block.type in KINDS and KINDS[block.type].dim == dim for block in mesh.cells]
    groups: dict[str, list[np.ndarray]] = {}

    def add(name: str, n: int, chosen: np.ndarray) -> None:
        if fits[n] and len(chosen):
            of = groups.setdefault(name, [np.zeros(0, dtype=np.int64)] * len(fits))
            of[n] = np.union1d(of[n], chosen) if len(of[n]) else np.asarray(chosen, dtype=np.int64)

    for name, sets in mesh.cell_sets.items():
        for n, chosen in enumerate(sets):
            if not name.startswith("gmsh:") and chosen is not None:
                add(name, n, np.asarray(chosen))
    tags = _numbers(mesh.cell_data)
    for n in range(len(mesh.cells)) if tags else ():
        for value, chosen in _by_number(mesh.cell_data[tags][n]) if fits[n] else ():
            for name in _named(names, getattr(mesh, "cell_tags", None), value):
                add(name, n, chosen)
    return groups


def point_groups(mesh: meshio.Mesh) -> dict[str, np.ndarray]:
    """Return the groups of points, by name the numbers of the points."""
    names = {int(tag): name for name, (tag, of) in mesh.field_data.items() if int(of) == 0}
    groups = {name: np.asarray(points, dtype=np.int64).ravel() for name, points in mesh.point_sets.items()}
    tags = next((name for name in _NUMBERS if name in mesh.point_data), None)
    for value, chosen in _by_number(mesh.point_data[tags]) if tags else ():
        for name in _named(names, getattr(mesh, "point_tags", None), value):
            groups.setdefault(name, chosen)
    return groups


def _by_number(values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yield each number but 0 and where it stands; none of so many that they cannot mean groups."""
    values = np.asarray(values)
    order = np.argsort(values, kind="stable")
    found, first = np.unique(values[order], return_index=True)
    if 0 < len(found) <= MOST:
        for value, chosen in zip(found, np.split(order, first[1:]), strict=True):
            if value != 0 and np.isfinite(value):
                yield int(value), chosen


def _numbers(data: dict[str, list[np.ndarray]]) -> str | None:
    """Return the name of the array that holds groups."""
    for name in _NUMBERS:
        if name in data:
            return name
    whole = [name for name, arrays in data.items() if name not in _NO_GROUPS and all(map(_is_whole, arrays))]
    return whole[0] if len(whole) == 1 else None


def _is_whole(array: np.ndarray) -> bool:
    return np.ndim(array) == 1 and np.issubdtype(np.asarray(array).dtype, np.integer)


def _named(names: dict[int, str], families: dict[int, list[str]] | None, value: int) -> list[str]:
    """Return the names of a number: MED's families may be in several groups."""
    if families:
        return families.get(value) or []
    return [names.get(value, str(value))]
