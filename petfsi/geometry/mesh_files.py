"""Mesh files: what their readers make of them, within time and memory, and one clear error where they make nothing."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Hashable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

import numpy as np

from petfsi.bounded import TooLongError, bounded
from petfsi.errors import InputError
from petfsi.geometry.splitting import KINDS
from petfsi.messages import shown
from petfsi.scene.tables import Shape

if TYPE_CHECKING:
    import meshio

    from petfsi.geometry.readers.formats import Reader

#: What a reader may take: so long, s, and for each byte of the file; the slowest wants 1.5e-7 s/B.
SECONDS, SECONDS_PER_BYTE = 20.0, 2e-6
#: So much memory, bytes, and times the file; the hungriest, of compressed cells, wants 38 times that.
MEMORY, MEMORY_PER_BYTE = 1e9, 60.0

T = TypeVar("T")
_WAY_OUT = "save it as Gmsh 4.1 (.msh) or VTU (.vtu), a surface as STL, too"


class Opened(NamedTuple):
    """What was made of a file, and what its user should know of that."""

    mesh: meshio.Mesh
    notes: tuple[str, ...]


#: What was made of files while ``read_once`` lasts, or the error that came of it.
_kept: ContextVar[dict[Hashable, object] | None] = ContextVar("kept", default=None)


@contextlib.contextmanager
def read_once() -> Iterator[None]:
    """Read each file once while this lasts: nothing may change it."""
    token = _kept.set({})
    try:
        yield
    finally:
        _kept.reset(token)


def once(what: Hashable, make: Callable[[], T]) -> T:
    """Return what ``make`` returns, or raise what it raises; where reading is done once, what it did for the same."""
    kept = _kept.get()
    if kept is None:
        return make()
    if what not in kept:
        try:
            kept[what] = make()
        except InputError as error:
            kept[what] = error
    found = kept[what]
    if isinstance(found, InputError):
        raise found
    return cast(T, found)


def open_mesh(shape: Shape, key: str, directory: Path) -> Opened:
    """Return what a reader makes of a shape's file; whatever it does to say no becomes one InputError. Not collective.

    Parameters
    ----------
    shape : Shape
        With ``mesh``.
    key : str
        Where that stands in the scene, for messages: ``"solids.layer.shape.mesh"``.
    directory : Path
        What the path is relative to.
    """
    path = Path(directory) / str(shape.mesh)
    if not path.is_file():
        raise InputError(f"{key} = {shape.mesh!r}: no file {path}")
    found = once(path, lambda: _opened(path))
    if isinstance(found, str):
        raise InputError(f"{key} = {shape.mesh!r}: {found}")
    return found


def _opened(path: Path) -> Opened | str:
    """Return what the first reader that can makes of a file, or why none can."""
    from petfsi.geometry.readers.formats import endings, find_readers

    size = path.stat().st_size
    if not size:
        return "cannot be read as a mesh: it is empty"
    readers = find_readers(path)
    if not readers:
        return f"cannot be read as a mesh: such files end in {', '.join(endings())}; {_WAY_OUT}"
    first = ""
    for name, read in readers:
        found = _tried(read, path, size)
        if isinstance(found, Opened):
            return found
        first = first or f"cannot be read as a mesh ({name}: {found}); {_WAY_OUT}"
    return first


def _tried(read: Reader, path: Path, size: int) -> Opened | str:
    """Return what a reader makes of a file, or why it makes nothing."""
    notes: list[str] = []
    said = io.StringIO()
    seconds, memory = SECONDS + SECONDS_PER_BYTE * size, MEMORY + MEMORY_PER_BYTE * size
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            warnings.simplefilter("ignore")
            # numpy's word for numbers that it could not read and leaves out
            warnings.filterwarnings("error", "string or file could not be read to its end")
            with bounded(seconds, memory):
                mesh = read(path, notes)
                _check_arrays(mesh)
        return Opened(mesh, (*notes, *_lines(said)))
    except TooLongError:
        return f"takes longer than {seconds:.0f} s: it is broken, or far too slow to read"
    except MemoryError:
        return f"wants more than {memory / 1e9:.1f} GB of memory: it is broken, or holds far more than it shows"
    except (Exception, SystemExit) as error:
        return shown(_reason(error, _lines(said)), 300)


def _check_arrays(mesh: meshio.Mesh) -> None:
    """Raise unless points, cells and groups are arrays of the forms that they should have."""
    import meshio
    from meshio._common import num_nodes_per_cell

    mesh.points = np.asarray(mesh.points, dtype=float)
    if mesh.points.ndim != 2 or mesh.points.shape[1] not in (1, 2, 3):
        raise meshio.ReadError("points without two or three coordinates each")
    for block in mesh.cells:
        if block.type in KINDS and len(block.data):
            nodes = num_nodes_per_cell.get(block.type, block.data.shape[-1])
            if block.data.ndim != 2 or block.data.shape[1] != nodes or not np.issubdtype(block.data.dtype, np.integer):
                raise meshio.ReadError(f"cells of type {block.type} that have not {nodes} nodes each")
            if block.data.min() < 0 or block.data.max() >= len(mesh.points):
                raise meshio.ReadError("cells name points that the file does not hold")
    lengths = [len(block.data) for block in mesh.cells]
    for name, sets in mesh.cell_sets.items():
        for chosen, length in zip(sets, lengths, strict=True):
            _check_numbers(name, chosen, length)
    for name, chosen in mesh.point_sets.items():
        _check_numbers(name, chosen, len(mesh.points))


def _check_numbers(name: str, chosen: np.ndarray | None, length: int) -> None:
    import meshio

    numbers = np.asarray([] if chosen is None else chosen).ravel()
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= length):
        raise meshio.ReadError(f"group {name!r} has members that the file does not hold")


def _reason(error: BaseException, said: list[str]) -> str:
    """Return why a reader failed."""
    import meshio

    if isinstance(error, ImportError):
        return f"reading it takes the Python package {error.name}, which is not there"
    if isinstance(error, UnicodeDecodeError):
        return "what should be text is none"
    if isinstance(error, DeprecationWarning):
        return "what should be numbers is none"
    if isinstance(error, KeyError) and error.args and " " not in str(error.args[0]):
        return f"it names {error.args[0]!r}, which it does not hold or which is not known"
    if isinstance(error, FileNotFoundError):
        return f"it needs {Path(error.filename).name}, which is not beside it" if error.filename else str(error)
    words = " ".join([" ".join(str(error).split()) * (not isinstance(error, SystemExit)), *said]).strip()
    if isinstance(error, (meshio.ReadError, SystemExit)) and words:
        return words
    # what a reader meets where it looks for something else, in words of Python or NumPy
    return f"it is not as this format should be: {words}" if words else "it is not as this format should be"


def _lines(said: io.StringIO) -> list[str]:
    """Return what was printed as one line, if anything, without where in the reader it was."""
    text = " ".join(said.getvalue().partition("Traceback (most recent call last)")[0].split())
    return [text] if text else []
