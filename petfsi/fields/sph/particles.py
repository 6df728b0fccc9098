"""A set of particles shared out among ranks by place: order, migration, ghosts, and the way into a file and back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.errors import SolveError
from petfsi.fields.slabs import Reader, Slab, State, scalar_slab
from petfsi.fields.sph.balance import Boxes, bisect, is_better, is_uneven, located, seen
from petfsi.fields.sph.cells import CellGrid, sorted_rows
from petfsi.fields.sph.transport import Packing, Traffic, ship
from petfsi.fields.stored import EXACT, outside, refuse


class StrayError(SolveError):
    """Particles are outside the grid of cells, or nowhere (NaN); raised on all ranks alike.

    Attributes
    ----------
    id : int
        Of the one with the smallest id.
    place : ndarray, shape (dim,)
        Where it is, m.
    n_strays : int
        How many there are.
    """

    def __init__(self, id: int, place: np.ndarray, n_strays: int):
        more = f" and {n_strays - 1} more are" if n_strays > 1 else " is"
        at = ", ".join(f"{c:g}" for c in place)
        super().__init__(f"particle {id} at ({at}){more} outside of what the fluid's grid of cells covers")
        self.id, self.place, self.n_strays = id, place, n_strays


class Swarm:
    """Particles of one kind, each owned by the rank whose box of cells it is in, with ghosts from around the box.

    Rows are sorted by (cell, id), ghosts among the owned; cells are numbered lexicographically, the last axis fastest,
    in the rank's box grown by one cell. So the rows of any cell, and the order of cells, do not depend on the number
    of ranks. Ghosts are the particles of the cells around the box, across periodic axes as images moved by a period.

    ``rebuild`` makes all this, for the places of that moment; until the next time rows stay what they are, wherever
    particles go, and ``exchange`` gives ghosts the present values of their owners. Arrays are others after ``rebuild``,
    ``insert``, ``remove`` and ``restore``: ask for them again.

    Attributes
    ----------
    grid : CellGrid
    boxes : Boxes
        Who owns which cells; two sets that share the object lie on the same ranks.
    owned : ndarray of bool, shape (n,)
    first : ndarray of int64, shape (n_cells + 1,)
        The rows of local cell c are ``first[c]:first[c + 1]``.
    counts : ndarray of int, shape (dim,)
        Numbers of local cells: of the box, grown by one cell on either side.
    corner : ndarray of int, shape (dim,)
        The first local cell, in the grid's indices; may be -1.
    is_sorted : bool
        Whether rows are as ``rebuild`` leaves them; else they are in no order, and ``first`` is not valid.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        grid: CellGrid,
        columns: Mapping[str, tuple[int | tuple[()], type]],
        boxes: Boxes | None = None,
    ):
        """Make a set without particles. Collective.

        Parameters
        ----------
        comm : MPI.Comm
        grid : CellGrid
        columns : mapping of str to (width, dtype)
            What each particle has: shape (n,) where the width is ``()``, else (n, width). "id" (int64, not negative,
            no two alike) and "x" (m) are always there.
        boxes : Boxes, optional
            Those of another set on the same grid; by default the cells are shared out evenly.
        """
        self.comm, self.grid = comm, grid
        dim = len(grid.counts)
        spec = {"id": ((), np.int64), "x": (dim, np.float64), **columns}
        shapes = {name: width if isinstance(width, tuple) else (width,) for name, (width, _) in spec.items()}
        self._kinds: dict[str, tuple[np.dtype, tuple[int, ...]]] = {
            name: (np.dtype(dtype), shapes[name]) for name, (_, dtype) in spec.items()
        }
        if self._kinds["id"] != (np.int64, ()) or self._kinds["x"] != (np.float64, (dim,)):
            raise ValueError(f"particles of a grid in {dim}D have id () int64 and x ({dim},) float64")
        if any(dtype.itemsize != 8 for dtype, _ in self._kinds.values()):
            raise ValueError("particles have columns of numbers of 8 bytes")
        self._packings: dict[tuple[str, ...], Packing] = {}
        self._columns = {name: np.zeros((0, *shape), dtype) for name, (dtype, shape) in self._kinds.items()}
        self._forget_ghosts()
        self.first = np.zeros(1, dtype=np.int64)
        self._lie_in(boxes if boxes is not None else bisect(comm, grid, np.zeros((0, dim), dtype=np.int64)))

    # ---- what there is -------------------------------------------------------------------------------------------

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the column of that name, shape (n,) or (n, width): not a copy."""
        return self._columns[name]

    def __setitem__(self, name: str, values: np.ndarray | float) -> None:
        """Write values into a column, in place."""
        if values is not self._columns[name]:
            self._columns[name][...] = values

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        """Return the number of rows n: owned and ghosts."""
        return len(self.owned)

    @property
    def n_owned(self) -> int:
        """Number of this rank's own particles."""
        return len(self) - len(self._ghosts)

    def insert(self, rows: Mapping[str, np.ndarray]) -> None:
        """Add particles to this rank's own, wherever they are; columns not given are zero. Not collective."""
        self._drop_ghosts()
        n = len(rows["id"])
        for name, (dtype, shape) in self._kinds.items():
            new = np.asarray(rows.get(name, np.zeros((n, *shape))), dtype).reshape(n, *shape)
            self._columns[name] = np.concatenate([self._columns[name], new])
        self._forget_ghosts()

    def remove(self, rows: np.ndarray) -> None:
        """Take out the owned ones of these rows, a mask of shape (n,). Not collective; rows are not sorted then."""
        self._keep(np.flatnonzero(self.owned & ~rows))

    def _drop_ghosts(self) -> None:
        if len(self._ghosts):
            self._keep(np.flatnonzero(self.owned))

    def _keep(self, rows: np.ndarray) -> None:
        for name, column in self._columns.items():
            self._columns[name] = column[rows]
        self._forget_ghosts()

    def _forget_ghosts(self) -> None:
        """Declare all rows owned ones, in no order."""
        self.is_sorted = False
        self.owned = np.ones(len(self._columns["id"]), dtype=bool)
        self._ghosts = self._shown = np.zeros(0, dtype=np.int64)

    # ---- order, migration, ghosts ----------------------------------------------------------------------------------

    def balanced(self) -> Boxes:
        """Return ``boxes``, or better ones if the ranks have become too uneven, for ``rebuild``. Collective.

        What counts is who owned how many after the last rebuild; after others have come or gone, who will.
        """
        if self.comm.size == 1:
            return self.boxes
        n, is_sorted = np.array(self.comm.allgather((self.n_owned, self.is_sorted))).T
        if not is_sorted.all():
            self._wrap()
            owners = self.boxes.owner(self._cells(np.flatnonzero(self.owned)))
            self.comm.Allreduce(np.bincount(owners[owners >= 0], minlength=self.comm.size), n := np.empty_like(n))
        if not is_uneven(n):
            return self.boxes
        boxes = self._bisected()
        return boxes if is_better(boxes, n) else self.boxes

    def rebuild(self, boxes: Boxes | None = None) -> None:
        """Bring all particles to their owners, fetch ghosts, sort. Collective.

        Along periodic axes, owned particles are put back into the grid.

        Parameters
        ----------
        boxes : Boxes, optional
            Who owns which cells from now on.

        Raises
        ------
        StrayError
            On all ranks, where a particle is outside the grid; all are still there, and where they were. Nothing but
            another ``rebuild``, ``insert``, ``remove`` or ``restore`` can follow.
        """
        self.is_sorted = False
        if boxes is not None and boxes is not self.boxes:
            self._lie_in(boxes)
        self._wrap()
        grid = self.grid
        rows, cells, leaving = located(self["x"], self.owned, grid.low, grid.side, self.corner, self.counts)
        arrived = self._migrate(leaving)
        if len(arrived):
            cells = np.concatenate([cells, self._packed_cells(arrived)])
            rows = np.append(rows, self._append(arrived))
        n_owned, shown = len(rows), rows[:0]
        if self._traffic:
            shown, ghosts, ghost_cells = self._fetch_ghosts(rows, cells)
            cells = np.concatenate([cells, ghost_cells])
            rows = np.append(rows, self._append(ghosts))
        order = self._sort(rows, cells)
        self.owned = order < n_owned
        self._remember_ghosts(order, shown, n_owned)
        self.is_sorted = True

    def exchange(self, *names: str) -> None:
        """Give ghosts their owners' present values in these columns; images' places are moved by a period. Collective.

        All columns travel in one message to each neighbour; where there are no neighbours nothing is done.
        """
        assert self.is_sorted, "ghosts are known from rebuild on"
        if not self._traffic:
            return
        packing = self._packing(names)
        words = self._traffic.swap(packing.pack(self._columns, self._shown))
        self._move_images(packing, words)
        packing.unpack(words, self._columns, self._ghosts)

    def _lie_in(self, boxes: Boxes) -> None:
        """Let cells be owned as ``boxes`` says. Not collective."""
        rank = self.comm.rank
        self.boxes = boxes
        self.corner = boxes.low[rank] - 1
        self.counts = boxes.high[rank] - boxes.low[rank] + 2
        self._traffic = Traffic(self.comm, boxes.links(rank, self.grid.counts, self.grid.periodic))

    def _bisected(self) -> Boxes:
        """Return boxes made for the present places. Collective."""
        self._wrap()
        return bisect(self.comm, self.grid, self._cells(np.flatnonzero(self.owned)))

    def _cells(self, rows: np.ndarray) -> np.ndarray:
        """Return the cells of these rows, shape (n, dim); what is nowhere (NaN) is in one outside the grid."""
        x = self["x"][rows]
        with np.errstate(invalid="ignore"):
            cells = self.grid.of(x)
        # what such numbers become as integers is not defined
        cells[~(np.abs(x - self.grid.low) < 2.0**60 * self.grid.side)] = -1
        return cells

    def _wrap(self) -> None:
        """Put what is beyond a periodic axis back into the grid."""
        for a in np.flatnonzero(self.grid.periodic):
            _wrap_axis(self["x"][:, a], self.grid.low[a], self.grid.side[a], self.grid.counts[a])

    def _migrate(self, leaving: np.ndarray) -> np.ndarray:
        """Send these rows to their owners; return what comes from others, packed. Collective."""
        owners = self.boxes.owner(self._cells(leaving))
        self._refuse_strays(leaving[owners < 0])
        packing = self._packing(self)
        if self.comm.size == 1:
            return packing.empty(0)
        return ship(self.comm, packing.pack(self._columns, leaving), owners)

    def _refuse_strays(self, rows: np.ndarray) -> None:
        """Raise on all ranks if there are such rows on any. Collective."""
        n = self.comm.allreduce(len(rows))
        if n:
            k = rows[np.argsort(self["id"][rows])[:1]]
            found = self.comm.allgather(list(zip(self["id"][k].tolist(), self["x"][k], strict=True)))
            worst, place = min((one for some in found for one in some), key=lambda one: one[0])
            raise StrayError(worst, place, n)

    def _append(self, words: np.ndarray) -> np.ndarray:
        """Append packed rows to all columns; return their rows."""
        packing, n = self._packing(self), len(self["id"])
        for name, column in self._columns.items():
            self._columns[name] = np.concatenate([column, packing.column(words, name)])
        return n + np.arange(len(words))

    def _packed_cells(self, words: np.ndarray) -> np.ndarray:
        """Return the local cells of rows with all columns, shape (n, dim)."""
        return self.grid.of(self._packing(self).column(words, "x")) - self.corner

    def _fetch_ghosts(self, rows: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fetch ghosts; return which of the owned others see (entries of ``rows``), ghosts packed, and their cells.

        Parameters
        ----------
        rows : ndarray of int, shape (n_owned,)
            Where the owned are.
        cells : ndarray of int, shape (n_owned, dim)
            Their local cells.
        """
        packing, traffic, dim = self._packing(self), self._traffic, cells.shape[1]
        low, high = (
            np.array([getattr(link, end) for link in traffic.sends], dtype=np.int64).reshape(-1, dim) - self.corner
            for end in ("low", "high")
        )
        shown, n_shown = seen(cells, self.counts, low, high)
        traffic.announce(n_shown)
        words = traffic.swap(packing.pack(self._columns, rows[shown]))
        # cells are those of the owner, moved: a place that was moved might round into the next one
        moved = np.array([link.shift for link in traffic.receives], dtype=np.int64).reshape(-1, dim) * self.grid.counts
        ghost_cells = self._packed_cells(words) + np.repeat(moved, traffic.n_received, axis=0)
        self._move_images(packing, words)
        return shown, words, ghost_cells

    def _move_images(self, packing: Packing, words: np.ndarray) -> None:
        """Move images by their periods, if their places are there."""
        if "x" not in packing:
            return
        x, begin = packing.column(words, "x"), 0
        for link, n in zip(self._traffic.receives, self._traffic.n_received, strict=True):
            for a in np.flatnonzero(link.shift):
                x[begin : begin + n, a] += link.shift[a] * (self.grid.counts[a] * self.grid.side[a])
            begin += n

    def _sort(self, rows: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Sort these rows, in these local cells, into new columns, and return their order."""
        is_all = len(rows) == len(self["id"])
        order, self.first = sorted_rows(cells, self.counts, self["id"] if is_all else self["id"][rows])
        rows = order if is_all else rows[order]
        for name, column in self._columns.items():
            self._columns[name] = column.take(rows, axis=0)
        return order

    def _remember_ghosts(self, order: np.ndarray, shown: np.ndarray, n_owned: int) -> None:
        """Note where the owned that are shown, and the ghosts, stand in sorted order."""
        self._shown = self._ghosts = shown[:0]
        if self._traffic:
            position = np.empty_like(order)
            position[order] = np.arange(len(order))
            self._shown, self._ghosts = position[shown], position[n_owned:]

    def _packing(self, names: Iterable[str]) -> Packing:
        names = tuple(names)
        if names not in self._packings:
            self._packings[names] = Packing({name: self._kinds[name] for name in names})
        return self._packings[names]

    # ---- into a file and back ------------------------------------------------------------------------------------

    def slabs(self, names: Iterable[str] | None = None) -> dict[str, Slab]:
        """Return columns (by default all) as pieces of arrays by id that ranks do not change, and "count". Collective.

        Where ids have no gaps, row i is the particle with the i-th smallest id.
        """
        return self.keep(names)()

    def keep(self, names: Iterable[str] | None = None) -> Callable[[], State]:
        """Return what gives ``slabs`` of now, whatever becomes of the particles. Not collective; what it returns is."""
        chosen = self._with_id(names)
        return partial(self._slabs, chosen, self._packing(chosen).pack(self._columns, np.flatnonzero(self.owned)))

    def _slabs(self, chosen: Sequence[str], own: np.ndarray) -> State:
        packing = self._packing(chosen)
        number = packing.column(own, "id")
        last = self.comm.allreduce(int(number.max(initial=0)), MPI.MAX)
        share = last // self.comm.size + 1
        words = ship(self.comm, own, number // share)
        rows = words[np.argsort(packing.column(words, "id"))]
        ends = np.cumsum(self.comm.allgather(len(rows)))
        start, n = int(ends[self.comm.rank]) - len(rows), int(ends[-1])
        slabs = {"count": scalar_slab(self.comm, float(n))}
        for name in chosen:
            width = self._kinds[name][1]
            slabs[name] = Slab(
                np.ascontiguousarray(packing.column(rows, name)), (start, *(0 for _ in width)), (n, *width)
            )
        return slabs

    def restore(self, read: Reader, names: Iterable[str] | None = None) -> None:
        """Take the particles that ``slabs`` of the same names stored; other columns are zero. Collective.

        The set is rebuilt, in boxes that are shared out anew.
        """
        count = read("count", (0,), (1,))
        refuse(self.comm, [outside("count", count, 0, EXACT, whole=True)])
        n = int(count[0])
        begin, end = (n * r // self.comm.size for r in (self.comm.rank, self.comm.rank + 1))
        rows = {}
        for name in self._with_id(names):
            width = self._kinds[name][1]
            rows[name] = read(name, (begin, *(0 for _ in width)), (end - begin, *width))
        refuse(self.comm, [self._id_fault(rows["id"])])
        self._keep(np.zeros(0, dtype=np.int64))
        self.insert(rows)
        self.rebuild(self._bisected())

    def _id_fault(self, id: np.ndarray) -> str:
        """Return what is wrong with the ids that ranks have read, one after the other. Collective."""
        last = [of for of in self.comm.allgather(id[-1:])[: self.comm.rank] if len(of)]
        ascends = np.all(np.diff(np.concatenate([*last[-1:], id])) > 0)
        return outside("id", id, 0, EXACT) or ("" if ascends else "'id' does not ascend, or has a number twice")

    def _with_id(self, names: Iterable[str] | None) -> list[str]:
        return list(self._columns if names is None else dict.fromkeys(["id", "x", *names]))


@njit(cache=True)
def _wrap_axis(x, low, side, count):
    """Put coordinates beyond a periodic axis back into the grid, but not those gone without bounds."""
    for i in range(len(x)):
        cell = np.floor((x[i] - low) / side)
        if not 0 <= cell < count and abs(cell) < 1e6 * count:
            x[i] -= np.floor(cell / count) * (count * side)
            # rounding may leave it on the end, or just before the beginning
            if not 0 <= np.floor((x[i] - low) / side) < count:
                x[i] = low
