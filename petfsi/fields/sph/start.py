"""A fluid of particles at time zero: where they are, how heavy and how fast, and the law they obey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from petfsi.errors import InputError
from petfsi.fields.sph.domain import Domain
from petfsi.fields.sph.dummies import Dummies, wall_dummies
from petfsi.fields.sph.fill import Fill, hydrostatic, liquid
from petfsi.fields.sph.inlets import inlets
from petfsi.fields.sph.law import Law
from petfsi.fields.sph.layers import fine_cells
from petfsi.fields.sph.plates import plates
from petfsi.fields.sph.solids import SAME, Solid, nearest, pseudonormals
from petfsi.fields.sph.thin import backed
from petfsi.scene import fluids, particle_checks
from petfsi.scene.expressions import Expression
from petfsi.scene.schema import Obstacle, Scene
from petfsi.scene.shape_checks import OPPOSITE
from petfsi.scene.sides import at_rest

#: The sound speed is so many times the fastest flow, so that density varies by one in a hundred.
MACH = 10.0
#: Parts of the limits on the step: sound, viscosity, forces. The scheme's bounds are 1.2 and, for the second, 0.23.
ACOUSTIC, VISCOUS, FORCED = 0.9, 0.2, 0.25
#: A liquid that fills more than this part of the room, of which so many places along each axis are asked, has no free
#: surface.
FULL, SAMPLES = 0.9, 24
#: What bodies are called among the obstacles that keep liquid out at the start.
BODY = "solids."
#: Viscosity is solved for where its limit on explicit steps is below this part of sound's.
IMPLICIT = 0.25
#: With less smoothing the kernel's sums are off by more than a hundredth, and pressures with them.
SMOOTH = {"wendland": 1.4, "quadratic": 1.2, "cubic": 1.1}


class Start:
    """What a scene says of its particles. Not collective: every rank makes the same of it.

    Attributes
    ----------
    law : Law
    inlets : list of Inlet
    plates : list of Plate
    implicit : bool
        Whether viscosity is solved for.
    x, v : ndarray, shape (n, dim)
        m, m/s; those that wait behind inflows last.
    rho, m : ndarray, shape (n,)
        kg/m^3 and kg (per metre in 2D): the mass of a place is that of what fills it under its pressure.
    waiting : float
        Mass of those that wait, kg.
    notes : list of str
        What a user should know.

    Raises
    ------
    InputError
        If there is no particle, or nothing says how fast sound must be.
    """

    def __init__(self, scene: Scene):
        fluid = scene.fluid
        assert isinstance(fluid, fluids.SphFluid)
        self._scene, self._fluid = scene, fluid
        low = np.array(fluid.origin, dtype=float)
        sides = tuple(
            (at_rest(getattr(fluid.sides, a)), at_rest(getattr(fluid.sides, b))) for a, b in OPPOSITE[: scene.dim]
        )
        self._domain = Domain(low, low + fluid.size, sides)
        solid = scene.obstacles | _bodies(scene)
        found = liquid(self._domain, fluid.spacing, fluid.fill, solid, scene.directory, fitted=True)
        self.x, self.notes = found.x, list(found.notes)
        if not len(self.x):
            raise InputError("fluid.fill: holds no particle; is it outside the box, or inside an obstacle?")
        self.v = self._velocities()
        gravity = self._gravity()
        nu, s = fluid.viscosity / fluid.density, fluid.smoothing * fluid.spacing
        self.plates = plates(self._domain, fluid, scene.time.end)
        self.inlets = inlets(self._domain, fluid.spacing, 2 * s, found.is_solid, scene.time.end)
        c = fluid.sound_speed or self._sound_speed(gravity)
        terms: Mapping[str, Any] = {"alpha": fluid.alpha, "nu": nu, "delta": fluid.density_diffusion}
        suction = self._has_no_surface(found) if fluid.suction is None else fluid.suction
        g = tuple(gravity.tolist())
        self.law = Law(scene.dim, fluid.density, c, s, fluid.spacing, fluid.kernel, g, suction=suction, **terms)
        self.implicit = self._is_implicit()
        p = np.zeros(len(self.x))
        if fluid.pressure == "hydrostatic":
            p = hydrostatic(self.x, gravity, self.law, self._domain.periodic, found.is_solid)
        self.rho = self.law.density(p)
        self.m = self.rho * found.volume
        self._let_wait(p)
        if c < MACH * self._driven * (1 - SAME):
            self.notes.append(
                f"fluid.sound_speed = {c:g}: less than {MACH:g} times what comes in or moves at a side, "
                f"{self._driven:.3g} m/s, so that densities vary by more than a hundredth"
            )
        self.notes += _thin_obstacles(found.solids, 2 * s)
        if fluid.smoothing < SMOOTH[fluid.kernel]:
            self.notes.append(
                f"fluid.smoothing = {fluid.smoothing:g}: the {fluid.kernel} kernel's sums err by more than 1% on a "
                f"lattice below {SMOOTH[fluid.kernel]:g}, and pressures by as much"
            )

    def _let_wait(self, p: np.ndarray) -> None:
        """Add the particles that wait behind inflows, under the pressure p (n,) of the liquid inside."""
        parts = [(self.x, self.v, self.rho, self.m)]
        for inlet in self.inlets:
            x, column = inlet.filled()
            at_foot = inlet.pressure_in(self.x, p, self.law, 2 * self.law.s)[column]
            way = x - inlet.feet[column]
            rho = self.law.density(at_foot + self.law.rho0 * (way @ np.array(self.law.gravity)))
            v = inlet.speed(0.0)[column][:, None] * inlet.inward
            parts.append((x, v, rho, rho * float(np.prod(inlet.width))))
        self.waiting = sum(float(part[3].sum()) for part in parts[1:])
        self.x, self.v, self.rho, self.m = (np.concatenate(every) for every in zip(*parts, strict=True))

    @property
    def _driven(self) -> float:
        """The largest speed of what comes in and of sides, m/s."""
        return max([0.0, *(inlet.fastest for inlet in self.inlets), *(plate.fastest for plate in self.plates)])

    def _gravity(self) -> np.ndarray:
        given = self._scene.gravity or [0.0] * self._scene.dim
        return np.array([float(Expression(g, ("t",), f"gravity.{n}")(t=0.0)) for n, g in enumerate(given)])

    def _velocities(self) -> np.ndarray:
        given = self._fluid.initial.velocity
        v = np.zeros_like(self.x)
        axes = ("x", "y", "z")[: self._scene.dim]
        for n, source in enumerate(given or []):
            expression = Expression(source, axes, f"fluid.initial.velocity.{n}")
            v[:, n] = expression(**dict(zip(axes, self.x.T, strict=True)))
        return v

    def _sound_speed(self, gravity: np.ndarray) -> float:
        """Return 10 times the speed of what falls through the liquid's height, of inflows and so on, m/s."""
        heights = self.x @ gravity
        fastest = max(float(np.sqrt(2 * np.ptp(heights))), float(np.linalg.norm(self.v, axis=1).max()), self._driven)
        if fastest == 0:
            raise InputError("fluid.sound_speed: must be given (m/s), for nothing falls or moves at the start")
        return MACH * fastest

    def _has_no_surface(self, found: Fill) -> bool:
        """Whether the liquid fills nearly all places that it can be in, as far as a coarse lattice tells."""
        low, size = self._domain.low, self._domain.high - self._domain.low
        places = low + size * (fine_cells(self._scene.dim, SAMPLES) + 0.5)
        room = size.prod() * np.mean(~found.is_solid(places))
        return bool(found.volume.sum() > FULL * room)

    def _is_implicit(self) -> bool:
        """Return whether viscosity is solved for: as the scene says, or where it would shorten steps by far."""
        choice = self._fluid.viscosity_solve
        if choice != "auto" or particle_checks.why_explicit(self._scene):
            return choice == "implicit"
        every = self._every_limit()
        return every["viscosity"] < IMPLICIT * every["sound"]

    @property
    def explicit_law(self) -> Law:
        """The law without what is solved for."""
        return replace(self.law, nu=0.0) if self.implicit else self.law

    def limits(self) -> dict[str, float]:
        """Return what limits the step at the start by name, s."""
        every = self._every_limit()
        return {name: limit for name, limit in every.items() if not (self.implicit and name == "viscosity")}

    def viscosity_story(self) -> str:
        """Return how viscosity is stepped, and why."""
        every, reason = self._every_limit(), particle_checks.why_explicit(self._scene)
        how = "implicit" if self.implicit else "explicit"
        if self._fluid.viscosity_solve != "auto":
            why = "as fluid.viscosity_solve says"
        elif reason:
            why = reason[0]
        else:
            why = f"the first is {'' if self.implicit else 'not '}below {IMPLICIT:g} of the second"
        numbers = f"{every['viscosity']:.3g} s, by sound {every['sound']:.3g} s"
        return f"{how}; explicit steps are limited by viscosity to {numbers}: {why}"

    def _every_limit(self) -> dict[str, float]:
        fastest = float(np.linalg.norm(self.v, axis=1).max())
        return limits(self.law, fastest, float(np.linalg.norm(self.law.gravity)))

    def dummies(self) -> Dummies:
        """Return the wall particles of sides and obstacles."""
        scene, domain = self._scene, self._domain
        no_slip = () if self._fluid.viscosity == 0 else tuple(scene.obstacles)
        return wall_dummies(domain, self.law.spacing, 2 * self.law.s, scene.obstacles, scene.directory, no_slip)

    def rows(self, mine: slice) -> Mapping[str, np.ndarray]:
        """Return the columns of some of the particles, with their ids."""
        found = {name: getattr(self, name)[mine] for name in ("x", "v", "rho", "m")}
        return {**found, "id": np.arange(len(self.x))[mine]}


def _thin_obstacles(solids: Sequence[Solid], reach: float) -> list[str]:
    """Return that water on two sides of an obstacle feels what is on the other, where it does."""
    found = []
    for solid in solids:
        corners = solid.corners
        points = corners.reshape(-1, corners.shape[2])
        facets = np.arange(len(points)).reshape(corners.shape[:2])
        if not solid.name.startswith(BODY) and np.any(backed(points, facets, reach)):
            found.append(
                f"obstacles.{solid.name}: is thinner than particles see, {reach:g} m, so those on its two sides feel "
                'each other; a solid that is held everywhere (supports where = "all") parts them, however thin it is'
            )
    return found


def _bodies(scene: Scene) -> dict[str, Obstacle]:
    """Return what solids fill at the start, as obstacles.

    Beams are too thin, displaced ones are elsewhere, and meshes have no surface before they are read: ``immerse`` takes
    out what is in these.
    """
    found = {}
    for name, solid in scene.solids.items():
        shape = solid.shape
        if shape.beam is None and shape.mesh is None and shape.cavity is None and solid.initial.displacement is None:
            parts = {kind: getattr(shape, kind) for kind in ("box", "ball") if getattr(shape, kind) is not None}
            plain = {kind: part.model_copy(update={"cells": None}) for kind, part in parts.items()}
            found[f"{BODY}{name}"] = Obstacle(shape=shape.model_copy(update=plain))
    return found


def limits(law: Law, fastest: float, strongest: float) -> dict[str, float]:
    """Return what limits the step by name, s, at the largest speed (m/s) and acceleration (m/s^2)."""
    found = {"sound": ACOUSTIC * law.s / (law.c + fastest)}
    if law.nu > 0:
        found["viscosity"] = VISCOUS * law.s**2 / law.nu
    if strongest > 0:
        found["forces"] = FORCED * float(np.sqrt(law.s / strongest))
    return found


def depth_behind(x: np.ndarray, points: np.ndarray, facets: np.ndarray, reach: float) -> np.ndarray:
    """Return how deep places x (n, dim) lie behind a surface, m; minus infinity farther than ``reach`` from it."""
    depth, _ = nearest(x, points[facets], pseudonormals(points, facets), reach, reach)
    return np.where(np.isfinite(depth), depth, -np.inf)
