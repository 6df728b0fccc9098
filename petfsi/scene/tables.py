"""What every table of a scene is made of: numbers, names, shapes."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError
from typing_extensions import Doc


def _number_or_text(value: Any) -> Any:
    """Refuse what is neither a finite number nor a text, in one message rather than one per type."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise PydanticCustomError("number_or_text", "must be a number or an expression in quotes")
    if isinstance(value, float) and not math.isfinite(value):
        raise PydanticCustomError("number_or_text", "must be a finite number")
    return value


def either(names: Iterable[object]) -> str:
    """Return names, or numbers, as messages list what may be said: ``'a', 'b' or 'c'``."""
    quoted = [repr(name) for name in names]
    return " or ".join(filter(None, [", ".join(quoted[:-1]), quoted[-1]]))


def _name_of_number(value: Any) -> Any:
    """Return the name that a whole number stands for."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) and abs(value) < 10**18 else value


@dataclass(frozen=True)
class OneOf:
    """A validator of names that are registered elsewhere, which speaks as those of literals do."""

    names: Collection[str]
    optional: bool = False

    def __call__(self, value: Any) -> str | None:
        """Return a name that is known."""
        if self.optional and value is None:
            return None
        if not isinstance(value, str) or value not in self.names:
            raise PydanticCustomError("literal_error", "Input should be {expected}", {"expected": either(self.names)})
        return value


#: TOML has types, so a text is no number, and neither is true.
Real = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Vector = list[Real]
#: A point, or lengths along the axes.
Metres = Annotated[Vector, Field(description="m")]
Length = Annotated[Real, Field(gt=0, description="m")]
Density = Annotated[Real, Field(gt=0, description="kg/m^3")]
Cells = list[Annotated[Whole, Field(ge=1)]]
#: The name of a group in a mesh file, or its number.
GroupName = Annotated[str, Field(min_length=1), BeforeValidator(_name_of_number)]
#: A number, or an expression of x, y, z, t and pi (see ``expressions.py``).
Number = Annotated[float | str, BeforeValidator(_number_or_text)]


class Table(BaseModel):
    """A table of the scene."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# ---- shapes -------------------------------------------------------------------------------------------------


class Box(Table):
    """An axis-parallel box; with ``cells`` it can be meshed."""

    origin: Annotated[Metres, Doc("The corner with the smallest coordinates.")]
    size: Annotated[Metres, Doc("The lengths of the edges, each greater than 0.")]
    cells: Annotated[
        Cells | None,
        Doc(
            "How many cells a solid's box has along each axis. Each is cut into 2 triangles, in 3D into 6 tetrahedra. "
            "A solid needs them; left out of every other box."
        ),
    ] = None


class Ball(Table):
    """A disk (2D) or ball (3D); with ``cells``, how many it has across, it can be meshed."""

    centre: Annotated[Metres, Doc("The middle.")]
    radius: Annotated[Length, Doc("The distance from the middle to the surface.")]
    cells: Annotated[
        Annotated[Whole, Field(ge=2, multiple_of=2)] | None,
        Field(description="cells across"),
        Doc("How many cells a solid's ball has across. A solid needs it; left out of every other ball."),
    ] = None


class Cylinder(Table):
    """A finite round cylinder between two points (3D only)."""

    start: Annotated[Metres, Doc("The middle of one end.")]
    end: Annotated[Metres, Doc("The middle of the other end.")]
    radius: Annotated[Length, Doc("The distance from the axis to the round surface.")]


class Halfspace(Table):
    """All points behind a plane: (x - point) . normal <= 0."""

    point: Annotated[Metres, Doc("A point of the plane.")]
    normal: Annotated[Vector, Doc("The direction across the plane out of the half space, of any length.")]


class Beam(Table):
    """A straight beam between two points (2D only), its faces half a thickness on either side."""

    start: Annotated[Metres, Doc('Where the axis begins: "start" of supports.')]
    end: Annotated[Metres, Doc('Where the axis ends: "end" of supports.')]
    thickness: Annotated[
        Length,
        Doc(
            "The distance h between the two faces, less than the length. Per metre of width EA = E h and EI = E h^3/12 "
            "with the solid's young E, as of a plate that may contract across its width: plane stress. For plane "
            "strain give young = E/(1 - nu^2)."
        ),
    ]
    elements: Annotated[
        Whole, Field(ge=1, description="along the beam"), Doc("How many elements of equal length the axis has.")
    ]
    theory: Annotated[
        Literal["timoshenko", "euler-bernoulli"],
        Doc(
            "How the beam deforms. timoshenko: geometrically exact, with shear GA = 5/6 E h/(2 + 2 nu); "
            "euler-bernoulli: moderate rotations, without shear. Both bend with EI of the young that is given, not "
            "E/(1 - nu^2)."
        ),
    ] = "timoshenko"


class Shape(Table):
    """Exactly one of box, ball, cylinder, halfspace, beam and mesh; solids are a box, a ball, a beam or a mesh."""

    box: Annotated[Box | None, Doc("One of the shapes: an axis-parallel box.")] = None
    ball: Annotated[Ball | None, Doc("One of the shapes: a ball, in 2D a disk.")] = None
    cylinder: Annotated[Cylinder | None, Doc("One of the shapes: a finite round cylinder, 3D.")] = None
    halfspace: Annotated[Halfspace | None, Doc("One of the shapes: all that is behind a plane.")] = None
    beam: Annotated[Beam | None, Doc("One of the shapes: a beam, of solids in 2D.")] = None
    mesh: Annotated[
        str | None,
        Field(description="a mesh file"),
        Doc("One of the shapes: a mesh file. Its path is relative to the scene's folder; README says what is read."),
    ] = None
    cells: Annotated[
        GroupName | None,
        Field(description="which group of a mesh file's cells"),
        Doc("The name, or number, of the mesh file's group of cells that is the body. Left out, all cells are."),
    ] = None
    scale: Annotated[
        Real,
        Field(gt=0, description="factor on a mesh file's coordinates"),
        Doc("What a mesh file's coordinates are multiplied by, to be metres."),
    ] = 1.0
    translate: Annotated[
        Vector | None,
        Field(description="m, applied to a mesh file after scaling"),
        Doc("How far a mesh file is moved. Left out, it stays where it is."),
    ] = None
    cavity: Annotated[
        Box | None,
        Field(description="cells of a meshed box with their centre in it are left out"),
        Doc("A hole in a solid's box, without cells of its own. Left out, the box is full."),
    ] = None

    @field_validator("mesh")
    @classmethod
    def _absolute(cls, mesh: str | None, info: ValidationInfo) -> str | None:
        """Resolve a mesh path against the scene's directory, so that the run directory's copy still finds it."""
        if mesh and "\0" in mesh:
            raise PydanticCustomError("mesh", "must be the name of a file, without null characters")
        if mesh and info.context:
            try:
                return os.path.abspath(Path(info.context["directory"], Path(mesh).expanduser()))
            except RuntimeError as error:  # ~somebody
                raise PydanticCustomError("mesh", "must be the name of a file: there is no such user") from error
        return mesh

    @property
    def kinds(self) -> list[str]:
        """Which shapes are given; a valid shape names one."""
        kinds = ("box", "ball", "cylinder", "halfspace", "beam", "mesh")
        return [kind for kind in kinds if getattr(self, kind) is not None]
