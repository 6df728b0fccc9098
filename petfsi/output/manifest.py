"""What a checkpoint vouches for: the run's scene, options, meshes, rows and output at the moment it was written.

A manifest is JSON whose first entry is the checksum of all that follows it, byte for byte: a file in which any bit has
changed is known to be damaged.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from petfsi.output.files import digest_of

#: Of the layout of a run directory and its checkpoints; raised when an older petfsi could not read it.
FORMAT = 6
#: What is longer is no manifest, bytes.
MAX_BYTES = 1 << 24
#: How every manifest begins.
HEAD = b'{\n "blake2b": "'
_HEAD = re.compile(re.escape(HEAD) + rb'([0-9a-f]{64})",')

Count = Annotated[int, Field(ge=0, lt=1 << 63)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Index = Literal["fields.xdmf", "fluid.xdmf", "solid.xdmf", "particles.xdmf"]


class _Entry(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class Mark(_Entry):
    """A file, or the first bytes of one that grows: how many, and their BLAKE2b."""

    bytes: Count
    blake2b: Digest


class Rows(Mark):
    """The first rows of a table that grows, its header not counted."""

    rows: Count


class MeshMark(Mark):
    """The run's own copy of a mesh file, relative to the run, and where it came from."""

    file: Annotated[str, Field(pattern=r"^meshes/[0-9]+/[^/\x00]*[^/\x00.][^/\x00]*$")]
    source: str


class Change(_Entry):
    """A setting that another leg has another value of, as TOML, or one of PETSc's options, by ``-name``; None: none."""

    key: str
    old: str | None
    new: str | None


class OriginMark(_Entry):
    """The checkpoint of another run that one began with."""

    file: str
    step: Count
    time: Seconds
    blake2b: Digest


class Leg(_Entry):
    """A part of a run by one process, with what it was told: ``--set`` and PETSc's options as given.

    ``changes`` is how its settings differ from those that the checkpoint was written with, ``origin`` whose state a
    first leg began with.
    """

    step: Count
    time: Seconds
    ranks: Count
    petfsi: str
    sets: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()
    origin: OriginMark | None = None


class Record(_Entry):
    """What a run directory holds besides checkpoints.

    Attributes
    ----------
    scene, options : tuple of str
        The digests that ``scene.toml`` and ``options.opts`` may have, the present one last: there are two while they
        are changed, so that a crash in between leaves a run that fits.
    settings : dict of str to str
        Those that may change when the run goes on, and PETSc's options, as they were when the checkpoint was written.
    meshes : tuple of MeshMark
    history : Rows or None
        Of ``history.csv``.
    outputs : Rows or None
        Of ``fields/outputs.csv``, which names the files of the output times.
    mesh : Mark or None
        Of ``fields/mesh.h5``.
    indexes : dict
        What is final of the XDMF files.
    legs : tuple of Leg
        From the run's start on.
    """

    scene: tuple[Digest, ...] = ()
    options: tuple[Digest, ...] = ()
    settings: dict[str, str] = {}
    meshes: tuple[MeshMark, ...] = ()
    history: Rows | None = None
    outputs: Rows | None = None
    mesh: Mark | None = None
    indexes: dict[Index, Mark] = {}
    legs: tuple[Leg, ...] = ()


class Manifest(_Entry):
    """A checkpoint: its file, what is in it, and the run around it."""

    format: Count
    petfsi: str
    file: str
    step: Count
    time: Seconds
    dt: Seconds
    ranks: Count
    data: Mark
    run: Record

    def text(self) -> str:
        """Return the file's content."""
        body = self.model_dump_json(indent=1)[1:] + "\n"
        return f'{{\n "blake2b": "{digest_of(body.encode())}",{body}'


def read_manifest(data: bytes) -> Manifest | str:
    """Return the manifest in a file's bytes, or in words what is wrong with them."""
    head = _HEAD.match(data)
    if head is None:
        return "is not readable"
    body = data[head.end() :]
    if digest_of(body).encode() != head[1]:
        return "does not have its own checksum"
    found = re.match(rb'\n "format": (\d{1,9}),\n "petfsi": "([\w.+-]{1,40})"', body)
    if found and int(found[1]) != FORMAT:
        return f"is of format {int(found[1])}, by petfsi {found[2].decode()}; this one reads format {FORMAT}"
    try:
        return Manifest.model_validate_json(b"{" + body)
    except (ValidationError, ValueError) as error:
        return f"is not right: {_first(error)}"


def _first(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return type(error).__name__
    about = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, about['loc']))[:100]}: {about['msg'][:200]}"
