"""What a scene may say of its fluid: a table per kind, with the same words for the same things."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import BeforeValidator, Discriminator, Field, Tag, field_validator
from pydantic_core import PydanticCustomError

from petfsi.registry import FLUIDS
from petfsi.scene.tables import Cells, Flag, Number, Real, Shape, Table, Vector, one_of


class Inflow(Table):
    """A jet through (part of) a side."""

    speed: Annotated[Number, Field(description="m/s into the domain; may depend on x, y, z, t")]
    region: Annotated[Shape | None, Field(description="the part of the side in this shape, or all of it")] = None
    ramp: Annotated[Real, Field(ge=0, description="s over which the speed grows smoothly from zero")] = 0.0
    rest: Annotated[Any, Field(description="what the remainder of the side is")] = "slip"


#: What a given pressure is where fluid comes in: the static one, or static and kinetic energy together.
Entering = Annotated[Literal["static", "total"], Field(description="what the pressure is of fluid that comes in")]


class PressureSide(Table):
    """A side that fluid passes through, with a given pressure."""

    form: ClassVar[str] = "<pressure>"

    pressure: Annotated[Number, Field(description="Pa; may depend on x, y, z, t")]
    entering: Entering = "static"


class HydrostaticSide(Table):
    """A side that fluid passes through, with the pressure of a fluid at rest beyond it."""

    form: ClassVar[str] = "<hydrostatic>"

    hydrostatic: Annotated[Real, Field(description="m, how high against gravity the fluid beyond stands")]
    entering: Entering = "static"


class OpenSide(NamedTuple):
    """What an open side of a grid is: a pressure (Pa), and that of a fluid at rest up to a level (m) where it says so.

    Without a level the fluid beyond stands as high as the grid.
    """

    pressure: Number = 0.0
    hydrostatic: bool = False
    level: float | None = None
    total: bool = False


def _open_form(value: Any) -> str | None:
    """Tell the forms of an open side apart: by the key of a table."""
    if not isinstance(value, dict):
        return getattr(value, "form", "<name>")
    found = [key for key in ("pressure", "hydrostatic") if key in value]
    return f"<{found[0]}>" if len(found) == 1 else None


Rest = Annotated[
    Annotated[Literal["slip", "open", "hydrostatic"], Tag("<name>")]
    | Annotated[PressureSide, Tag(PressureSide.form)]
    | Annotated[HydrostaticSide, Tag(HydrostaticSide.form)],
    Discriminator(
        _open_form,
        custom_error_type="side",
        custom_error_message="must be 'slip', 'open' or 'hydrostatic', or a table of pressure or hydrostatic",
    ),
    Field(description="what the remainder of the side is"),
]


class GridInflow(Inflow):
    """A jet into a grid."""

    along: Annotated[
        list[Number] | None, Field(description="m/s along the side that is carried in; may depend on x, y, z, t")
    ] = None
    smoke: Annotated[Real, Field(ge=0, description="smoke carried in")] = 0.0
    rest: Rest = "slip"


class ParticleInflow(Inflow):
    """A jet of particles."""

    rest: Annotated[Literal["slip", "no-slip", "open"], Field(description="what the remainder of the side is")] = "slip"


class InflowSide(Table):
    """The table form of a side."""

    inflow: Inflow


class GridInflowSide(InflowSide):
    """That of a side of a grid."""

    form: ClassVar[str] = "<inflow>"

    inflow: GridInflow


class ParticleInflowSide(InflowSide):
    """That of a side of particles."""

    form: ClassVar[str] = "<inflow>"

    inflow: ParticleInflow


class Plate(Table):
    """What a wall that holds the fluid does."""

    velocity: Annotated[list[Number], Field(description="m/s along the side; may depend on x, y, z, t")]


class MovingSide(Table):
    """A side without slip that moves in its own plane."""

    form: ClassVar[str] = "<no-slip>"

    no_slip: Annotated[Plate, Field(alias="no-slip")]


def _grid_side_form(value: Any) -> str | None:
    """Tell the forms of a side of a grid apart: by the key of a table."""
    if isinstance(value, dict) and "inflow" in value:
        return None if "pressure" in value or "hydrostatic" in value else GridInflowSide.form
    return _open_form(value)


def _particle_side_form(value: Any) -> str | None:
    """Tell the forms of a side of particles apart: by the only key of a table."""
    if not isinstance(value, dict):
        return getattr(value, "form", "<name>")
    forms = {"inflow": ParticleInflowSide.form, "no-slip": MovingSide.form}
    found = [form for key, form in forms.items() if key in value]
    return found[0] if len(found) == 1 else None


def at_rest(side: str | InflowSide | MovingSide) -> str | InflowSide:
    """Return what a side of particles would be if it did not move."""
    return "no-slip" if isinstance(side, MovingSide) else side


def open_side(side: Side) -> OpenSide | None:
    """Return what a side of a grid is that fluid may pass through both ways, or the rest of one with a jet, or None."""
    form = side.inflow.rest if isinstance(side, GridInflowSide) else side
    if isinstance(form, PressureSide):
        return OpenSide(form.pressure, total=form.entering == "total")
    if isinstance(form, HydrostaticSide):
        return OpenSide(0.0, True, form.hydrostatic, form.entering == "total")
    return {"open": OpenSide(), "hydrostatic": OpenSide(hydrostatic=True)}.get(form)


Side = Annotated[
    Annotated[Literal["slip", "open", "hydrostatic", "periodic"], Tag("<name>")]
    | Annotated[GridInflowSide, Tag(GridInflowSide.form)]
    | Annotated[PressureSide, Tag(PressureSide.form)]
    | Annotated[HydrostaticSide, Tag(HydrostaticSide.form)],
    Discriminator(
        _grid_side_form,
        custom_error_type="side",
        custom_error_message="must be 'slip', 'open', 'hydrostatic' or 'periodic', or a table of one of inflow, "
        "pressure and hydrostatic",
    ),
    Field(description="or { inflow = { speed = ... } }, { pressure = ... }, { hydrostatic = ... }"),
]

ParticleSide = Annotated[
    Annotated[Literal["slip", "no-slip", "open", "periodic"], Tag("<name>")]
    | Annotated[ParticleInflowSide, Tag(ParticleInflowSide.form)]
    | Annotated[MovingSide, Tag(MovingSide.form)],
    Discriminator(
        _particle_side_form,
        custom_error_type="side",
        custom_error_message="must be 'slip', 'no-slip', 'open' or 'periodic', or a table of one key",
    ),
    Field(description="or { inflow = { speed = ... } }, or { no-slip = { velocity = [...] } }"),
]


class Sides(Table):
    """The sides of the grid; left/right bound x, bottom/top y, back/front z (3D only)."""

    left: Side = "slip"
    right: Side = "slip"
    bottom: Side = "slip"
    top: Side = "slip"
    back: Side = "slip"
    front: Side = "slip"


class Smoke(Table):
    """A scalar carried along with the fluid."""

    initial: Annotated[Number, Field(description="may depend on x, y, z")] = 0.0
    buoyancy: Annotated[Real, Field(description="acceleration against gravity per unit of smoke, over gravity")] = 0.0


class FluidInitial(Table):
    """The fluid at time zero."""

    velocity: Annotated[list[Number] | None, Field(description="m/s; may depend on x, y, z")] = None


class FluidTable(Table):
    """What fluids of every kind say."""

    kind: Annotated[str, BeforeValidator(one_of(FLUIDS))] = "mac"
    density: Annotated[Real, Field(gt=0, description="kg/m^3")]
    origin: Annotated[Vector, Field(description="m")]
    size: Annotated[Vector, Field(description="m")]
    initial: FluidInitial = FluidInitial()


class MacFluid(FluidTable):
    """An incompressible fluid on a regular staggered grid."""

    form: ClassVar[str] = "<mac>"
    transfers: ClassVar[tuple[str, ...]] = ("cutcell", "ray")

    viscosity: Annotated[Real, Field(description="Pa s")] = 0.0
    cells: Cells
    sides: Sides = Sides()
    advection: Literal["cubic", "linear"] = "cubic"
    smoke: Smoke | None = None

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


class ParticleSides(Table):
    """The sides of the box that holds the particles."""

    left: ParticleSide = "slip"
    right: ParticleSide = "slip"
    bottom: ParticleSide = "slip"
    top: ParticleSide = "slip"
    back: ParticleSide = "slip"
    front: ParticleSide = "slip"


class SphFluid(FluidTable):
    """A weakly compressible fluid of particles."""

    form: ClassVar[str] = "<sph>"
    transfers: ClassVar[tuple[str, ...]] = ("pressure", "repulsion")

    spacing: Annotated[Real, Field(gt=0, description="m between particles at the start")]
    smoothing: Annotated[Real, Field(ge=1, le=3, description="smoothing length over the spacing")] = 1.5
    kernel: Literal["wendland", "quadratic", "cubic"] = "wendland"
    sound_speed: Annotated[Real | None, Field(gt=0, le=1e6, description="m/s")] = None
    viscosity: Annotated[Real, Field(ge=0, description="Pa s")] = 0.0
    viscosity_solve: Annotated[
        Literal["auto", "explicit", "implicit"], Field(description="auto: implicit where it limits steps by far")
    ] = "auto"
    artificial_viscosity: Annotated[Real | None, Field(ge=0, description="Monaghan's alpha")] = None
    density_diffusion: Annotated[Real, Field(ge=0, le=1, description="delta of delta-SPH; 0 is none")] = 0.1
    shifting: Flag = True
    suction: Annotated[Flag | None, Field(description="whether walls hold back what is drawn away from them")] = None
    fill: Annotated[list[Shape], Field(min_length=1, description="where liquid is at the start")]
    pressure: Annotated[Literal["hydrostatic", "none"], Field(description="at the start")] = "hydrostatic"
    sides: ParticleSides = ParticleSides()

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


def _fluid_form(value: Any) -> str:
    """Tell kinds of fluids apart, so that errors speak of one of them only."""
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return SphFluid.form if kind == "sph" else MacFluid.form


Fluid = Annotated[
    Annotated[MacFluid, Tag(MacFluid.form)] | Annotated[SphFluid, Tag(SphFluid.form)], Discriminator(_fluid_form)
]
