"""What a scene may say: one frozen model per table, SI units, unknown keys refused.

The models judge one key at a time; what needs several keys at once stands in ``checks.py``. A field's description
is its unit or a few words on what is meant, and ends up in error messages. What a key means stands beside it as ``Doc``
(PEP 727), for ``petfsi help``: a first sentence that fits on a line, then more, and what is so where it is left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PrivateAttr, field_validator
from pydantic_core import PydanticCustomError
from typing_extensions import Doc

from petfsi.registry import COUPLINGS, INTEGRATORS
from petfsi.scene.fluid_kinds import Fluid
from petfsi.scene.fluids import MacFluid
from petfsi.scene.solids import Solid
from petfsi.scene.tables import Flag, Number, OneOf, Real, Shape, Table, Vector, Whole

if TYPE_CHECKING:
    from petfsi.integrators.base import Integrator


#: The names of all transfers, of whatever kind of fluid.
TRANSFERS = [name for transfers in COUPLINGS.values() for name in transfers]


class Time(Table):
    """When the run ends and how it steps."""

    end: Annotated[
        Real,
        Field(gt=0, description="s"),
        Doc("When the run ends. It begins at t = 0; where whole steps would pass the end, the last two share it."),
    ]
    dt: Annotated[
        Number,
        Field(description="s"),
        Doc(
            'How long a step is: a number, an expression of t, or "auto". "auto" is nine tenths of the stable step of '
            "what is explicit, particles or symplectic-euler."
        ),
    ]
    integrator: Annotated[
        str,
        BeforeValidator(OneOf(INTEGRATORS)),
        Doc(
            "The scheme in time, of fluid and solids alike. newmark: as published, of first order; bdf2: of second "
            "order, damps what is too fast for the step; midpoint: of second order, damps nothing; symplectic-euler: "
            "explicit for solids, with steps up to 2/omega; static: the equilibrium of solids under their loads, "
            "without inertia."
        ),
    ] = "bdf2"
    above_limit: Annotated[
        Literal["refuse", "subcycle"],
        Field(description="what becomes of steps above an explicit scheme's stable one"),
        Doc("Whether steps above the stable one of what is explicit are refused or divided. At most 10,000 parts."),
    ] = "refuse"
    retries: Annotated[
        Whole,
        Field(ge=0, le=20, description="how often a step that fails is halved"),
        Doc("How often a step that fails is halved. It is taken again in halves, these in halves, and so on."),
    ] = 3
    energy_limit: Annotated[
        Real,
        Field(description="part of its energy that may come out of nothing; -1: any"),
        Doc(
            "A run stops once it holds more by this part than it can have got. -1: it never does; wants "
            "output.accounts."
        ),
    ] = 1.0

    @property
    def scheme(self) -> Integrator:
        """The integrator itself."""
        from petfsi.integrators.base import integrator  # NumPy, of which who reads a scene has no need

        return integrator(self.integrator)

    @field_validator("energy_limit")
    @classmethod
    def _part_or_any(cls, limit: float) -> float:
        if limit < 0 and limit != -1:
            raise PydanticCustomError("energy_limit", "must be 0 or more, or -1")
        return limit

    @field_validator("dt")
    @classmethod
    def _positive(cls, dt: float | str) -> float | str:
        if not isinstance(dt, str) and dt <= 0:
            raise PydanticCustomError("greater_than", "must be greater than 0", {"gt": 0})
        return dt


class Obstacle(Table):
    """A rigid shape that stands still; feels nothing, and is felt by the fluid alone."""

    shape: Annotated[Shape, Doc("A box, ball, cylinder, halfspace, or a mesh file.")]
    outside: Annotated[Flag, Doc("Whether it is all but the shape: a container.")] = False


class Coupling(Table):
    """How fluid and solids are joined."""

    transfer: Annotated[
        str | None,
        BeforeValidator(OneOf(TRANSFERS, optional=True)),
        Doc(
            "How they act on each other. A grid has cutcell or ray (as published), particles have pressure or "
            "repulsion. Left out, it is cutcell or pressure, as suits the kind of fluid."
        ),
    ] = None
    quadrature: Annotated[
        Whole, Field(ge=1, le=4), Doc("With ray, facets are split until pieces are about a cell over this.")
    ] = 2


class Probe(Table):
    """A quantity written to every row of history.csv."""

    of: Annotated[
        str,
        Field(description="a solid's name, fluid, or what a force is on"),
        Doc('What is asked: a solid by its name, "fluid", or what feels a force. That is a side or an obstacle.'),
    ]
    at: Annotated[
        Vector | None,
        Field(description="m; in a solid, where the point is at rest"),
        Doc("Where it is asked. Left out of front and force. Of a fluid on a grid nan while no fluid is there."),
    ] = None
    quantity: Annotated[
        Literal["displacement", "velocity", "angle", "pressure", "smoke", "front", "level", "force"],
        Doc(
            "What is written. Solids have displacement and velocity, beams angle, too; a fluid has velocity and "
            "pressure, on a grid smoke, of particles front (the largest x of liquid), level (its height at a point) "
            "and force (on a side or an obstacle)."
        ),
    ]


class Output(Table):
    """What is written for pictures, and into history.csv."""

    every: Annotated[
        Annotated[Real, Field(gt=0)] | None,
        Field(description="s"),
        Doc("The time from one output of all fields to the next. Left out, none is written."),
    ] = None
    accounts: Annotated[bool, Doc("Whether history.csv accounts for volumes, momentum and energy.")] = True


class Checkpoint(Table):
    """When checkpoints are written and how many stay."""

    every: Annotated[
        Annotated[Real, Field(gt=0)] | None,
        Field(description="s of scene time"),
        Doc("The time from one checkpoint to the next. Left out, one is written at the end alone."),
    ] = None
    keep: Annotated[Whole, Field(ge=1), Doc("How many of the newest checkpoints stay.")] = 3


class Scene(Table):
    """A whole scene."""

    title: Annotated[str, Doc("What the log calls the run.")] = ""
    dim: Annotated[Literal[2, 3], Doc("The number of axes. In 2D all is per metre of thickness.")]
    gravity: Annotated[
        list[Number] | None,
        Field(description="m/s^2; may depend on t"),
        Doc("The acceleration of gravity, per axis. Left out, there is none."),
    ] = None
    time: Annotated[Time, Doc("When the run ends and how it steps.")]
    fluid: Annotated[Fluid | None, Doc("The fluid: on a grid, or of particles. Left out, there are solids alone.")] = (
        None
    )
    solids: Annotated[dict[str, Solid], Doc("Deformable bodies, any number, each by a name.")] = {}
    obstacles: Annotated[dict[str, Obstacle], Doc("Rigid shapes that stand still, any number, each by a name.")] = {}
    coupling: Annotated[Coupling, Doc("How fluid and solids are joined.")] = Coupling()
    probes: Annotated[dict[str, Probe], Doc("Columns of history.csv, any number, each by a name.")] = {}
    output: Annotated[Output, Doc("What is written for pictures, and into history.csv.")] = Output()
    checkpoint: Annotated[Checkpoint, Doc("When checkpoints are written and how many stay.")] = Checkpoint()

    _directory: Path = PrivateAttr(default=Path())

    def model_post_init(self, context: Any) -> None:
        """Remember where the scene was read."""
        if context:
            self._directory = Path(context["directory"])

    @property
    def transfer(self) -> str:
        """How fluid and solids are joined: as the scene says, else as suits the kind of fluid."""
        known = self.fluid.transfers if self.fluid is not None else ("cutcell",)
        return self.coupling.transfer or next(iter(known), "none")

    @property
    def cuts_cells(self) -> bool:
        """Whether walls cut the cells of a grid: for every transfer but that by rays, which stays as published."""
        return isinstance(self.fluid, MacFluid) and self.transfer != "ray"

    @property
    def unjudged(self) -> str:
        """Why nothing can be said of energy out of nothing; empty if something can."""
        if not self.output.accounts:
            return "output.accounts is false"
        return "" if self.time.scheme.inertia else f"the integrator is {self.time.integrator}"

    @property
    def directory(self) -> Path:
        """What relative mesh paths are relative to; of a loaded scene they are absolute already."""
        return self._directory

    def __eq__(self, other: object) -> bool:
        """Compare what is said, not where it was read."""
        return isinstance(other, Scene) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]
