"""Whether what a run's directory holds is of the settings of the plan: anybody can resume it, or put another there."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.output import files
from petfsi.runs.plan import DEFAULT_OPTIONS, LARGE_OPTIONS
from petfsi.scene.dump import dump_scene
from petfsi.scene.load import load_scene
from petfsi.solving import options
from petfsi.sweeps.plan import INPUTS, Planned, scene_name, settings_of

#: Bytes of the largest scene, or file of options.
_MOST = 16_000_000
#: Keys that are told.
_TOLD = 6
#: A folder of meshes has another name in a run than among the inputs.
_FOLDER, _MESH = re.compile(r'"[^"]*\bmeshes/[^/"]+/'), re.compile(r'"(meshes/[^"]+)"')
#: Options that PETSc alone knows to go, or not, with a type of KSP.
_OF_TYPES = ("norm_type", "pc_side")


def differences(path: Path, run: Planned, summary: Mapping[str, Any]) -> str:
    """Return in words how what a run's directory holds differs from the plan; nothing if it fits, or has not begun."""
    try:
        told = [*_of_scene(path, run), *_of_options(path, run), *_of_summary(run, summary)]
    except OSError as error:
        return f"{error.filename}: {files.reason(error)}"
    except (ValueError, RecursionError):  # also of bytes that are no text
        return "scene.toml or options.opts is damaged"
    more = f"; and {len(told) - _TOLD} more" if len(told) > _TOLD else ""
    return f"not as planned: {'; '.join(told[:_TOLD])}{more}" if told else ""


def _of_scene(path: Path, run: Planned) -> Iterator[str]:
    data = _read(path / "scene.toml")
    if not data or run.scene.endswith(scene_name(data)):
        return
    now, wanted = settings_of(data.decode()), run.settings()
    if list(_unlike(wanted, now)) and list(_unlike(_as_of_now(path, run), now)):
        yield from _unlike(wanted, now)
    for key in wanted:
        ours, theirs = (_MESH.findall(one.get(key, "")) for one in (wanted, now))
        if any(
            _size(path / other) != _size(path.parents[1] / INPUTS / mesh)
            for mesh, other in zip(ours, theirs, strict=False)
        ):
            yield f"{key} is another mesh"


def _as_of_now(path: Path, run: Planned) -> dict[str, str]:
    """Return the planned scene in the words of this petfsi: a later one may write down more defaults."""
    try:
        return settings_of(dump_scene(load_scene(path.parents[1] / run.scene)))
    except (InputError, OSError):
        return {}


def _of_options(path: Path, run: Planned) -> Iterator[str]:
    data = _read(path / options.STORED)
    if not data:
        return
    planned = _planned_options(tuple(run.options), path.parents[1] / INPUTS)
    if planned is None:  # whose file has gone
        return
    wanted, origins = planned
    shipped = {one.name for one in options.shipped_options()}
    now = {}
    for line in data.decode().splitlines():
        option, _, origin = line.partition("  # ")
        if origin not in shipped:
            name, _, value = option.partition(" ")
            now[name] = value
        elif origin not in origins:
            origins = origins | {origin}
            yield f"options of {origin}"
    gone = {name for name in wanted if name not in now and name.endswith(_OF_TYPES)}
    yield from _unlike({name: value for name, value in wanted.items() if name not in gone}, now)


@lru_cache(maxsize=256)
def _planned_options(words: tuple[str, ...], inputs: Path) -> tuple[dict[str, str], frozenset[str]] | None:
    """Return the user's options that are planned, by ``-name``, and the shipped files that others may be from."""
    here = [str(inputs / word) if (inputs / word).is_file() else word for word in words]
    try:
        chosen = options.resolve(here, {}).chosen
    except InputError:
        return None
    origins = {option.origin for option in chosen.values() if option.shipped}
    if origins <= {DEFAULT_OPTIONS}:
        origins = {DEFAULT_OPTIONS, LARGE_OPTIONS}
    return {f"-{one.name}": one.value for one in chosen.values() if not one.shipped}, frozenset(origins)


def _of_summary(run: Planned, summary: Mapping[str, Any]) -> Iterator[str]:
    ranks, steps = summary.get("ranks"), summary.get("steps")
    if isinstance(ranks, int) and ranks != run.ranks:
        yield f"ranks is {ranks}, not {run.ranks}"
    if isinstance(steps, int) and run.steps is not None and steps > run.steps:
        yield f"steps is {steps}, not {run.steps}"


def _unlike(wanted: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    for key in dict.fromkeys([*wanted, *now]):
        theirs, ours = now.get(key, "none"), wanted.get(key, "none")
        if _FOLDER.sub('"meshes/', theirs) != _FOLDER.sub('"meshes/', ours):
            yield f"{shown(key)} is {shown(theirs)}, not {shown(ours)}"


def _read(path: Path) -> bytes:
    try:
        return files.read_small(path, _MOST)
    except (FileNotFoundError, NotADirectoryError):
        return b""


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1
