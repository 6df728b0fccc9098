"""What a scene would solve, and what this installation can solve it with."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise, takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from petfsi import __version__
from petfsi.errors import InputError
from petfsi.messages import shown
from petfsi.notes.note import Note
from petfsi.notes.notes import find_notes
from petfsi.runs.memory import PROGRAM_BYTES, as_bytes, available_bytes, needs, solid_bytes
from petfsi.runs.plan_fluids import FluidPlan, fluid_plan, fluid_skipped
from petfsi.scene.schema import Scene
from petfsi.scene.solids import Solid
from petfsi.scene.stepping import PART, Stepping
from petfsi.solving import options

if TYPE_CHECKING:
    from petfsi.simulation import Simulation

#: The options file in force when none is named, and that of large solids alone.
DEFAULT_OPTIONS, LARGE_OPTIONS = options.DEFAULT, "solid-large.opts"
#: Beyond so many unknowns of a solid in 3D multigrid is faster than a factorisation, and needs less memory.
LARGE = 50_000
#: Steps of changing length are counted up to here.
MAX_COUNTED = 100_000
#: A scene of no more bytes and solids is made ready by ``check``.
REHEARSED, MANY = 1e9, 300

PACKAGES = (
    "mumps superlu superlu_dist suitesparse mkl_pardiso strumpack hypre ml scalapack metis parmetis ptscotch "
    "slepc cuda hip kokkos"
).split()


def describe_plan(
    scene: Scene, petsc_options: Sequence[str] = (), ready: Callable[[], Simulation] | None = None
) -> str:
    """Return what a run of the scene would do, for people. Not collective; reads the scene's meshes.

    Parameters
    ----------
    scene : Scene
        A valid scene.
    petsc_options : sequence of str
        PETSc options as on the command line.
    ready : callable, optional
        Makes the scene ready for its first step, unless that is too large, and returns the simulation.

    Raises
    ------
    InputError
        With every mistake in its mesh files, or that shows where it is made ready.
    """
    nodes, cells = _solid_sizes(scene)
    if not is_rehearsed(scene) and any(probe.of in scene.solids for probe in scene.probes.values()):
        from petfsi.geometry.bodies import far_probes

        wrong = far_probes(scene)
        if wrong:
            raise InputError("\n".join(wrong))
    lines = [shown(scene.title, 200) or "untitled", ""]
    fluid = fluid_plan(scene)
    lines += [f"{name + ':':<13}{text}" for name, text in _quantities(scene, fluid, nodes, cells)]
    meshes, told = read_files(scene)
    lines += [f"{'note:':<13}{note}" for note in told]
    if ready is None or not is_rehearsed(scene):
        why = "too large to be made ready here" if not is_rehearsed(scene) else "not made ready here"
        lines.append(f"{'first step:':<13}{why}: run judges it before it writes anything")
    lines += [f"{'options:':<13}{_options(scene, nodes, petsc_options)}", "", "skipped:"]
    lines += [f"  {line}" for line in skipped(scene)]
    simulation = ready() if ready is not None and is_rehearsed(scene) else None
    notes = (
        find_notes(scene, meshes, _first_step(scene, fluid.step)) if simulation is None else told_of(simulation, meshes)
    )
    return "\n".join([*lines, *["", "notes:"][: 2 * bool(notes)], *(f"  {note}" for note in notes)])


def _first_step(scene: Scene, limit: float | None) -> float | None:
    """Return the length of the first step, s, where it is known; ``limit`` is that of particles."""
    stepping = Stepping(scene.time)
    if stepping.auto:
        return None if limit is None else PART * limit
    return stepping.length(0.0)


def default_options(scene: Scene) -> str:
    """Return the name of the options file in force when none is named. Not collective.

    Raises
    ------
    InputError
        With every mistake in the meshes of a scene of solids alone in 3D: they are built to be counted.
    """
    if scene.fluid is not None or scene.dim == 2:
        return DEFAULT_OPTIONS
    return _default_options(scene, _solid_sizes(scene)[0])


def _default_options(scene: Scene, nodes: dict[str, int]) -> str:
    large = scene.fluid is None and scene.dim == 3 and scene.dim * sum(nodes.values()) > LARGE
    return LARGE_OPTIONS if large else DEFAULT_OPTIONS


def read_files(scene: Scene) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], list[str]]:
    """Return the meshes of solids from files, and what a user should know of how files are read. Not collective."""
    shapes = [solid.shape for solid in scene.solids.values()] + [one.shape for one in scene.obstacles.values()]
    if all(shape.mesh is None for shape in shapes):
        return {}, []
    from petfsi.geometry import bodies

    return bodies.read_files(scene)


def told_of(simulation: Simulation, meshes: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[Note]:
    """Return what a user should know of a scene that is ready for its first step. Not collective.

    Parameters
    ----------
    simulation : Simulation
    meshes : mapping of str to (points, cells)
        Of the solids from mesh files.
    """
    own = [] if simulation.solid is None else [Note(text, warns=True) for text in simulation.solid.warnings]
    return own + find_notes(simulation.scene, meshes, simulation.dt, simulation.solver.splits)


def skipped(scene: Scene) -> list[str]:
    """Return what is neither allocated nor assembled for this scene, and why."""
    out = []
    if scene.fluid is None:
        out.append("fluid, nest and coupling: the scene has no [fluid]; the solid's block alone is solved")
    if not scene.solids:
        alone = "; the pressure's block alone is solved" if scene.fluid and scene.fluid.kind != "sph" else ""
        out.append(f"solid, nest and coupling: the scene has no [solids]{alone}")
    out += fluid_skipped(scene)
    if scene.time.scheme.explicit and scene.fluid is None:
        out.append("solver: the mass is lumped, A is diagonal; no option under -fsi_ is read")
    if not scene.time.scheme.inertia:
        out.append(f"inertia: the integrator is {scene.time.integrator}")
    if scene.solids and not any(solid.loads or solid.body_force for solid in scene.solids.values()):
        out.append("loads: there are none")
    if scene.gravity is None:
        out.append("gravity: not given")
    if scene.solids and all(s.damping.mass == 0 and s.damping.stiffness == 0 for s in scene.solids.values()):
        out.append("damping: its coefficients are 0")
    if scene.time.energy_limit >= 0 and scene.unjudged:
        out.append(f"time.energy_limit: {scene.unjudged}")
    if scene.output.every is None:
        out.append("fields.xdmf: there is no output.every")
    return out


def is_rehearsed(scene: Scene) -> bool:
    """Return whether ``check`` makes all ready for the first step, as ``run`` does: not what would take long."""
    return sum(need for *_, need in needs(scene)) <= REHEARSED and len(scene.solids) <= MANY


def _quantities(scene: Scene, fluid: FluidPlan, nodes: dict[str, int], cells: dict[str, int]) -> list[tuple[str, str]]:
    rows, unknowns = list(fluid.rows), fluid.unknowns
    if nodes:
        n = sum(count * (scene.dim if scene.solids[name].shape.beam is None else 3) for name, count in nodes.items())
        unknowns += n
        bodies = "; ".join(f"{name} {nodes[name]:,} nodes, {cells[name]:,} cells" for name in nodes)
        rows.append(("solid", f"{n:,} unknowns ({bodies})"))
    rows.append(("in all", f"{unknowns:,} unknowns"))
    memory = fluid.bytes + solid_bytes(scene.dim, sum(nodes.values()), sum(cells.values()))
    more = "; much more where a large 3D solid is factorised" if nodes and scene.dim == 3 else ""
    program, free = as_bytes(PROGRAM_BYTES), as_bytes(available_bytes())
    rows.append(
        ("memory", f"about {as_bytes(memory)}, and {program} a rank for the program{more}; {free} are free here")
    )
    time = scene.time
    steps = Stepping(time).count(MAX_COUNTED)
    rows.append(("steps", f"{_steps(scene, steps, fluid.step)}, {time.integrator}"))
    if scene.output.every is not None:
        times = min(_count(time.end, scene.output.every), steps or MAX_COUNTED) + 1
        size = times * (fluid.output_bytes + 16 * scene.dim * sum(nodes.values()))
        rows.append(("outputs", f"{times:,}, every {scene.output.every:g} s, about {as_bytes(size)} in all"))
    every = scene.checkpoint.every
    written = 1 if every is None else min(_count(time.end, every), steps or MAX_COUNTED)
    rows.append(("checkpoints", f"{written:,}, of which the last {min(written, scene.checkpoint.keep)} stay"))
    if scene.probes:
        rows.append(("probes", ", ".join(f"{name} ({p.quantity} of {p.of})" for name, p in scene.probes.items())))
    if scene.fluid is not None and scene.solids:
        rows.append(("coupling", scene.transfer))
    return rows


def _steps(scene: Scene, count: int | None, limit: float | None) -> str:
    """Return how many steps there are and how long they are; ``limit`` is that of particles, s."""
    time, first = scene.time, _first_step(scene, limit)
    if not Stepping(time).auto:
        number = f"{count:,}" if count is not None else "many"
        return f"{number} of {time.dt if isinstance(time.dt, str) else f'{time.dt:g}'} s to {time.end:g} s"
    number = "as many as it takes" if first is None else f"about {_count(time.end, first):,}"
    begin = "" if first is None else f"{min(first, time.end):.3g} s at the start, then "
    return f'{number} to {time.end:g} s: {begin}nine tenths of the stable step each (time.dt = "auto")'


def _count(end: float, every: float) -> int:
    return max(1, math.ceil(end / every - 1e-9))


# ---- sizes --------------------------------------------------------------------------------------------------


def _solid_sizes(scene: Scene) -> tuple[dict[str, int], dict[str, int]]:
    """Return nodes and cells of each solid; where counting is not enough the meshes are built and judged."""
    boxes = {name: cells for name, solid in scene.solids.items() if (cells := _plain_cells(solid)) is not None}
    if len(boxes) == len(scene.solids) and not scene.obstacles:
        # the middles of all edges of a cell's simplices are those of its edges, faces and the cell itself
        orders = {name: 2 if scene.solids[name].elements == "quadratic" else 1 for name in boxes}
        nodes = {name: math.prod(orders[name] * n + 1 for n in box) for name, box in boxes.items()}
        return nodes, {name: math.prod(box) * math.factorial(scene.dim) for name, box in boxes.items()}
    from petfsi.geometry.beams import axis_mesh
    from petfsi.geometry.bodies import build_bodies
    from petfsi.geometry.meshes import read_surface
    from petfsi.geometry.obstacles import obstacle_surfaces
    from petfsi.geometry.quadratic import with_middles

    errors, meshes = [], {}
    readers: list[Callable[[], object]] = [
        partial(read_surface, obstacle.shape, scene.dim, f"obstacles.{name}.shape", scene.directory)
        for name, obstacle in scene.obstacles.items()
        if obstacle.shape.mesh is not None
    ]
    if scene.obstacles and scene.cuts_cells:
        readers = [partial(obstacle_surfaces, scene)]
    for read in [lambda: meshes.update(build_bodies(scene)), *readers]:
        try:
            read()
        except InputError as error:
            errors += [line for line in str(error).splitlines() if line not in errors]
    if errors:
        raise InputError("\n".join(errors))
    beams = {name: solid.shape.beam for name, solid in scene.solids.items() if solid.shape.beam is not None}
    meshes |= {name: axis_mesh(beam) for name, beam in beams.items()}
    for name, solid in scene.solids.items():
        if solid.elements == "quadratic":
            meshes[name] = with_middles(*meshes[name])
    return {n: len(points) for n, (points, _) in meshes.items()}, {n: len(cells) for n, (_, cells) in meshes.items()}


def _plain_cells(solid: Solid) -> list[int] | None:
    """Return the cells per axis of a box or ball about which only what the scene alone shows can be wrong."""
    shape = solid.shape
    places = [support.where for support in solid.supports] + [load.where for load in solid.loads]
    if shape.cavity is not None or not all(isinstance(where, str) for where in places):
        return None
    if shape.ball is not None and shape.ball.cells is not None:
        return [shape.ball.cells] * len(shape.ball.centre)
    return shape.box.cells if shape.box is not None else None


def _options(scene: Scene, nodes: dict[str, int], petsc_options: Sequence[str]) -> str:
    default = _default_options(scene, nodes)
    options.resolve(petsc_options, os.environ, default)
    given = options.from_words(petsc_options)
    files = [value for word, value in pairwise([*petsc_options, ""]) if word.lower() == f"-{options.FILE}"]
    chosen = ", ".join(files) or f"{default} (the default)"
    over = [*options.from_environment(os.environ), *(o for o in given if o.origin == options.COMMAND_LINE)]
    whole = (scene.fluid is not None and scene.solids) or chosen.startswith(LARGE_OPTIONS)
    coupled = "" if whole else "; of it, what the single field reads"
    return chosen + coupled + (f"; over it {' '.join(map(str, over))}" if over else "")


# ---- the installation ---------------------------------------------------------------------------------------


def describe_info() -> str:
    """Return versions, PETSc's packages, the solvers' prefixes and the shipped options files. Starts PETSc."""
    return "\n".join([*_versions(), "", *_prefixes(), "", *_options_files()])


def _versions() -> list[str]:
    import h5py
    import mpi4py
    import numba
    import petsc4py
    from mpi4py import MPI
    from petsc4py import PETSc

    library = MPI.Get_library_version().split(",")[0].split("\n")[0].strip()
    scalar = np.dtype(PETSc.ScalarType).name
    packages = [name for name in PACKAGES if PETSc.Sys.hasExternalPackage(name)]
    rows = [
        ("petfsi", __version__),
        ("PETSc", f"{'.'.join(map(str, PETSc.Sys.getVersion()))} ({scalar}, {np.dtype(PETSc.IntType).name} indices)"),
        ("petsc4py", petsc4py.__version__),
        ("mpi4py", f"{mpi4py.__version__} ({library})"),
        ("h5py", f"{h5py.__version__} ({'parallel' if h5py.get_config().mpi else 'serial: no parallel output'})"),
        ("numpy", np.__version__),
        ("numba", numba.__version__),
        ("PETSc has", ", ".join(packages) or "no external packages"),
    ]
    return [f"{name + ':':<12}{text}" for name, text in rows]


def _prefixes() -> list[str]:
    from petfsi.solving.option_rules import PREFIX, field_prefix

    rows = [
        (PREFIX, "the coupled system of a step: solid velocities and fluid pressures"),
        (f"{PREFIX}snes_", "how often it is linearised: ..type ksponly | newtonls"),
        (field_prefix("solid"), "the solid's block in it, or a scene without fluid"),
        (field_prefix("pressure"), "the pressure's block in it, or a scene without solids"),
        (field_prefix("particles"), "the velocities of particles, where their viscosity is solved for"),
    ]
    return ["solvers:", *(f"  -{prefix:<27}{text}" for prefix, text in rows)]


def _options_files() -> list[str]:
    files = options.shipped_options()
    return ["options files (give the name to -options_file):", *(f"  {p.name:<27}{_first_sentence(p)}" for p in files)]


def _first_sentence(path: Path) -> str:
    """Return how an options file's opening comment begins."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.lstrip("# ").strip() for line in takewhile(lambda line: line.startswith("#"), lines))
    return re.split(r"(?<=\.)\s+(?=[A-Z])", comment)[0]
