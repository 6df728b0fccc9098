"""What a new run takes from another one's checkpoint: ``petfsi run NEW.toml --from DIR``."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.slabs import Reader
from petfsi.integrators.base import integrator
from petfsi.output import checkpoint as checkpoints
from petfsi.output import files
from petfsi.output.manifest import OriginMark
from petfsi.output.mesh_files import mesh_files
from petfsi.output.rundir import MOST_TEXT, RunDirectory
from petfsi.ranks import on_root
from petfsi.registry import INTEGRATORS
from petfsi.scene.dump import as_toml, drop_idle
from petfsi.scene.load import load_scene
from petfsi.scene.schema import Scene
from petfsi.simulation import Simulation

#: Lines about what does not fit.
MAX_TOLD = 8
#: Characters of a value that are told.
_SHOWN = 160
#: What a checkpoint keeps besides fields, and a new run begins for itself.
_OWN = ("clock", "accounts", "guard", "stable", "splitting")
#: What schemes remember of earlier steps of a solid, and where its stable step was found.
_PAST = (*{past for name in INTEGRATORS for past in integrator(name).past}, "displacement_measured")
#: What the state of a fluid does not hang on: numbers of its sides, and what it begins with or is advanced with.
_FREE_OF_SIDES = ("speed", "along", "smoke", "ramp", "pressure", "hydrostatic", "entering", "velocity")
_FREE = {
    "mac": ("sides", "density", "viscosity", "advection", "initial", "smoke"),
    "sph": ("sides", "initial", "fill", "pressure"),
}


@dataclass
class Origin:
    """A run's newest good checkpoint, from which another one begins.

    Attributes
    ----------
    directory : Path
    found : CheckpointInfo
    scene : Scene
        Of that run.
    damaged : list of str
        A line about every newer checkpoint that is damaged.
    """

    directory: Path
    found: checkpoints.CheckpointInfo
    scene: Scene
    damaged: list[str]

    @classmethod
    def find(cls, directory: Path, out: Path, comm: MPI.Comm) -> Origin:
        """Return the origin in a run directory, from which nothing but reading is done. Collective.

        Raises
        ------
        InputError
            On all ranks, when there is none, its scene has been changed, or it is where the new run would go.
        """
        old = RunDirectory.open(directory, comm)
        damaged: list[str] = []
        found = checkpoints.find_checkpoint(old.checkpoints, comm, damaged.append)
        damaged = comm.bcast(damaged)
        if found is None:
            raise InputError("\n  ".join([f"--from {directory}: no checkpoint can be read", *damaged[:MAX_TOLD]]))
        known = found.manifest.run.scene

        def read() -> Scene:
            if out.exists() and os.path.samefile(directory, out):
                raise InputError(f"--from {directory}: the new run needs another directory; name it with --out")
            if files.digest_of(files.read_small(old.scene, MOST_TEXT)) not in known:
                raise InputError(f"--from {directory}: its scene.toml is not that of its checkpoint; put it back")
            return load_scene(old.scene)

        try:
            return cls(Path(directory), found, on_root(comm, read), damaged)
        except OSError as error:
            raise InputError(f"--from {directory}: scene.toml: {files.agreed_reason(comm, error)}") from error

    @property
    def mark(self) -> OriginMark:
        """What the new run's manifest says of it."""
        found = self.found
        path, digest = files.name_of(found.path), found.manifest.data.blake2b
        return OriginMark(file=path, step=found.step, time=found.time, blake2b=digest)

    def begin(self, simulation: Simulation) -> list[str]:
        """Prepare a simulation with the state of this checkpoint as its first. Collective.

        Fields that are alike in both scenes are taken. If those are all, velocities are taken as they are, and with the
        same integrator so is what that remembers; else the scheme starts anew, and velocities are made to fit. Returns
        what ``prepare`` does.

        Raises
        ------
        InputError
            On all ranks, with what does not fit.
        """
        names = [field.name for field in simulation.fields]
        self._look_again(simulation.comm)
        with checkpoints.read_checkpoint(self.found, simulation.comm) as stored:
            taken = [name for name in names if name in stored.groups()]
            self._compare(simulation, taken)
            whole = taken == names
            goes_on = whole and self.scene.time.integrator == simulation.scene.time.integrator
            group = stored.group if goes_on else _without_past(stored.group)
            if whole:
                unread = simulation.prepare(resumes_at=0.0)
                with checkpoints.taken_up(self.found):
                    simulation.begin_with(taken, group)
                simulation.rehearse(resumes_at=0.0)  # books are opened, and solutions looked for, where bodies are now
                simulation.accounts.start()
                if goes_on and simulation.accounts.columns and "accounts" in stored.groups():
                    simulation.accounts.follow(stored.group("accounts"))
                simulation.begin_with(taken, group)  # that has moved the fluid's faces to them
                if simulation.regions:
                    simulation.regions.go_on()
                simulation.check_step()
            else:
                with checkpoints.taken_up(self.found):
                    simulation.begin_with(taken, group)
                unread = simulation.prepare()
            unused = [name for name in stored.unread() if name.split("/")[0] not in _OWN]
        simulation.notes[:0] = self._notes(simulation, taken, unused, goes_on)
        return unread

    def _look_again(self, comm: MPI.Comm) -> None:
        """Take the newest checkpoint if a run at work has replaced the one found. Collective."""
        if on_root(comm, self.found.path.exists):
            return
        found = checkpoints.find_checkpoint(self.found.path.parent, comm, self.damaged.append)
        if found is None or found.manifest.run.scene != self.found.manifest.run.scene:
            raise InputError(f"--from {self.directory}: its checkpoint {self.found.path.name} has gone; try again")
        self.found = found

    def _compare(self, simulation: Simulation, taken: list[str]) -> None:
        """Refuse what of the two scenes does not fit. Collective."""
        new = simulation.scene
        if not taken:
            raise InputError(f"--from {self.directory}: it has no state of what this scene has")
        before, now = on_root(simulation.comm, lambda: (_layout(self.scene, taken), _layout(new, taken)))
        wrong = [
            f"{key} = {_shown(now.get(key))}, and was {_shown(before.get(key))}"
            for key in dict.fromkeys([*now, *before])
            if now.get(key) != before.get(key)
        ]
        if wrong:
            more = [f"and {len(wrong) - MAX_TOLD} more"] if len(wrong) > MAX_TOLD else []
            lines = "".join(f"\n  {line}" for line in [*wrong[:MAX_TOLD], *more])
            raise InputError(
                f"--from {self.directory}: the state of {' and '.join(taken)} there is of another layout:{lines}"
            )
        if "particles" not in taken and simulation.fluid is not None and simulation.fluid.name == "particles":
            raise InputError(
                f"--from {self.directory}: has no particles, and those of a scene are filled in around solids at rest; "
                "begin with a run that has both"
            )

    def _notes(self, simulation: Simulation, taken: list[str], unused: list[str], goes_on: bool) -> list[str]:
        """Return what a user should know of how the run begins."""
        found, scene = self.found, simulation.scene
        notes = [
            *self.damaged,
            f"begins at t = 0 with the state of {' and '.join(taken)} in {found.path}, step {found.step}, "
            f"t = {found.time:.6g} s; accounts begin anew",
        ]
        fresh = [field.name for field in simulation.fields if field.name not in taken]
        if fresh:
            notes.append(f"{' and '.join(fresh)}: not in that checkpoint, begins as the scene says")
        if not goes_on:
            notes.append("the integrator begins anew, with a first step of first order")
        if unused:
            notes.append(f"not used of that checkpoint: {', '.join(unused)}")
        given = [f"solids.{name}.initial" for name, solid in scene.solids.items() if solid.initial.model_fields_set]
        given = given if "solid" in taken else []
        fluid = simulation.fluid
        if (
            scene.fluid is not None
            and fluid is not None
            and fluid.name in taken
            and scene.fluid.initial.model_fields_set
        ):
            given.append("fluid.initial")
        if given:
            notes.append(f"not used, for the state is that of the checkpoint: {', '.join(given)}")
        return notes


def _without_past(group: Callable[[str], Reader]) -> Callable[[str], Reader]:
    """Return the same groups without what the integrator remembers of earlier steps."""

    def of(name: str) -> Reader:
        read = group(name)
        return lambda array, start, count: _read_anew(read, array, start, count)

    return of


def _read_anew(read: Reader, name: str, start: tuple[int, ...], count: tuple[int, ...]) -> np.ndarray:
    if name.endswith((*_PAST, "past_dt")):
        return np.zeros(count)  # no step before: past_dt = 0, and nothing else is looked at then
    return read(name, start, count)


# ---- whether states fit -------------------------------------------------------------------------------------


def _layout(scene: Scene, taken: list[str]) -> dict[str, str]:
    """Return by key, as TOML, what the state of some fields hangs on. Not collective: reads meshes."""
    data, meshes = scene.model_dump(exclude_none=True, by_alias=True), _digests(scene)
    drop_idle(data)
    found = {"dim": scene.dim, "solids": ", ".join(scene.solids)}
    for name, solid in data["solids"].items():
        found[f"solids.{name}.shape"] = _with_digests(solid["shape"], meshes)
        found[f"solids.{name}.elements"] = solid["elements"]
    if taken != ["solid"] and scene.fluid is not None:
        kind = scene.fluid.kind
        found |= {f"fluid.{key}": value for key, value in data["fluid"].items() if key not in _FREE[kind]}
        for side, form in data["fluid"]["sides"].items():
            found[f"fluid.sides.{side}"] = _with_digests(_form(form), meshes)
        for name, solid in data["solids"].items():
            found[f"solids.{name}.interior"] = solid["interior"]
        for name, obstacle in data["obstacles"].items():
            found[f"obstacles.{name}"] = _with_digests(obstacle, meshes)
        found |= {"coupling.transfer": scene.transfer, "time.integrator": scene.time.integrator}
        if kind == "sph" and data["fluid"].get("sound_speed") is None:
            found["gravity"] = data.get("gravity", "none")  # the sound speed is found from it
    return {key: as_toml(value) for key, value in found.items()}


def _form(side: Any) -> Any:
    """Return what kind of side it is, without the numbers."""
    if not isinstance(side, dict):
        return side
    return {key: "..." if key in _FREE_OF_SIDES else _form(value) for key, value in side.items()}


def _digests(scene: Scene) -> dict[str, str]:
    """Return the digests of a scene's meshes, of all files that belong to each, by path."""
    folders: dict[str, list[str]] = {}
    for mesh in mesh_files(scene):
        folders.setdefault(mesh.mark.file.rsplit("/", 1)[0], []).append(mesh.mark.blake2b[:16])
    return {str(mesh.source): " ".join(folders[mesh.mark.file.rsplit("/", 1)[0]]) for mesh in mesh_files(scene)}


def _with_digests(data: Any, meshes: Mapping[str, str]) -> Any:
    """Return a table whose mesh files are named by what is in them."""
    if not isinstance(data, dict):
        return data
    return {
        key: f"a file of digest {meshes[value]}" if key == "mesh" else _with_digests(value, meshes)
        for key, value in data.items()
    }


def _shown(value: str | None) -> str:
    if value is None:
        return "none"
    return value if len(value) <= _SHOWN else f"{value[: _SHOWN - 3]}..."
