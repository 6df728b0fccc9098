"""The exchange of ghost entries between the ranks of a regular grid."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError


def share_out(cells: tuple[int, ...], size: int, narrowest: int) -> tuple[int, ...] | None:
    """Return the numbers of ranks per axis with the least area between ranks, or None if there is no way.

    Along an axis with more than one rank every rank has to own at least ``narrowest`` cells. Ties go to
    splitting the last axis, where global numbers then are natural ones.
    """
    divisors = [n for n in range(1, size + 1) if size % n == 0]
    best = None
    for shares in product(divisors, repeat=len(cells)):
        if np.prod(shares) != size:
            continue
        if any(n > 1 and c // n < narrowest for n, c in zip(shares, cells, strict=True)):
            continue
        area = sum((n - 1) * int(np.prod(cells)) // c for n, c in zip(shares, cells, strict=True))
        if best is None or (area, shares) < best:
            best = (area, shares)
    return None if best is None else best[1]


def ranks_per_axis(cells: tuple[int, ...], size: int, narrowest: int) -> tuple[int, ...]:
    """Return ``share_out``'s answer, or raise an ``InputError`` that names a number of ranks that would do."""
    shares = share_out(cells, size, narrowest)
    if shares is not None:
        return shares
    most = next(n for n in range(size, 0, -1) if share_out(cells, n, narrowest) is not None)
    raise InputError(
        f"fluid.cells = {list(cells)}: {size} ranks cannot share this grid, because each needs at least {narrowest} "
        f"cells along an axis that is split; the next smaller number of ranks that works is {most}"
    )


@dataclass(frozen=True)
class Halo:
    """Fills ghosts from the ranks that own them: across ranks and around periodic axes, corners included.

    Entries beyond a side that is not periodic are neither read nor written. Axes are worked through one after the
    other, each moving what the axes before it have filled, so that corners need no messages of their own.

    Attributes
    ----------
    lo, hi, cells, ghost : tuple of int
        Owned range, global cells and ghost width per axis (three axes always).
    periodic : tuple of bool
    neighbours : tuple of (int, int)
        Ranks below and above per axis; ``MPI.PROC_NULL`` where there is none, the rank itself on an axis that is
        not split.
    """

    comm: MPI.Comm
    lo: tuple[int, ...]
    hi: tuple[int, ...]
    cells: tuple[int, ...]
    ghost: tuple[int, ...]
    periodic: tuple[bool, ...]
    neighbours: tuple[tuple[int, int], ...]

    def inside(self, axis: int, stagger: int | None) -> slice:
        """Return the local entries along an axis that lie in the domain, ghosts included."""
        length = self.hi[axis] - self.lo[axis] + 2 * self.ghost[axis] + (stagger == axis)
        if self.periodic[axis]:
            return slice(0, length)
        first = self.ghost[axis] - self.lo[axis]
        last = first + self.cells[axis] + (stagger == axis)
        return slice(max(first, 0), min(last, length))

    def exchange(self, array: np.ndarray, stagger: int | None = None, width: int | None = None) -> None:
        """Fill the ghosts of a local array in place. Collective.

        Parameters
        ----------
        array : ndarray
            Cells (``stagger`` None) or faces of the axis ``stagger``.
        width : int, optional
            Fill only so many layers of ghosts.
        """
        for axis in range(3):
            depth = min(self.ghost[axis], width or self.ghost[axis])
            if depth == 0:
                continue
            below, above = self.neighbours[axis]
            view = array[tuple(slice(None) if b == axis else self.inside(b, stagger) for b in range(3))]
            view = np.moveaxis(view, axis, 0)
            if below == above == self.comm.rank:
                if self.periodic[axis]:
                    self._wrap(view, axis, depth, stagger == axis)
            else:
                self._swap(view, axis, depth, stagger == axis)

    def _wrap(self, view: np.ndarray, axis: int, depth: int, extra: bool) -> None:
        ghost, n = self.ghost[axis], self.cells[axis]
        view[ghost - depth : ghost] = view[ghost + np.arange(-depth, 0) % n]
        view[ghost + n : ghost + n + depth + extra] = view[ghost + np.arange(depth + extra) % n]

    def _swap(self, view: np.ndarray, axis: int, depth: int, extra: bool) -> None:
        ghost, n = self.ghost[axis], self.hi[axis] - self.lo[axis]
        below, above = self.neighbours[axis]
        # the face that two ranks share belongs to the upper one, so one plane more travels down
        moves = (
            (slice(ghost, ghost + depth + extra), below, slice(ghost + n, ghost + n + depth + extra), above),
            (slice(ghost + n - depth, ghost + n), above, slice(ghost - depth, ghost), below),
        )
        for source, to, target, origin in moves:
            received = np.empty(view[target].shape, view.dtype)
            sent = np.ascontiguousarray(view[source]) if to != MPI.PROC_NULL else received[:0]
            into = received if origin != MPI.PROC_NULL else received[:0].copy()
            self.comm.Sendrecv(sent, to, recvbuf=into, source=origin)
            if origin != MPI.PROC_NULL:
                view[target] = received
