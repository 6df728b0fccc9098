"""Rows of several columns on their way between ranks: packed side by side as words of 8 bytes, one message a rank."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from mpi4py import MPI
from numba import njit

from petfsi.fields.sph.balance import Link


class Packing:
    """How the columns of a row stand side by side in words.

    Attributes
    ----------
    width : int
        Words of a row.
    """

    def __init__(self, kinds: dict[str, tuple[np.dtype, tuple[int, ...]]]):
        self._kinds = kinds
        widths = [int(np.prod(shape)) for _, shape in kinds.values()]
        self._begin = dict(zip(kinds, np.cumsum([0, *widths]).tolist(), strict=False))
        self.width = sum(widths)

    def __contains__(self, name: str) -> bool:
        return name in self._begin

    def __iter__(self) -> Iterator[str]:
        return iter(self._begin)

    def begin(self, name: str) -> int:
        """Return the first word of a column."""
        return self._begin[name]

    def empty(self, n: int) -> np.ndarray:
        """Return room for n rows, shape (n, width) of int64."""
        return np.empty((n, self.width), dtype=np.int64)

    def column(self, words: np.ndarray, name: str) -> np.ndarray:
        """Return a column of packed rows, shape (n,) or (n, width): a view."""
        dtype, shape = self._kinds[name]
        begin = self._begin[name]
        return words[:, begin : begin + shape[0]].view(dtype) if shape else words[:, begin].view(dtype)

    def pack(self, columns: dict[str, np.ndarray], rows: np.ndarray) -> np.ndarray:
        """Return these rows of the columns, shape (len(rows), width)."""
        words = self.empty(len(rows))
        for name, begin in self._begin.items():
            _gather(words, begin, _as_words(columns[name]), rows)
        return words

    def unpack(self, words: np.ndarray, columns: dict[str, np.ndarray], rows: np.ndarray) -> None:
        """Write packed rows into these rows of the columns."""
        for name, begin in self._begin.items():
            _scatter(_as_words(columns[name]), rows, words, begin)


def _as_words(column: np.ndarray) -> np.ndarray:
    """Return a column as words, shape (n, width) of int64: a view."""
    return column.view(np.int64).reshape(len(column), column.shape[1] if column.ndim > 1 else 1)


@njit(cache=True)
def _gather(words, begin, column, rows):
    """Write the entries in these rows into the words from ``begin`` on."""
    for k in range(len(rows)):
        for a in range(column.shape[1]):
            words[k, begin + a] = column[rows[k], a]


@njit(cache=True)
def _scatter(column, rows, words, begin):
    """Write the words from ``begin`` on into these rows."""
    for k in range(len(rows)):
        for a in range(column.shape[1]):
            column[rows[k], a] = words[k, begin + a]


class Traffic:
    """What goes between a rank's box and the halos around: the same links in either direction until boxes change.

    Attributes
    ----------
    sends, receives : list of Link
        Sorted by (rank, shift).
    n_sent, n_received : list of int
        Rows per link.
    """

    def __init__(self, comm: MPI.Comm, links: tuple[list[Link], list[Link]]):
        self.comm = comm
        self.sends, self.receives = links
        self.n_sent, self.n_received = [0] * len(self.sends), [0] * len(self.receives)

    def __bool__(self) -> bool:
        """Whether there is anyone to exchange with: another rank, or the rank itself across a periodic axis."""
        return bool(self.sends or self.receives)

    def announce(self, n_sent: Sequence[int]) -> None:
        """Tell neighbours how many rows each link will send, and learn what will come. Collective among neighbours."""
        self.n_sent = [int(n) for n in n_sent]
        sizes = np.empty(len(self.receives), dtype=np.int64)
        sent = np.array(self.n_sent, dtype=np.int64)
        swap(self.comm, _by_rank(self.sends, [1] * len(sent), sent), _by_rank(self.receives, [1] * len(sizes), sizes))
        self.n_received = sizes.tolist()

    def swap(self, words: np.ndarray) -> np.ndarray:
        """Return the rows that all links bring, in their order, for those to be sent. Collective among neighbours."""
        received = np.empty((sum(self.n_received), words.shape[1]), dtype=np.int64)
        there, here = _by_rank(self.sends, self.n_sent, words), _by_rank(self.receives, self.n_received, received)
        swap(self.comm, there, here)
        return received


def _by_rank(links: list[Link], sizes: Sequence[int], words: np.ndarray) -> dict[int, np.ndarray]:
    """Return, by rank, the part of ``words`` that this rank's links fill; links are sorted by rank."""
    spans: dict[int, tuple[int, int]] = {}
    begin = 0
    for link, n in zip(links, sizes, strict=True):
        spans[link.rank] = (spans.get(link.rank, (begin, 0))[0], begin + n)
        begin += n
    return {rank: words[first:last] for rank, (first, last) in spans.items()}


def swap(comm: MPI.Comm, there: dict[int, np.ndarray], here: dict[int, np.ndarray]) -> None:
    """Send arrays of words to ranks, and fill those that come from ranks; empty ones cost no message."""
    requests = [
        comm.Irecv([words, words.size, MPI.INT64_T], rank)
        for rank, words in here.items()
        if words.size and rank != comm.rank
    ]
    for rank, words in there.items():
        if words.size and rank != comm.rank:
            requests.append(comm.Isend([words, words.size, MPI.INT64_T], rank))
    if comm.rank in here:
        here[comm.rank][...] = there[comm.rank]
    MPI.Request.Waitall(requests)


def ship(comm: MPI.Comm, words: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Send each row (n, width) to the rank in ``to`` (n,); return those that come here, by sender. Collective."""
    if comm.size == 1:
        return words
    n_sent = np.bincount(to, minlength=comm.size)
    n_received = np.empty_like(n_sent)
    comm.Alltoall(n_sent, n_received)
    words = words[np.argsort(to, kind="stable")]
    received = np.empty((int(n_received.sum()), words.shape[1]), dtype=np.int64)
    swap(comm, _parts(words, n_sent), _parts(received, n_received))
    return received


def _parts(words: np.ndarray, sizes: np.ndarray) -> dict[int, np.ndarray]:
    ends = np.cumsum(sizes)
    return {int(rank): words[ends[rank] - sizes[rank] : ends[rank]] for rank in np.flatnonzero(sizes)}
