"""What a scene probes: the columns of history.csv that are its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from petfsi.errors import InputError
from petfsi.fields.fluids import FluidField
from petfsi.fields.solids import SolidField
from petfsi.scene.schema import Scene

#: Probed quantities that are numbers; the others are vectors.
SCALARS = ("pressure", "smoke", "angle", "front", "level")


class Probes:
    """The probes of a scene, at its solids and its fluid."""

    def __init__(self, scene: Scene, solid: SolidField | None, fluid: FluidField | None) -> None:
        self._scene, self._solid, self._fluid = scene, solid, fluid

    def columns(self) -> list[str]:
        """Return the names of their columns."""
        return [name for name, _ in self._values(lambda *_: np.zeros(self._scene.dim))]

    def values(self) -> list[float]:
        """Return their present values, one per column. Collective."""
        return [value for _, value in self._values(self._measure)]

    def _measure(self, of: str, at: list[float] | None, quantity: str) -> np.ndarray | float:
        if of == "fluid" or quantity == "force":
            assert self._fluid is not None  # the scene was checked
            return self._fluid.force_on(of) if quantity == "force" else self._fluid.probe(quantity, at or [])
        assert self._solid is not None and at is not None
        return self._solid.probe(of, at, quantity)

    def _values(self, measure: Callable) -> Iterator[tuple[str, float]]:
        for name, spec in self._scene.probes.items():
            try:
                value = measure(spec.of, spec.at, spec.quantity)
            except InputError as error:
                raise InputError(f"probes.{name}: {error}") from None
            if spec.quantity in SCALARS:
                yield name, float(np.ravel(value)[0])
            else:
                yield from ((f"{name}.{axis}", float(v)) for axis, v in zip("xyz", value, strict=False))
