"""What a scene may say: one frozen model per table, SI units, unknown keys refused.

The models judge one key at a time; what needs several keys at once stands in ``checks.py``. A field's description
is its unit or a few words on what is meant, and ends up in error messages.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, PrivateAttr, Tag, field_validator
from pydantic_core import PydanticCustomError

from petfsi.integrators import INTEGRATORS
from petfsi.registry import COUPLINGS, MATERIALS
from petfsi.scene.fluids import Fluid
from petfsi.scene.tables import Flag, GroupName, Number, Real, Shape, Table, Vector, Whole, one_of

Component = Literal["x", "y", "z", "angle"]
Place = Literal["left", "right", "bottom", "top", "back", "front", "all", "start", "end"]


class Time(Table):
    """When the run ends and how it steps."""

    end: Annotated[Real, Field(gt=0, description="s")]
    dt: Annotated[Number, Field(description="s")]
    integrator: Annotated[str, BeforeValidator(one_of(INTEGRATORS))] = "bdf2"
    above_limit: Annotated[
        Literal["refuse", "subcycle"], Field(description="what becomes of steps above an explicit scheme's stable one")
    ] = "refuse"
    retries: Annotated[Whole, Field(ge=0, le=20, description="how often a step that fails is halved")] = 3
    energy_limit: Annotated[Real, Field(description="part of its energy that may come out of nothing; -1: any")] = 1.0

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


# ---- solids -------------------------------------------------------------------------------------------------


class Damping(Table):
    """Rayleigh damping C = mass * M + stiffness * K'."""

    mass: Annotated[Real, Field(ge=0, description="1/s")] = 0.0
    stiffness: Annotated[Real, Field(ge=0, description="s")] = 0.0


class Tagged(Table):
    """A group of boundary facets or of nodes that a mesh file has a name (or a number) for."""

    tag: Annotated[GroupName, Field(description="the name of a group of facets or nodes in the mesh file")]


def _where_form(value: Any) -> str:
    if isinstance(value, Tagged) or (isinstance(value, dict) and "tag" in value):
        return "<tag>"
    return "<table>" if isinstance(value, dict | Shape) else "<name>"


#: A side of the solid's bounding box (left, right, bottom, top, back, front), all, the start or end of a beam, a shape
#: or a mesh file's tag.
Where = Annotated[
    Annotated[Place, Tag("<name>")] | Annotated[Shape, Tag("<table>")] | Annotated[Tagged, Tag("<tag>")],
    Discriminator(_where_form),
]
_WHERE = "or a shape such as { box = { origin = ..., size = ... } }, or { tag = ... } of a mesh file"


class Support(Table):
    """Nodes whose motion is prescribed: at rest, unless a velocity or a displacement is given."""

    where: Annotated[Where, Field(description=_WHERE)]
    fix: Annotated[list[Component], Field(min_length=1, description="axes that are held; of a beam its angle, too")]
    velocity: Annotated[
        dict[Component, Number], Field(description="m/s of fixed axes, rad/s; may depend on x, y, z, t")
    ] = {}
    displacement: Annotated[
        dict[Component, Number], Field(description="m of fixed axes, rad; may depend on x, y, z, t")
    ] = {}


class Load(Table):
    """A traction or a pressure on boundary facets, or a force at a point. x, y, z are reference positions."""

    where: Annotated[Where | None, Field(description=_WHERE)] = None
    traction: Annotated[list[Number] | None, Field(description="N/m^2 of reference area; may depend on x, y, z, t")] = (
        None
    )
    pressure: Annotated[Number | None, Field(description="Pa; may depend on x, y, z, t")] = None
    follower: Annotated[Flag | None, Field(description="whether it turns with the facets")] = None
    at: Annotated[Vector | None, Field(description="m, where the point is at rest")] = None
    force: Annotated[list[Number] | None, Field(description="N; may depend on x, y, z, t")] = None
    moment: Annotated[Number | None, Field(description="N m, on a beam; may depend on x, y, t")] = None

    @property
    def kinds(self) -> list[str]:
        """Which loads are given; a valid table names one, a moment being a force or part of one."""
        kinds = [kind for kind in ("traction", "pressure", "force") if getattr(self, kind) is not None]
        return kinds if self.moment is None or "force" in kinds else [*kinds, "force"]

    @property
    def follows(self) -> bool:
        """Whether it turns with the facets; unless told otherwise a pressure does and a traction does not."""
        return self.pressure is not None if self.follower is None else self.follower


class SolidInitial(Table):
    """The solid at time zero."""

    velocity: Annotated[list[Number] | None, Field(description="m/s; may depend on x, y, z")] = None
    displacement: Annotated[list[Number] | None, Field(description="m; may depend on x, y, z")] = None


class Solid(Table):
    """A deformable body of linear triangles or tetrahedra."""

    shape: Shape
    density: Annotated[Real, Field(gt=0, description="kg/m^3")]
    young: Annotated[Real, Field(gt=0, description="Pa")]
    poisson: Annotated[Real, Field(gt=-1, lt=0.5)]
    material: Annotated[str, BeforeValidator(one_of(MATERIALS))] = "green"
    tangent: Annotated[
        Literal["exact", "projected"], Field(description="projected: without each element's negative eigenvalues")
    ] = "exact"
    elements: Annotated[Literal["linear", "quadratic"], Field(description="order of the shape functions")] = "linear"
    volumetric: Annotated[
        Literal["full", "reduced"], Field(description="integration of lambda's part; reduced does not lock")
    ] = "full"
    mass: Literal["consistent", "lumped"] = "consistent"
    interior: Literal["fluid", "void"] = "fluid"
    damping: Damping = Damping()
    supports: list[Support] = []
    body_force: Annotated[
        list[Number] | None, Field(description="N/m^3 of reference volume; may depend on x, y, z, t")
    ] = None
    loads: list[Load] = []
    initial: SolidInitial = SolidInitial()


class Obstacle(Table):
    """A static rigid shape; ``outside`` turns it into a container."""

    shape: Shape
    outside: Flag = False


# ---- the rest -----------------------------------------------------------------------------------------------


class Coupling(Table):
    """How fluid and solids are joined."""

    transfer: Annotated[str | None, BeforeValidator(one_of(COUPLINGS, optional=True))] = None
    #: Facets are split until their pieces are about a cell / quadrature.
    quadrature: Annotated[Whole, Field(ge=1, le=4)] = 2


class Probe(Table):
    """A quantity written to every row of history.csv."""

    of: Annotated[str, Field(description="a solid's name, fluid, or what a force is on")]
    at: Annotated[Vector | None, Field(description="m; in a solid, where the point is at rest")] = None
    quantity: Literal["displacement", "velocity", "angle", "pressure", "smoke", "front", "level", "force"]


class Output(Table):
    """When fields are written (none means never), and whether history.csv accounts for momentum, energy and volumes."""

    every: Annotated[Annotated[Real, Field(gt=0)] | None, Field(description="s")] = None
    accounts: bool = True


class Checkpoint(Table):
    """When checkpoints are written and how many stay."""

    every: Annotated[Annotated[Real, Field(gt=0)] | None, Field(description="s of scene time")] = None
    keep: Annotated[Whole, Field(ge=1)] = 3


class Scene(Table):
    """A whole scene."""

    title: str = ""
    dim: Literal[2, 3]
    gravity: Annotated[list[Number] | None, Field(description="m/s^2; may depend on t")] = None
    time: Time
    fluid: Fluid | None = None
    solids: dict[str, Solid] = {}
    obstacles: dict[str, Obstacle] = {}
    coupling: Coupling = Coupling()
    probes: dict[str, Probe] = {}
    output: Output = Output()
    checkpoint: Checkpoint = Checkpoint()

    _directory: Path = PrivateAttr(default=Path())

    def model_post_init(self, context: Any) -> None:
        """Remember where the scene was read."""
        if context:
            self._directory = Path(context["directory"])

    @property
    def transfer(self) -> str:
        """How fluid and solids are joined: as the scene says, else as suits the kind of fluid."""
        return self.coupling.transfer or (self.fluid.transfers[0] if self.fluid is not None else "cutcell")

    @property
    def unjudged(self) -> str:
        """Why nothing can be said of energy out of nothing; empty if something can."""
        if not self.output.accounts:
            return "output.accounts is false"
        return "the integrator is static" if self.time.integrator == "static" else ""

    @property
    def directory(self) -> Path:
        """What relative mesh paths are relative to; of a loaded scene they are absolute already."""
        return self._directory

    def __eq__(self, other: object) -> bool:
        """Compare what is said, not where it was read."""
        return isinstance(other, Scene) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]
