"""The openings of a distributed grid that surfaces cut: kinds, openness and unknowns of its cells and faces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.fields.mac.grid import kinds
from petfsi.fields.mac.grid.grid import MacGrid, three
from petfsi.fields.mac.grid.sides import Jet, Surroundings
from petfsi.fields.mac.projection.extras import Extras, Inlets
from petfsi.fields.mac.projection.slivers import Slivers, slivers_of
from petfsi.fields.mac.walls.cut import Links, Walls, Wet, first_moments, links_of, patch_slots, walls_of
from petfsi.fields.mac.walls.jet_cuts import jet_openings
from petfsi.fields.mac.walls.parts import Parts, global_index, owned
from petfsi.geometry.clipping import CutCells, Lattice, cut
from petfsi.geometry.obstacles import ObstacleSurfaces
from petfsi.geometry.seams import Seams, find_seams, together
from petfsi.petsc import IntType, Layout


@dataclass(frozen=True)
class Openings:
    """The grid as surfaces leave it; arrays are local, valid in all ghosts.

    Attributes
    ----------
    cell_kind : ndarray of uint8
    face_kind : list of ndarray of uint8
    openness : list of ndarray
        Open fraction of faces that are not SPLIT, else 0.
    narrow : list of ndarray of bool
        Face arrays, see ``kinds.narrow_faces``.
    volume : ndarray
        Open part of each cell's volume.
    layout : Layout
        Of the unknowns: this rank's cells in the DMDA's order, then its extras.
    index : ndarray of IntType
        Cell array of the unknowns' global numbers.
    extras : Extras or None
        None if no rank has any split cell.
    parts : Parts
        What split cells and their faces consist of.
    walls : Walls
        Slots are global numbers of unknowns; entries of unknowns that are not solved are left out.
    wet : Wet
        About the upper corner of the grid.
    slivers : Slivers
        Of this rank's unknowns that are solved, by their local numbers.
    points : ndarray, shape (n, dim)
        Where the surface was cut, see ``clipping.CutCells``.
    facing : list of ndarray
        Cell arrays by axis: area times normal of the walls in each cell, m^2 (m in 2D).
    """

    cell_kind: np.ndarray
    face_kind: list[np.ndarray]
    openness: list[np.ndarray]
    narrow: list[np.ndarray]
    volume: np.ndarray
    layout: Layout
    index: np.ndarray
    extras: Extras | None
    parts: Parts
    walls: Walls
    wet: Wet
    slivers: Slivers
    points: np.ndarray
    facing: list[np.ndarray]


class CutGrid:
    """Cuts a grid by the surfaces of obstacles, which never move, and of solids.

    Parameters
    ----------
    grid : MacGrid
    surroundings : Surroundings
        The sides; obstacles are not looked at.
    obstacles : ObstacleSurfaces
    """

    def __init__(self, grid: MacGrid, surroundings: Surroundings, obstacles: ObstacleSurfaces) -> None:
        self.grid, self.surroundings, self.obstacles = grid, surroundings, obstacles
        dim = grid.dim
        lo, hi = np.array(grid.lo[:dim]), np.array(grid.hi[:dim])
        free = np.array(grid.periodic[:dim])
        # one layer of ghosts: faces between ranks look at the walls of both their cells
        lo = np.where(free | (lo > 0), lo - 1, lo)
        hi = np.where(free | (hi < np.array(grid.cells[:dim])), hi + 1, hi)
        self.lattice = Lattice(grid.origin, grid.dx, np.array(grid.cells[:dim]), free, lo, hi)
        self.shape = tuple(int(n) for n in hi - lo)
        begin = [int(lo[a]) - grid.lo[a] + grid.ghost[a] for a in range(dim)] + [0] * (3 - dim)
        size = self.shape + (1,) * (3 - dim)
        self._box = tuple(slice(b, b + n) for b, n in zip(begin, size, strict=True))
        self._sides = [self._part(surroundings.side_kind[a], a) for a in range(dim)]
        self._flat = np.arange(int(np.prod(grid.shape(None)))).reshape(grid.shape(None))[self._box].reshape(-1)
        self._flat_faces = [
            self._part(np.arange(int(np.prod(grid.shape(a)))).reshape(grid.shape(a)), a).reshape(-1) for a in range(dim)
        ]
        own = np.zeros(grid.shape(None), dtype=bool)
        own[grid.owned(None)] = True
        self._own = own.reshape(-1)[self._flat]  # a ghost may stand for a cell of this rank: only that one counts
        self._covered = np.zeros(grid.shape(None), dtype=bool)
        static = self.cut(np.zeros((0, dim)), np.zeros((0, dim), dtype=np.int64))
        self._covered = static.cell_kind == kinds.SOLID

    def _part(self, array: np.ndarray, axis: int | None) -> np.ndarray:
        """Return the box's part of a local array of faces of ``axis`` (cells: None), without the third axis in 2D."""
        part = tuple(slice(s.start, s.stop + (b == axis)) for b, s in enumerate(self._box))
        view = array[part]
        return view if self.grid.dim == 3 else view[:, :, 0]

    def cut(
        self, points: np.ndarray, facets: np.ndarray, part: np.ndarray | None = None, seams: Seams | None = None
    ) -> Openings:
        """Return the openings that obstacles and a surface leave. Collective.

        Parameters
        ----------
        points : ndarray, shape (n, dim)
            The surface's points, the same on all ranks.
        facets : ndarray of int, shape (m, dim)
        part : ndarray of int8, shape (m,), or None
            As in ``quadratic.Curved``; None if no facet is part of a quadratic one.
        seams : Seams or None
            Where the surface reaches around periodic axes. In the answer facets are numbered among its walls.
        """
        grid, still = self.grid, self.obstacles
        if seams is None:
            seams = find_seams(points, facets, grid.size, np.array(grid.periodic[: grid.dim]))
        n_points, n_moving = len(points), len(seams.walls)
        points = seams.closed(points, grid.size, grid.dx)
        surface = np.concatenate((points, still.points)), np.concatenate((facets, still.facets + n_points))
        if part is not None:
            part = np.concatenate((part, np.full(len(still.facets), -1, dtype=part.dtype)))
        found = cut(*surface, self.lattice, still.base, part, together(seams, still.seams, n_points, len(facets)))
        every = links_of(found, self.shape)
        shut = self._through_walls(every)
        links = every.where(~shut)
        slot = patch_slots(found, len(self._flat))
        walls = walls_of(found, slot, n_moving)
        whole = self._whole_openings(found)
        openness, split = self._openness(whole, links)
        volume = grid.zeros_cells()
        self._part(volume, None)[...] = found.volume
        grid.exchange_cells(volume)
        cell_kind, face_kind = self._kinds(openness, split)
        through = every.where(shut)
        if any(jet.divides for jet in self.surroundings.jets):
            walled = surface[1][together(seams, still.seams, n_points, len(facets)).walls]
            through = replace(through, openness=self._to_jets(found, walled, through))
        layout, index, extras, parts, numbers = self._number(found, links, through)
        active = cell_kind.reshape(-1)[self._flat] == kinds.FLUID
        solved = np.concatenate((self._own & active, self._own[found.extra_cell]))
        used = np.flatnonzero(solved[walls.slot])
        walls = Walls(walls.facet[used], walls.axis[used], numbers[walls.slot[used]], walls.flux[used])
        slivers = slivers_of(found, slot, n_moving, links, grid.dx, len(numbers))
        used = np.flatnonzero(solved[slivers.slot])
        slivers = Slivers(numbers[slivers.slot[used]] - layout.start, slivers.size[used], slivers.normal[used])
        patches = np.flatnonzero(solved[slot] & (found.facet < n_moving))
        wet = first_moments(found, patches, self._centres(found.cell[patches]))
        narrow = self._narrow(whole, face_kind)
        return Openings(
            cell_kind,
            face_kind,
            openness,
            narrow,
            volume,
            layout,
            index,
            extras,
            parts,
            walls,
            wet,
            slivers,
            found.points[:n_points],
            self._facing(found),
        )

    def _to_jets(self, found: CutCells, facets: np.ndarray, links: Links) -> np.ndarray:
        """Return how open links through sides are to jets, see ``jet_cuts``."""
        around = self.surroundings
        return jet_openings(found, facets, self.lattice, links, around.jets, around.fluid, self._box_faces)

    def _box_faces(self, jet: Jet) -> np.ndarray:
        """Return the flat indices of a jet's faces in the box; -1 beyond it."""
        dim, faces = self.grid.dim, self._flat_faces[jet.axis]
        local = np.ravel_multi_index(jet.faces, self.grid.shape(jet.axis))
        place = np.array(jet.faces[:dim]) - np.array([s.start for s in self._box[:dim]])[:, None]
        shape = np.array(self.shape) + (np.arange(dim) == jet.axis)
        inside = np.all((place >= 0) & (place < shape[:, None]), axis=0)
        flat = np.full(len(local), -1, dtype=np.int64)
        flat[inside] = np.ravel_multi_index(tuple(place[:, inside]), tuple(shape))
        assert np.array_equal(faces[flat[inside]], local[inside])
        return flat

    def _facing(self, found: CutCells) -> list[np.ndarray]:
        """Return where the walls of each cell face. Collective."""
        mine = np.flatnonzero(self._own[found.cell])
        area, at = found.integrals[mine].sum(axis=1), self._flat[found.cell[mine]]
        arrays = []
        for a in range(self.grid.dim):
            array = self.grid.zeros_cells()
            np.add.at(array.reshape(-1), at, area * found.normals[found.facet[mine], a])
            self.grid.exchange_cells(array)
            arrays.append(array)
        return arrays

    def _whole_openings(self, found: CutCells) -> list[np.ndarray]:
        """Return the open fractions of local faces by axis, split or not. Collective."""
        openings = []
        for a in range(self.grid.dim):
            whole = self.grid.zeros_faces(a)
            self._part(whole, a)[...] = found.open[a]
            self.grid.exchange_faces(a, whole)
            openings.append(whole)
        return openings

    def _openness(self, whole: list[np.ndarray], links: Links) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the openness of local faces by axis, zero where split, and which are split (flat). Collective."""
        openness, split = [], []
        for a in range(self.grid.dim):
            torn = np.unique(self._flat_faces[a][links.face[(links.axis == a) & links.split]])
            opening = whole[a]
            if self.grid.comm.allreduce(len(torn) > 0, op=MPI.LOR):
                opening = opening.copy()
                opening.reshape(-1)[torn] = 0.0
                self.grid.exchange_faces(a, opening)
            openness.append(opening)
            split.append(torn)
        return openness, split

    def _centres(self, cell: np.ndarray) -> np.ndarray:
        """Return the centres of cells of the box from the upper corner of the grid, (n, dim)."""
        grid = self.grid
        index = np.stack(np.unravel_index(cell, self.shape), axis=1) + self.lattice.lo
        return (index + 0.5) * grid.dx - grid.size

    def _through_walls(self, links: Links) -> np.ndarray:
        """Return which links go through sides that no pressure acts on: those faces are just as open as they are."""
        shut = np.zeros(len(links.axis), dtype=bool)
        for a, kind in enumerate(self._sides):
            beyond = np.flatnonzero((links.axis == a) & ((links.below < 0) | (links.above < 0)))
            shut[beyond] = kind.reshape(-1)[links.face[beyond]] != kinds.OPEN
        return shut

    def _kinds(self, openness: list[np.ndarray], split: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the kinds of cells and faces. Collective."""
        grid, surroundings = self.grid, self.surroundings
        face_kind = []
        for a in range(grid.dim):
            kind = np.zeros(grid.shape(a), dtype=np.uint8)
            _face_kinds(surroundings.cell_kind, surroundings.side_kind[a], openness[a], kinds.STEP[a], kind)
            kind.reshape(-1)[split[a]] = kinds.SPLIT
            grid.exchange_faces(a, kind)
            face_kind.append(kind)
        cell_kind = surroundings.cell_kind.copy()
        _cell_kinds(*three(face_kind), grid.dim == 2, cell_kind)
        grid.exchange_cells(cell_kind)
        cell_kind[(cell_kind == kinds.SOLID) & self._covered] = kinds.OBSTACLE
        return cell_kind, face_kind

    def _narrow(self, openness: list[np.ndarray], face_kind: list[np.ndarray]) -> list[np.ndarray]:
        """Return which faces of each axis are narrow. Collective."""
        found = []
        for a in range(self.grid.dim):
            narrow = self.grid.zeros_faces(a, bool)
            across = tuple(step for b, step in enumerate(kinds.STEP[: self.grid.dim]) if b != a)
            kinds.narrow_faces(openness[a], face_kind[a], across, narrow)
            self.grid.exchange_faces(a, narrow)
            found.append(narrow)
        return found

    def _number(
        self, found: CutCells, links: Links, through_walls: Links
    ) -> tuple[Layout, np.ndarray, Extras | None, Parts, np.ndarray]:
        """Return layout, cell numbers, extras, parts, and the global number of each slot. Collective."""
        grid = self.grid
        if not grid.comm.allreduce(bool(len(found.extra_cell) or links.split.any()), op=MPI.LOR):
            # walls say what becomes of pieces: of all cells, because a whole one may be divided when it is cut next
            parts = Parts.gathered(grid, np.zeros((0, 3)), np.zeros((0, 5)), self._wall_areas(found))
            return grid.layout, grid.index, None, parts, grid.index.reshape(-1)[self._flat]
        local = self._flat[found.extra_cell]
        mine = np.flatnonzero(self._own[found.extra_cell])
        layout = Layout.of(grid.comm, grid.layout.n_local + len(mine))
        index = np.full(grid.shape(None), -1, dtype=IntType)
        grid.from_vec(layout.start + np.arange(grid.layout.n_local, dtype=IntType), index)
        grid.exchange_cells(index)
        # whose ghost cell is split finds the owner's number by the cell's and the piece's
        key = index.reshape(-1)[local].astype(np.int64) * (1 << 20) + found.extra_piece
        own = layout.start + grid.layout.n_local + np.arange(len(mine), dtype=np.int64)
        keys, every = (np.concatenate(grid.comm.allgather(part)) for part in (key[mine], own))
        order = np.argsort(keys)
        extra = every[order[np.searchsorted(keys[order], key)]]
        numbers = np.concatenate((index.reshape(-1)[self._flat].astype(np.int64), extra))
        pieces = local[mine], found.extra_piece[mine], found.extra_volume[mine]
        parts, columns = self._split_links(found, links, numbers)
        inlets = self._inlets(found, through_walls, numbers - layout.start)
        return layout, index, Extras(inlets, *pieces, *columns), parts, numbers

    def _inlets(self, found: CutCells, links: Links, local: np.ndarray) -> Inlets:
        """Return what sides with a given velocity let into further pieces; ``local`` are the slots' local numbers."""
        slot, n_box = np.maximum(links.below, links.above), len(self._own)
        own = np.concatenate((self._own, self._own[found.extra_cell]))
        use = np.flatnonzero((slot >= n_box) & own[slot])
        slot, axis, face = slot[use], links.axis[use], np.empty(len(use), dtype=np.int64)
        for a, faces in enumerate(self._flat_faces):
            face[axis == a] = faces[links.face[use[axis == a]]]
        inward = np.where(links.below[use] < 0, 1.0, -1.0) * links.openness[use]
        return Inlets(local[slot], local[found.extra_cell[slot - n_box]], axis, face, inward)

    def _split_links(self, found: CutCells, links: Links, numbers: np.ndarray) -> tuple[Parts, tuple[np.ndarray, ...]]:
        """Return all ranks' parts, and what ``Extras`` says of links, in the same order on any ranks. Collective."""
        grid = self.grid
        torn = np.flatnonzero(links.split)
        own = np.concatenate((self._own, self._own[found.extra_cell]))
        piece = np.concatenate((np.zeros(len(self._own), dtype=np.int64), found.extra_piece))
        ends = links.below[torn], links.above[torn]
        below, above = (np.where(slot >= 0, numbers[slot], -1) for slot in ends)
        names = [np.where(slot >= 0, piece[slot], -1) for slot in ends]
        mine_below, mine_above = ((slot >= 0) & own[slot] for slot in ends)
        axis, face, opening = links.axis[torn], np.empty(len(torn), dtype=np.int64), links.openness[torn]
        natural, is_owned = np.empty(len(torn), dtype=np.int64), np.zeros(len(torn), dtype=bool)
        for a, faces in enumerate(self._flat_faces):
            here = axis == a
            face[here] = faces[links.face[torn[here]]]
        use = mine_below | mine_above
        for a in range(grid.dim):
            here = np.flatnonzero((axis == a) & use)
            natural[here], is_owned[here] = global_index(grid, a, face[here]), owned(grid, a, face[here])
        table = np.column_stack((axis, natural, *names, opening))[use & is_owned]
        parts = Parts.gathered(grid, self._split_pieces(found), table, self._wall_areas(found))
        use = np.flatnonzero(use)
        row = parts.rows(axis[use], natural[use], names[0][use], names[1][use])
        order = use[np.argsort(row, kind="stable")]
        columns = (axis, face, below, above, mine_below, mine_above, opening)
        return parts, (*(column[order] for column in columns), np.sort(row), is_owned[order])

    def _split_pieces(self, found: CutCells) -> np.ndarray:
        """Return cell, piece and volume of this rank's further pieces, shape (n, 3)."""
        mine = np.flatnonzero(self._own[found.extra_cell])
        cell = global_index(self.grid, None, self._flat[found.extra_cell[mine]])
        return np.column_stack((cell, found.extra_piece[mine], found.extra_volume[mine]))

    def _wall_areas(self, found: CutCells) -> np.ndarray:
        """Return cell, piece, facet and area of the walls of this rank's cells, shape (n, 4)."""
        mine = np.flatnonzero(self._own[found.cell])
        cell = global_index(self.grid, None, self._flat[found.cell[mine]])
        return np.column_stack((cell, found.piece[mine], found.facet[mine], found.integrals[mine].sum(axis=1)))


@njit(cache=True)
def _face_kinds(cell_kind, side_kind, openness, step, face_kind):
    """Write the kind of every local face whose two cells are local, too, but for SPLIT ones."""
    di, dj, dk = step
    n0, n1, n2 = cell_kind.shape
    for i in range(di, n0):
        for j in range(dj, n1):
            for k in range(dk, n2):
                if openness[i, j, k] == 0.0:
                    continue
                below = cell_kind[i - di, j - dj, k - dk] == kinds.OUTSIDE
                above = cell_kind[i, j, k] == kinds.OUTSIDE
                if below and above:
                    continue
                face_kind[i, j, k] = side_kind[i, j, k] if below or above else kinds.PRESSURE


@njit(cache=True)
def _cell_kinds(kind0, kind1, kind2, flat, cell_kind):
    """Turn cells of the domain without any open face into SOLID."""
    n0, n1, n2 = cell_kind.shape
    for i in range(n0):
        for j in range(n1):
            for k in range(n2):
                if cell_kind[i, j, k] == kinds.OUTSIDE:
                    continue
                shut = _shut(kind0[i, j, k]) and _shut(kind0[i + 1, j, k])
                shut = shut and _shut(kind1[i, j, k]) and _shut(kind1[i, j + 1, k])
                shut = shut and (flat or (_shut(kind2[i, j, k]) and _shut(kind2[i, j, k + 1])))
                cell_kind[i, j, k] = kinds.SOLID if shut else kinds.FLUID


@njit(cache=True)
def _shut(kind):
    return kind == kinds.DEAD or kind == kinds.WALL
