"""What a scene may say of its fluid: a table per kind, with the same words for the same things."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field, field_validator
from pydantic_core import PydanticCustomError
from typing_extensions import Doc

from petfsi.registry import COUPLINGS, FLUIDS
from petfsi.scene.sides import ParticleSides, Sides
from petfsi.scene.tables import Cells, Density, Flag, Metres, Number, OneOf, Real, Shape, Table

#: The kind of a fluid that does not say which it is.
DEFAULT = "mac"


class Smoke(Table):
    """A scalar carried along with the fluid."""

    initial: Annotated[Number, Field(description="may depend on x, y, z"), Doc("Smoke at the start.")] = 0.0
    buoyancy: Annotated[
        Real,
        Field(description="acceleration against gravity per unit of smoke, over gravity"),
        Doc("Upward acceleration per unit of smoke, in units of gravity, which it wants."),
    ] = 0.0


class FluidInitial(Table):
    """The fluid at time zero."""

    velocity: Annotated[
        list[Number] | None,
        Field(description="m/s; may depend on x, y, z"),
        Doc("The velocity of the fluid at the start, per axis. Left out, it is at rest."),
    ] = None


class FluidTable(Table):
    """What fluids of every kind say."""

    form: ClassVar[str]

    kind: Annotated[
        str,
        BeforeValidator(OneOf(FLUIDS)),
        Doc("How the fluid is computed. mac: on a staggered grid, incompressible; sph: with particles."),
    ] = DEFAULT
    density: Annotated[Density, Doc("Mass per volume; of particles where their pressure is 0.")]
    origin: Annotated[
        Metres,
        Doc("The corner with the smallest coordinates: of the grid, or of the particles' box."),
    ]
    size: Annotated[Metres, Doc("The lengths of the grid, or of the particles' box, each greater than 0.")]
    initial: Annotated[FluidInitial, Doc("The fluid at time zero.")] = FluidInitial()

    @property
    def transfers(self) -> tuple[str, ...]:
        """How it may be joined to solids, the default first; empty where it cannot be."""
        return tuple(COUPLINGS.get(self.kind, ()))


class MacFluid(FluidTable):
    """An incompressible fluid on a regular staggered grid."""

    form: ClassVar[str] = "<mac>"

    viscosity: Annotated[
        Real, Field(description="Pa s"), Doc("Must be 0: this version solves inviscid fluids on grids.")
    ] = 0.0
    cells: Annotated[Cells, Doc("How many cells the grid has along each axis.")]
    sides: Annotated[Sides, Doc("What the grid is bounded by.")] = Sides()
    advection: Annotated[
        Literal["cubic", "linear"],
        Doc("How velocity and smoke are interpolated between points, as they are carried."),
    ] = "cubic"
    smoke: Annotated[
        Smoke | None, Doc("A scalar that is carried along; the table may be empty. Left out, none is.")
    ] = None

    @field_validator("viscosity")
    @classmethod
    def _inviscid(cls, viscosity: float) -> float:
        if viscosity != 0:
            raise PydanticCustomError("inviscid", "must be 0: this version solves inviscid fluids")
        return viscosity

    @property
    def resolution(self) -> float:
        """The shortest length that it resolves, m."""
        return min(size / n for size, n in zip(self.size, self.cells, strict=True))


class SphFluid(FluidTable):
    """A weakly compressible fluid of particles."""

    form: ClassVar[str] = "<sph>"

    spacing: Annotated[
        Real,
        Field(gt=0, description="m between particles at the start"),
        Doc("The distance between particles at the start, which sets how many there are."),
    ]
    smoothing: Annotated[
        Real,
        Field(ge=1, le=3, description="smoothing length over the spacing"),
        Doc("The smoothing length s over the spacing. Particles see 2 s far."),
    ] = 1.5
    kernel: Annotated[
        Literal["wendland", "quadratic", "cubic"], Doc("What neighbours are weighted with; wendland is Wendland's C2.")
    ] = "wendland"
    sound_speed: Annotated[
        Real | None,
        Field(gt=0, le=1e6, description="m/s"),
        Doc(
            "The speed of sound c: the larger, the stiffer the fluid, and the shorter steps. Left out, it is 10 sqrt(2 "
            "g H) of the fill, or ten times its largest speed, that of jets and sides included."
        ),
    ] = None
    viscosity: Annotated[
        Real,
        Field(ge=0, description="Pa s"),
        Doc("How viscous the fluid is. Where it is, no-slip sides and obstacles hold it."),
    ] = 0.0
    viscosity_solve: Annotated[
        Literal["auto", "explicit", "implicit"],
        Field(description="auto: implicit where it limits steps by far"),
        Doc("Whether viscosity is solved for. auto: implicit if its limit on steps is below 1/4 of sound's."),
    ] = "auto"
    artificial_viscosity: Annotated[
        Real | None,
        Field(ge=0, description="Monaghan's alpha"),
        Doc("Monaghan's alpha, which damps. Left out, it is 0.05 without viscosity, else 0."),
    ] = None
    density_diffusion: Annotated[
        Real,
        Field(ge=0, le=1, description="delta of delta-SPH; 0 is none"),
        Doc("How strongly densities are smoothed, but for the hydrostatic pressure's part."),
    ] = 0.1
    shifting: Annotated[
        Flag, Doc("Whether particles go a little to where they are fewer; not near a free surface.")
    ] = True
    suction: Annotated[
        Flag | None,
        Field(description="whether walls hold back what is drawn away from them"),
        Doc(
            "Whether walls hold back what is drawn away from them, with pressures below zero. Left out, they do where "
            "liquid fills the box at the start."
        ),
    ] = None
    fill: Annotated[
        list[Shape],
        Field(min_length=1, description="where liquid is at the start"),
        Doc("Where liquid is at the start: shapes and mesh files. What solids and obstacles fill holds none."),
    ]
    pressure: Annotated[
        Literal["hydrostatic", "none"],
        Field(description="at the start"),
        Doc("The pressure at the start: that of liquid at rest under gravity, or none."),
    ] = "hydrostatic"
    sides: Annotated[ParticleSides, Doc("What the box is bounded by.")] = ParticleSides()

    @property
    def resolution(self) -> float:
        """The shortest length that it resolves, m."""
        return self.spacing

    @property
    def alpha(self) -> float:
        """Monaghan's alpha: a little where nothing is said and the fluid has no viscosity."""
        if self.artificial_viscosity is None:
            return 0.05 if self.viscosity == 0 else 0.0
        return self.artificial_viscosity

    @property
    def smoke(self) -> None:
        """Particles carry none."""
        return

    @property
    def cells(self) -> None:
        """Particles have none."""
        return
