"""What every table of a scene is made of: numbers, names, shapes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, Strict, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError


def _number_or_text(value: Any) -> Any:
    """Refuse what is neither a finite number nor a text, in one message rather than one per type."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise PydanticCustomError("number_or_text", "must be a number or an expression in quotes")
    if isinstance(value, float) and not math.isfinite(value):
        raise PydanticCustomError("number_or_text", "must be a finite number")
    return value


def _name_of_number(value: Any) -> Any:
    """Return the name that a whole number stands for."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) and abs(value) < 10**18 else value


def one_of(names: Collection[str], optional: bool = False) -> Callable[[Any], str | None]:
    """Return a validator of names that are registered elsewhere, which speaks as those of literals do."""
    quoted = [f"'{name}'" for name in names]
    expected = " or ".join(filter(None, [", ".join(quoted[:-1]), quoted[-1]]))

    def known(value: Any) -> str | None:
        if optional and value is None:
            return None
        if not isinstance(value, str) or value not in names:
            raise PydanticCustomError("literal_error", "Input should be {expected}", {"expected": expected})
        return value

    return known


#: TOML has types, so a text is no number, and neither is true.
Real = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Vector = list[Real]
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

    origin: Annotated[Vector, Field(description="m")]
    size: Annotated[Vector, Field(description="m")]
    cells: Cells | None = None


class Ball(Table):
    """A disk (2D) or ball (3D); with ``cells``, how many it has across, it can be meshed."""

    centre: Annotated[Vector, Field(description="m")]
    radius: Annotated[Real, Field(gt=0, description="m")]
    cells: Annotated[Annotated[Whole, Field(ge=2, multiple_of=2)] | None, Field(description="cells across")] = None


class Cylinder(Table):
    """A finite round cylinder between two points (3D only)."""

    start: Annotated[Vector, Field(description="m")]
    end: Annotated[Vector, Field(description="m")]
    radius: Annotated[Real, Field(gt=0, description="m")]


class Halfspace(Table):
    """All points behind a plane: (x - point) . normal <= 0."""

    point: Annotated[Vector, Field(description="m")]
    normal: Vector


class Beam(Table):
    """A straight beam between two points (2D only), its faces half a thickness on either side."""

    start: Annotated[Vector, Field(description="m")]
    end: Annotated[Vector, Field(description="m")]
    thickness: Annotated[Real, Field(gt=0, description="m")]
    elements: Annotated[Whole, Field(ge=1, description="along the beam")]
    theory: Literal["timoshenko", "euler-bernoulli"] = "timoshenko"


class Shape(Table):
    """Exactly one of the shapes; ``mesh`` is a mesh file, relative to the scene."""

    box: Box | None = None
    ball: Ball | None = None
    cylinder: Cylinder | None = None
    halfspace: Halfspace | None = None
    beam: Beam | None = None
    mesh: Annotated[str | None, Field(description="a mesh file")] = None
    cells: Annotated[GroupName | None, Field(description="which group of a mesh file's cells")] = None
    scale: Annotated[Real, Field(gt=0, description="factor on a mesh file's coordinates")] = 1.0
    translate: Annotated[Vector | None, Field(description="m, applied to a mesh file after scaling")] = None
    cavity: Annotated[Box | None, Field(description="cells of a meshed box with their centre in it are left out")] = (
        None
    )

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
