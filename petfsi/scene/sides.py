"""What a scene may say of the sides of its fluid: of a grid, and of the box that holds particles."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import Discriminator, Field, Tag
from typing_extensions import Doc

from petfsi.scene.tables import Number, Real, Shape, Table


class Inflow(Table):
    """A jet through a side, or through a part of it."""

    speed: Annotated[
        Number,
        Field(description="m/s into the domain; may depend on x, y, z, t"),
        Doc("The speed across the side, into the box. A negative one draws fluid out."),
    ]
    region: Annotated[
        Shape | None,
        Field(description="the part of the side in this shape, or all of it"),
        Doc("A box, ball, cylinder or halfspace: where the side has the jet. Left out, it has it everywhere."),
    ] = None
    ramp: Annotated[
        Real,
        Field(ge=0, description="s over which the speed grows smoothly from zero"),
        Doc("How long the jet takes to open: its speed times sin^2(pi t/(2 ramp)) until then."),
    ] = 0.0
    rest: Annotated[Any, Field(description="what the remainder of the side is")] = "slip"


Entering = Annotated[
    Literal["static", "total"],
    Field(description="what the pressure is of fluid that comes in"),
    Doc("What the given pressure is where fluid comes in. static: p; total: p + rho v^2/2, which bounds the inflow."),
]


class PressureSide(Table):
    """A side of a grid that fluid passes through, with a given pressure."""

    form: ClassVar[str] = "<pressure>"

    pressure: Annotated[
        Number, Field(description="Pa; may depend on x, y, z, t"), Doc("The pressure on the side; 0 is what open has.")
    ]
    entering: Entering = "static"


class HydrostaticSide(Table):
    """A side of a grid that fluid passes through, with the pressure of fluid at rest beyond it; wants gravity."""

    form: ClassVar[str] = "<hydrostatic>"

    hydrostatic: Annotated[
        Real,
        Field(description="m, how high against gravity the fluid beyond stands"),
        Doc("The level of the fluid beyond, a height against gravity g: -x . g/|g|."),
    ]
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
    Doc("What the side is beside the jet's region: as any side, but not periodic."),
]


class GridInflow(Inflow):
    """What a jet into a grid has besides."""

    along: Annotated[
        list[Number] | None,
        Field(description="m/s along the side that is carried in; may depend on x, y, z, t"),
        Doc(
            "The velocity that comes in with the jet, per axis, 0 across the side. Left out, fluid comes in with that "
            "of the fluid next to the side."
        ),
    ] = None
    smoke: Annotated[
        Real, Field(ge=0, description="smoke carried in"), Doc("The smoke that comes in; wants a table [fluid.smoke].")
    ] = 0.0
    rest: Rest = "slip"


class ParticleInflow(Inflow):
    """What a jet of particles has besides."""

    rest: Annotated[
        Literal["slip", "no-slip", "open"],
        Field(description="what the remainder of the side is"),
        Doc("What the side is beside the jet's region."),
    ] = "slip"


class InflowSide(Table):
    """A side with a jet."""

    inflow: Inflow


class GridInflowSide(InflowSide):
    """A side of a grid with a jet."""

    form: ClassVar[str] = "<inflow>"

    inflow: Annotated[GridInflow, Doc("The jet that comes in through the side.")]


class ParticleInflowSide(InflowSide):
    """A side with a jet of particles."""

    form: ClassVar[str] = "<inflow>"

    inflow: Annotated[ParticleInflow, Doc("The jet of particles that comes in through the side.")]


class Plate(Table):
    """How a wall moves that viscous fluid sticks to."""

    velocity: Annotated[
        list[Number],
        Field(description="m/s along the side; may depend on x, y, z, t"),
        Doc("The wall's velocity, 0 across the side; wants a viscosity."),
    ]


class MovingSide(Table):
    """A side without slip that moves in its own plane."""

    form: ClassVar[str] = "<no-slip>"

    no_slip: Annotated[Plate, Field(alias="no-slip"), Doc("A wall in its own plane's motion.")]


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
    Doc(
        "What fluid meets at the edge of the grid. slip: a wall; open: p = 0; hydrostatic: the pressure of fluid at "
        "rest beyond, as high as the grid; periodic: the opposite side, which must be periodic, too; or a table: a "
        "jet, a pressure, or fluid at rest up to a level."
    ),
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
    Doc(
        "What particles meet at the edge of the box. slip: a wall; no-slip: a wall that viscous fluid sticks to; open: "
        "p = 0, and what leaves is taken out; periodic: the opposite side, which must be periodic, too; or a table: a "
        "jet, or a wall that moves in its own plane."
    ),
]


class Sides(Table):
    """The sides of the grid; left/right bound x, bottom/top y, back/front z (3D only)."""

    left: Side = "slip"
    right: Side = "slip"
    bottom: Side = "slip"
    top: Side = "slip"
    back: Side = "slip"
    front: Side = "slip"


class ParticleSides(Table):
    """The sides of the box of particles; left/right bound x, bottom/top y, back/front z (3D only)."""

    left: ParticleSide = "slip"
    right: ParticleSide = "slip"
    bottom: ParticleSide = "slip"
    top: ParticleSide = "slip"
    back: ParticleSide = "slip"
    front: ParticleSide = "slip"
