"""Scenes to begin with, one for each kind, which run as they are in seconds."""

from __future__ import annotations

import shlex
from pathlib import Path

from petfsi.errors import InputError
from petfsi.messages import shown

#: What there is, by its name: a file beside this one.
STARTERS = {
    "grid": "a jet bends an elastic flap in a channel",
    "particles": "a dam breaks against an elastic beam",
    "solid": "a cantilever swings under its weight, without a fluid",
}


def write_starter(path: Path, kind: str) -> str:
    """Write a scene and return what to do with it. Not collective.

    Parameters
    ----------
    path : Path
        Where: there must be no such file, but the folder that it shall be in.
    kind : str
        Of ``STARTERS``.

    Raises
    ------
    InputError
        If there is such a file, or no such folder; nothing is written then.
    """
    text = (Path(__file__).parent / f"{kind}.toml").read_text(encoding="utf-8")
    name = shown(path, 200)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{name}: is there already, and stays as it is; give another PATH") from None
    except FileNotFoundError:
        raise InputError(f"{name}: there is no folder {shown(path.parent, 200)}; make it first") from None
    quoted = shlex.quote(str(path))
    return "\n".join([
        f"{name}: {STARTERS[kind]}",
        f"  petfsi check {quoted}",
        f"  petfsi run {quoted}",
        f"  petfsi plot {shlex.quote(str(Path('runs') / path.stem))}",
        "  petfsi help KEY    what a key of it means, such as time.dt",
    ])  # fmt: skip
