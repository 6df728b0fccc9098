"""What a scene may say of its solids: what they are, how they are held and what acts on them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag
from typing_extensions import Doc

from petfsi.registry import MATERIALS
from petfsi.scene.tables import Density, Flag, GroupName, Number, OneOf, Real, Shape, Table, Vector

Component = Literal["x", "y", "z", "angle"]
Place = Literal["left", "right", "bottom", "top", "back", "front", "all", "start", "end"]


class Damping(Table):
    """Rayleigh damping C = mass M + stiffness K', of the mass matrix and the tangent."""

    mass: Annotated[Real, Field(ge=0, description="1/s"), Doc("The factor of M: all that moves is slowed down.")] = 0.0
    stiffness: Annotated[
        Real, Field(ge=0, description="s"), Doc("The factor of K': what deforms is slowed down, fast swings most.")
    ] = 0.0


class Tagged(Table):
    """A group of boundary facets or of nodes that a mesh file has a name (or a number) for."""

    tag: Annotated[
        GroupName,
        Field(description="the name of a group of facets or nodes in the mesh file"),
        Doc("The name, or number, of the group. Of facets, else of nodes, else of cells, whose corners it means."),
    ]


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

    where: Annotated[
        Where,
        Field(description=_WHERE),
        Doc(
            "Which nodes are held. A side is that of the box around the body at rest, start and end are those of a "
            "beam; or a table: a shape, or a mesh file's tag."
        ),
    ]
    fix: Annotated[
        list[Component],
        Field(min_length=1, description="axes that are held; of a beam its angle, too"),
        Doc("The axes along which they are held; angle is that of a beam's section."),
    ]
    velocity: Annotated[
        dict[Component, Number],
        Field(description="m/s of fixed axes, rad/s; may depend on x, y, z, t"),
        Doc("How fast they are moved along fixed axes, by name. Along others of these they rest."),
    ] = {}
    displacement: Annotated[
        dict[Component, Number],
        Field(description="m of fixed axes, rad; may depend on x, y, z, t"),
        Doc("How far they are moved along fixed axes, by name, from rest. An axis has this or a velocity."),
    ] = {}


class Load(Table):
    """A traction or a pressure on boundary facets, or a force at a point. x, y, z are reference positions."""

    where: Annotated[
        Where | None,
        Field(description=_WHERE),
        Doc("Which facets of the surface, or elements of a beam, are loaded. As of supports; left out of a force."),
    ] = None
    traction: Annotated[
        list[Number] | None,
        Field(description="N/m^2 of reference area; may depend on x, y, z, t"),
        Doc(
            "One of the loads: a force per area at rest, per axis. On a beam it is one per length of the axis and "
            "metre of width."
        ),
    ] = None
    pressure: Annotated[
        Number | None,
        Field(description="Pa; may depend on x, y, z, t"),
        Doc(
            "One of the loads: a pressure, which presses on the body where it is positive. It acts against the outward "
            "normal, -p n, on the present area, or on that at rest if follower = false; a negative one pulls. On a "
            "beam it acts on the face on the left of the axis, seen from start to end."
        ),
    ] = None
    follower: Annotated[
        Flag | None,
        Field(description="whether it turns with the facets"),
        Doc("Whether the load turns with what it acts on. Left out, a pressure does, others do not."),
    ] = None
    at: Annotated[
        Vector | None,
        Field(description="m, where the point is at rest"),
        Doc("Where a force or a moment acts. Left out of tractions and pressures."),
    ] = None
    force: Annotated[
        list[Number] | None,
        Field(description="N; may depend on x, y, z, t"),
        Doc("One of the loads: a force at a point, per axis; in 2D per metre of thickness."),
    ] = None
    moment: Annotated[
        Number | None,
        Field(description="N m, on a beam; may depend on x, y, t"),
        Doc("A moment at a point of a beam, with a force or alone. Positive ones turn x to y. Left out, none is."),
    ] = None

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

    velocity: Annotated[
        list[Number] | None,
        Field(description="m/s; may depend on x, y, z"),
        Doc("The velocity at the start, per axis; of a beam its angle's, too (rad/s). Left out, it is at rest."),
    ] = None
    displacement: Annotated[
        list[Number] | None,
        Field(description="m; may depend on x, y, z"),
        Doc("The displacement at the start, per axis; of a beam its angle, too (rad). Left out, there is none."),
    ] = None


class Solid(Table):
    """A deformable body of triangles or tetrahedra, or a beam."""

    shape: Annotated[Shape, Doc("What the body is at rest: a box or a ball with cells, a beam, or a mesh file.")]
    density: Annotated[Density, Doc("Mass per volume at rest.")]
    young: Annotated[
        Real,
        Field(gt=0, description="Pa"),
        Doc(
            "Young's modulus E. Bodies of triangles are in plane strain; a beam bends with EI = E h^3/12, h its "
            "thickness, as in plane stress, so that for one in plane strain young is E/(1 - nu^2)."
        ),
    ]
    poisson: Annotated[
        Real, Field(gt=-1, lt=0.5), Doc("Poisson's ratio nu. Of a beam it enters the shear stiffness alone.")
    ]
    material: Annotated[
        str,
        BeforeValidator(OneOf(MATERIALS)),
        Doc(
            "The law of the material; a beam has none. green: St Venant-Kirchhoff, softens in compression; neohookean: "
            "cannot be inverted; stable-neohookean: survives inversion; linear: small strain."
        ),
    ] = "green"
    tangent: Annotated[
        Literal["exact", "projected"],
        Field(description="projected: without each element's negative eigenvalues"),
        Doc("The stiffness that a step is linearised with; projected is for violent motion."),
    ] = "exact"
    elements: Annotated[
        Literal["linear", "quadratic"],
        Field(description="order of the shape functions"),
        Doc("The order of the elements. Quadratic ones have straight sides, with nodes in the middles."),
    ] = "linear"
    volumetric: Annotated[
        Literal["full", "reduced"],
        Field(description="integration of lambda's part; reduced does not lock"),
        Doc("How changes of volume are integrated; reduced does not lock near poisson = 0.5."),
    ] = "full"
    mass: Annotated[
        Literal["consistent", "lumped"],
        Doc("The mass matrix: that of the elements, or with all mass in the nodes. symplectic-euler always lumps."),
    ] = "consistent"
    interior: Annotated[
        Literal["fluid", "void"], Doc("What closed cavities of the body hold; a void has p = 0 and is not solved.")
    ] = "fluid"
    damping: Annotated[Damping, Doc("Rayleigh damping.")] = Damping()
    supports: Annotated[list[Support], Doc("Which nodes are held, or moved as prescribed; any number.")] = []
    body_force: Annotated[
        list[Number] | None,
        Field(description="N/m^3 of reference volume; may depend on x, y, z, t"),
        Doc("A force per volume at rest, per axis, beside gravity. Left out, there is none."),
    ] = None
    loads: Annotated[list[Load], Doc("What acts on the surface or at points; any number.")] = []
    initial: Annotated[SolidInitial, Doc("The body at time zero.")] = SolidInitial()
