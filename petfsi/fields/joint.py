"""Solids of several kinds in one scene as a single field."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from mpi4py import MPI

from petfsi.errors import InputError
from petfsi.fields.base import Stock, Work
from petfsi.fields.slabs import Reader, Slab
from petfsi.fields.solid.equations.mass import AddedRows, Rows
from petfsi.fields.solid.field import NodalSolid
from petfsi.fields.solids import Forces, Landing, SolidField
from petfsi.fields.stacked import Stack, joined_surface, stacked_numbers
from petfsi.geometry.bodies import build_bodies
from petfsi.geometry.surfaces import Surface
from petfsi.petsc import IntType, Layout, new_block, set_csr, set_near_null_space
from petfsi.ranks import on_root
from petfsi.scene.schema import Scene


class JointSolid(SolidField):
    """Fields of one kind of solid each, seen as one.

    A rank holds its unknowns part after part, so that each part's rows of the block are contiguous and the block,
    A = diag(A_1, A_2, ...) up to the order of the unknowns, is the parts' values one after the other. What the parts
    give by their own global numbers is renumbered rank by rank. Kinds do not feel each other but through a fluid.

    Parameters
    ----------
    comm : MPI.Comm
    scene : Scene
    kinds : mapping of str to str
        The kind of each body.
    fields : mapping of str to callable
        What makes the field of a kind from ranks and a scene; its key begins the names of the part's state.

    Attributes
    ----------
    names : list of str
        All bodies, in the order of the scene.
    kinds : list of str
    parts : list of NodalSolid
        Of each kind.
    """

    name = "solid"

    def __init__(
        self, comm: MPI.Comm, scene: Scene, kinds: Mapping[str, str],
        fields: Mapping[str, Callable[[MPI.Comm, Scene], NodalSolid]],
    ) -> None:  # fmt: skip
        self.comm = comm
        self.names, self.kinds = list(scene.solids), list(fields)
        self.parts: list[NodalSolid] = []
        on_root(comm, lambda: build_bodies(scene) and None)  # a part cannot tell whether its bodies overlap another's
        for kind, make in fields.items():
            own = {name: solid for name, solid in scene.solids.items() if kinds[name] == kind}
            self.parts.append(make(comm, scene.model_copy(update={"solids": own})))
        self.explicit = self.diagonal = self.parts[0].explicit
        self.warnings = [line for part in self.parts for line in part.warnings]
        self.is_linear = all(part.is_linear for part in self.parts)
        self.extent = self._largest_side()
        counts = [part.layout.n_local for part in self.parts]
        ends = np.cumsum(counts)
        self._pieces = [slice(end - n, end) for end, n in zip(ends, counts, strict=True)]
        self.layout = Layout.of(comm, int(ends[-1]))
        self._number = stacked_numbers(comm, counts)
        whose = zip(self._scene_numbers(), self.parts, strict=True)
        self.owner = np.concatenate([number[part.owner] for number, part in whose])
        self.rhs = np.zeros(self.layout.n_local)
        self.moved = np.zeros(self.layout.n_local)
        acting = {name for part in self.parts for name in part.acting}
        self.acting = tuple(sorted(acting))
        self._set_block()
        nodes = [part.layout.n_global // part.width for part in self.parts]
        self.set_scale(float(np.average([part.mean_mass for part in self.parts], weights=nodes)))
        self._surface: Surface | None = None
        self._surfaces: list[Surface] = []
        self._static: dict[str, Slab] = {}

    def _largest_side(self) -> float:
        """Return the largest side of the bounding box of all bodies at rest, m. Collective."""
        x = np.concatenate([part.reference for part in self.parts])
        ends = np.stack((x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)))
        whole = np.empty_like(ends)
        self.comm.Allreduce(ends, whole, MPI.MAX)
        return float(whole.sum(axis=0).max())

    def _set_block(self) -> None:
        rows = [part.rows for part in self.parts]
        sizes = [len(values) for _, _, values in rows]
        starts = np.concatenate(([0], np.cumsum(sizes)))
        self._entries = [slice(a, b) for a, b in zip(starts[:-1], starts[1:], strict=True)]
        indptr = [ptr[1:] + start for (ptr, _, _), start in zip(rows, starts, strict=False)]
        self._indptr = np.concatenate(([0], *indptr)).astype(IntType)
        # numbers keep their order, so columns stay sorted
        self._indices = np.concatenate([n[columns] for n, (_, columns, _) in zip(self._number, rows, strict=True)])
        self._values = np.zeros(starts[-1])
        self.block = new_block(self.comm, self.layout, self.layout)
        set_csr(self.block, self._indptr, self._indices, self._values, new_pattern=True)
        self._added = AddedRows(self.comm)
        self._assembled = [0] * (len(self.parts) + 1)
        modes = zip(*(part.near_null_space() for part in self.parts), strict=True)
        set_near_null_space(self.block, [np.concatenate(mode) for mode in modes])

    def _split(self, x: np.ndarray) -> list[tuple[NodalSolid, np.ndarray]]:
        return [(part, x[piece]) for part, piece in zip(self.parts, self._pieces, strict=True)]

    # ---- the step ---------------------------------------------------------------------------------------------

    def unknown(self) -> np.ndarray:
        """Return the velocities of the step last accepted."""
        return np.concatenate([part.unknown() for part in self.parts])

    def predict(self, time: float, dt: float) -> None:
        """Begin the step in every part."""
        for part in self.parts:
            part.predict(time, dt)

    def predicted(self) -> float:
        """Return how far off the farthest of this rank's nodes is where the step's equations are taken, m."""
        # what is no number counts most
        return float(np.max([part.predicted() for part in self.parts]))

    def assemble(self, time: float, dt: float) -> None:
        """Refresh block (only if that of a part has changed) and right-hand side. Collective."""
        for part in self.parts:
            part.assemble(time, dt)
        self.rhs[:] = np.concatenate([part.rhs for part in self.parts])
        self.row_scale = self.parts[0].row_scale
        assembled = [*(part.n_assembled for part in self.parts), self._added.version]
        if assembled == self._assembled:
            return
        for n, part in enumerate(self.parts):
            if assembled[n] != self._assembled[n]:
                self._values[self._entries[n]] = part.rows[2]
        # all of it: whoever solves has scaled the block in place
        self.pattern_version += self._added.fill(self.block, (self._indptr, self._indices, self._values))
        self._assembled = assembled
        self.n_assembled += 1

    def take_mass(self, rows: Rows | None) -> None:
        """Add these rows to the block from now on."""
        self._added.take(rows)

    def accept(self, x: np.ndarray, time: float, dt: float) -> None:
        """Give every part its velocities."""
        for part, mine in self._split(x):
            part.accept(mine, time, dt)
        self.moved = np.concatenate([part.moved for part in self.parts])

    def jolt(self) -> np.ndarray | None:
        """Return what supports do to the free unknowns of every part at the start."""
        every = [part.jolt() for part in self.parts]
        if all(pull is None for pull in every):
            return None
        none = [np.zeros(part.layout.n_local) for part in self.parts]
        return np.concatenate([zero if pull is None else pull for pull, zero in zip(every, none, strict=True)])

    def push(self, change: np.ndarray) -> None:
        """Change the velocities of every part by its share."""
        for part, mine in self._split(change):
            part.push(mine)

    def rewind(self) -> None:
        """Forget the step begun, in every part."""
        for part in self.parts:
            part.rewind()

    def linearised_at(self) -> np.ndarray:
        """Return where every part's block is the derivative."""
        return np.concatenate([part.linearised_at() for part in self.parts])

    def relinearise(self, x: np.ndarray) -> bool:
        """Let every part linearise about x; return whether that changes any."""
        return sum([part.relinearise(mine) for part, mine in self._split(x)]) > 0  # not any(): every part must hear

    def round_off(self, x: np.ndarray) -> float:
        """Return the sum of the parts' round-off. Collective."""
        # parts' own blocks are not scaled
        return self.row_scale * sum(part.round_off(mine) for part, mine in self._split(x))

    def set_scale(self, reference_mass: float) -> None:
        """Measure the rows of all parts against this mass, kg."""
        for part in self.parts:
            part.set_scale(reference_mass)

    def judge(self, x: np.ndarray, dt: float) -> None:
        """Let every part judge its own. Collective."""
        for part, mine in self._split(x):
            part.judge(mine, dt)

    def inside_out(self) -> str:
        """Return which body of any part has an element inside out. Collective."""
        return "; ".join(filter(None, [part.inside_out() for part in self.parts]))

    def volume_ratios(self) -> dict[str, float]:
        """Return those of all parts. Collective."""
        return {name: ratio for part in self.parts for name, ratio in part.volume_ratios().items()}

    def foreseen(self) -> np.ndarray:
        """Return the solution of all parts as known before the solve."""
        return np.concatenate([part.foreseen() for part in self.parts])

    def remark(self, dt: float) -> str | None:
        """Return what the parts remark. Collective."""
        found = [text for text in [part.remark(dt) for part in self.parts] if text]
        return "; ".join(found) or None

    @property
    def finest(self) -> float:
        """Length of the shortest edge of any part at rest, m. Collective at first."""
        return min(part.finest for part in self.parts)

    def unheld(self) -> list[str]:
        """Return what is wrong with bodies that nothing holds in statics. Collective."""
        return [text for part in self.parts for text in part.unheld()]

    def stable_step(self) -> float:
        """Return the shortest of the parts' stable steps, s. Collective."""
        return min(part.stable_step() for part in self.parts)

    def stretch(self) -> float:
        """Return the largest relative change of an edge of any part since the last ``stable_step``. Collective."""
        return max(part.stretch() for part in self.parts)

    def along_axes(self, x: np.ndarray) -> np.ndarray:
        """Return the velocities along the axes of all nodes, shape (n_owned, dim)."""
        return np.concatenate([part.along_axes(mine) for part, mine in self._split(x)])

    def light_motions(self, degree: int, density: float, most: int) -> np.ndarray:
        """Return polynomial motions of each light body of every part, shape (n, layout.n_local). Collective."""
        for lower in range(degree, -1, -1):
            motions = [part.light_motions(lower, density, most) for part in self.parts]
            if sum(map(len, motions)) <= most:
                break
        else:
            return np.zeros((0, self.layout.n_local))
        rows = np.cumsum([0, *map(len, motions)])
        whole = np.zeros((rows[-1], self.layout.n_local))
        for n, piece in enumerate(self._pieces):
            whole[rows[n] : rows[n + 1], piece] = motions[n]
        return whole

    # ---- the surface ------------------------------------------------------------------------------------------

    def surface(self) -> Surface:
        """Return the surfaces of all parts as one; another object when that of a part is another. Collective."""
        surfaces = [part.surface() for part in self.parts]
        known = zip(surfaces, self._surfaces, strict=False)
        if self._surface is None or any(new is not old for new, old in known):
            self._surfaces = surfaces
            self._surface = joined_surface(surfaces, self._number, self.layout.n_global)
        return self._surface

    def surface_bodies(self) -> np.ndarray:
        """Return the body of each of its points as numbered in the scene."""
        every = zip(self._scene_numbers(), self.parts, strict=True)
        return np.concatenate([number[part.surface_bodies()] for number, part in every])

    def _scene_numbers(self) -> list[np.ndarray]:
        """Return the numbers in the scene of each part's bodies."""
        return [np.array([self.names.index(name) for name in part.names]) for part in self.parts]

    def surface_rooted(self) -> np.ndarray:
        """Return which of its points supports hold where they are, along all axes."""
        return np.concatenate([part.surface_rooted() for part in self.parts])

    def surface_positions(self) -> np.ndarray:
        """Return the positions of the surface's points, shape (n_points, dim). Collective."""
        return np.concatenate([part.surface_positions() for part in self.parts])

    def surface_present(self) -> np.ndarray:
        """Return the present positions of its points, shape (n_points, dim). Collective."""
        return np.concatenate([part.surface_present() for part in self.parts])

    def surface_speed(self) -> np.ndarray:
        """Return w of the step last accepted at the points of ``surface_present``. Collective."""
        return np.concatenate([part.surface_speed() for part in self.parts])

    def surface_shift(self) -> np.ndarray:
        """Return how far its points are moved from ``surface_positions`` to where w = 0 leads. Collective."""
        return np.concatenate([part.surface_shift() for part in self.parts])

    def surface_arrival(self, x: np.ndarray | None, dt: float) -> np.ndarray:
        """Return where its points are after a step of dt with the solution x (None: zero). Collective."""
        every = np.zeros(self.layout.n_local) if x is None else x
        return np.concatenate([part.surface_arrival(mine, dt) for part, mine in self._split(every)])

    def landing(self, dt: float) -> Landing:
        """Return how a step of dt brings nodes to its end."""
        return self.parts[0].landing(dt)

    def surface_velocity(self) -> np.ndarray:
        """Return the solution of the step last accepted at the surface's points, shape (n_points, dim). Collective."""
        return np.concatenate([part.surface_velocity() for part in self.parts])

    def fixed_velocity(self) -> np.ndarray:
        """Return what the step prescribes of its solution by unknown, zero where free."""
        g = np.empty(self.layout.n_global)
        for part, number in zip(self.parts, self._number, strict=True):
            g[number] = part.fixed_velocity()
        return g

    # ---- what others read -------------------------------------------------------------------------------------

    def stock(self) -> Stock:
        """Return this rank's share of momentum and energy of all parts."""
        stocks = [part.stock() for part in self.parts]
        momentum = np.sum([s.momentum for s in stocks], axis=0)
        return Stock(momentum, sum(s.kinetic for s in stocks), sum(s.elastic for s in stocks))

    def forces(self) -> Forces:
        """Return what acted on all parts in the step last accepted. Collective."""
        return self._together([part.forces() for part in self.parts])

    def starting_forces(self) -> Forces:
        """Return what acts on all parts at time zero. Collective."""
        return self._together([part.starting_forces() for part in self.parts])

    def _together(self, every: list[Forces]) -> Forces:
        """Return the forces of all parts as one, as far as each that they act on knows them."""
        missing = {
            name for part, forces in zip(self.parts, every, strict=True) for name in part.acting if name not in forces
        }
        total = {name: np.zeros(self.layout.n_local) for name in self.acting if name not in missing}
        for piece, forces in zip(self._pieces, every, strict=True):
            for name in total.keys() & forces.keys():
                total[name][piece] = forces[name]
        return total

    def work(self, dt: float) -> Work:
        """Return this rank's share of what was done to all parts in the step last accepted."""
        return Work(damping=sum(part.work(dt).damping for part in self.parts))

    def power(self) -> Work:
        """Return this rank's share of the power on all parts in the step last accepted, W."""
        return Work(damping=sum(part.power().damping for part in self.parts))

    def probe(self, body: str, at: list[float], quantity: str) -> np.ndarray:
        """Return a quantity of a body's material point. Collective."""
        for part in self.parts:
            if body in part.names:
                return part.probe(body, at, quantity)
        raise InputError(f"a probe of {body!r} at {list(at)}: known solids are {', '.join(self.names)}")

    def output(self) -> dict[str, Slab]:
        """Return what the parts give, points and cells of one after those of the other. Collective."""
        outputs = [part.output() for part in self.parts]
        if not self._static:
            self._points = Stack(self.comm, [out["points"] for out in outputs])
            self._static = {"points": self._points([out["points"] for out in outputs]), **self._cells(outputs)}
        changing = [name for name in outputs[0] if name not in self._static]
        return self._static | {name: self._points([out[name] for out in outputs]) for name in changing}

    def _cells(self, outputs: list[dict[str, Slab]]) -> dict[str, Slab]:
        """Return cells by points of all parts, and their bodies as numbered in the scene. Collective."""
        stack = Stack(self.comm, [out["cells"] for out in outputs])
        first = np.cumsum([0] + [out["points"].shape[0] for out in outputs])
        cells, body = [], []
        for part, out, n in zip(self.parts, outputs, first, strict=False):
            own = np.array([self.names.index(name) for name in part.names], dtype=out["body"].data.dtype)
            cells.append(Slab(out["cells"].data + n, out["cells"].start, out["cells"].shape))
            body.append(Slab(own[out["body"].data], out["body"].start, out["body"].shape))
        return {"cells": stack(cells), "body": stack(body)}

    def stored(self, name: str, x: np.ndarray) -> dict[str, Slab]:
        """Return a value per unknown of all parts. Collective."""
        parts = zip(self.kinds, self._split(x), strict=True)
        return {f"{kind}_{name}": part.stored(name, mine)[name] for kind, (part, mine) in parts}

    def read_stored(self, read: Reader, name: str) -> np.ndarray:
        """Return what ``stored`` gave. Collective."""
        return np.concatenate([part.read_stored(_prefixed(read, kind), name) for kind, part in self._by_kind()])

    def _by_kind(self) -> Iterator[tuple[str, NodalSolid]]:
        return zip(self.kinds, self.parts, strict=True)

    def state(self) -> dict[str, Slab]:
        """Return the state of all parts. Collective."""
        states = [(kind, part.state()) for kind, part in self._by_kind()]
        return {f"{kind}_{name}": piece for kind, state in states for name, piece in state.items()}

    def restore(self, read: Reader) -> None:
        """Take the state of all parts back. Collective."""
        for kind, part in self._by_kind():
            part.restore(_prefixed(read, kind))


def _prefixed(read: Reader, kind: str) -> Reader:
    """Return the reader of the arrays of one kind."""
    return lambda name, start, count: read(f"{kind}_{name}", start, count)
