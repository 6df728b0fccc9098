"""The fluid of a scene: a table of the kind that its ``kind`` names, of all that the registry has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import Discriminator, Tag

from petfsi.registry import FLUIDS, find
from petfsi.scene.fluids import DEFAULT, FluidTable, MacFluid, SphFluid

TABLES: dict[str, type[FluidTable]] = {kind: find(places.table) for kind, places in FLUIDS.items()}


def _form(value: Any) -> str:
    """Tell kinds apart, so that errors speak of one of them only."""
    kind = value.get("kind", DEFAULT) if isinstance(value, dict) else getattr(value, "kind", DEFAULT)
    return TABLES[kind if isinstance(kind, str) and kind in TABLES else DEFAULT].form


if TYPE_CHECKING:
    Fluid = MacFluid | SphFluid
else:
    Fluid = Annotated[
        Union[tuple(Annotated[table, Tag(table.form)] for table in TABLES.values())],  # noqa: UP007 - made of a list
        Discriminator(_form),
    ]
