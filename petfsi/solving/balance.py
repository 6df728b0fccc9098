"""What is let into regions of fluid that nothing leaves and around which nothing yields: it must come to nothing."""

from __future__ import annotations

import numpy as np

from petfsi.solving.regions import ClosedRegions

#: What is left over may be this part of all that flows: solvers leave as much.
LEFT_OVER = 1e-8
#: Sums of flows that cancel leave less than this part of them.
ROUND_OFF = 1e-13
#: Bodies that what comes in has squeezed to less than this part of their volume, or swollen as much, are worth a word.
SQUEEZED = 0.9


class Balance:
    """Judges the right-hand side of each step by the pressures that no solid feels, even in each closed region.

    Summed up with such a pressure q the rows of the fluid's equations read  0 = q . b . What sides and prescribed
    points let in must balance, or there is no solution. Where the volumes balance that they let in and sweep, only
    velocities at one instant do not, as those of a held body that turns: then a source, even over the region, makes up
    for it.

    Parameters
    ----------
    regions : ClosedRegions
    """

    def __init__(self, regions: ClosedRegions) -> None:
        self.regions, self.fluid, self.solid = regions, regions.fluid, regions.solid

    def fault(self, dt: float) -> str | None:
        """Return which given flows of the step assembled have nowhere to go; None if there are none. Collective."""
        regions = self.regions
        given = self._given() if regions.unfelt else None
        if given is None:
            return None
        swept = regions.swept(dt) / dt
        rates = [(q @ given, way @ swept, q @ q) for q, way in zip(regions.unfelt, regions.ways, strict=True)]
        flows = [given @ given, self.fluid.rhs @ self.fluid.rhs, 0.0]
        *rows, (all_given, whole, _) = regions.system.comm.allreduce(np.array([*rates, flows]))
        size = np.sqrt(max(all_given, whole))
        for q, (net, volume, square) in zip(regions.unfelt, rows, strict=True):
            # this much of the residual no pressure changes; what is no number is told of by others
            if min(abs(net), abs(volume)) > LEFT_OVER * size * np.sqrt(square):
                return self._story(q)
        return None

    def make_up(self) -> bool:
        """Let a source take what velocities leave over; return whether any does. Collective."""
        regions = self.regions
        if not regions.unfelt or self._given() is None:
            return False
        b = self.fluid.rhs
        rows = [(q @ b, q @ q) for q in regions.unfelt]
        *nets, (whole, _) = regions.system.comm.allreduce(np.array([*rows, (b @ b, 0.0)]))
        source = np.zeros_like(b)
        for q, (net, square) in zip(regions.unfelt, nets, strict=True):
            if abs(net) > ROUND_OFF * np.sqrt(whole * square):
                source -= net / square * q
        if not regions.system.comm.allreduce(bool(source.any()), op=max):
            return False
        regions.inject(source)
        return True

    def _given(self) -> np.ndarray | None:
        """Return by unknown what sides and prescribed points let in, m^3/s (m^2/s in 2D); None if there are none."""
        out = [coupling.held_outflow() for coupling in self.regions.system.couplings]
        parts = [-part for part in out if part is not None]
        rate = self.fluid.inflow()
        parts += [] if rate is None else [rate]
        return sum(parts[1:], parts[0]) if parts else None

    def squeezed(self) -> str:
        """Return what flows into a closed region to which solids alone yield, if it has squeezed them. Collective.

        Such a step has a solution as long as the material bears it: nobody knows beforehand.
        """
        parts = self.solid.volume_ratios() if self.solid is not None else {}
        for q, elastic in zip(self.regions.members, self.regions.elastic, strict=True):
            if not parts or not elastic:
                continue
            named, flows = self._flows(q)
            net = float(flows.sum())
            if abs(net) <= LEFT_OVER * np.abs(flows).sum():
                continue
            name = min(parts, key=parts.__getitem__) if net > 0 else max(parts, key=parts.__getitem__)
            if (net > 0 and parts[name] < SQUEEZED) or (net < 0 and parts[name] > 1 / SQUEEZED):
                return (
                    f"{named}: the fluid in {self.fluid.place(q)} is closed, and solids alone "
                    f"{'give way to what comes in' if net > 0 else 'make up for what is drawn out'}: solids.{name} has "
                    f"{parts[name]:.3g} times the volume that it has at rest. Let as much out as in, or open a side"
                )
        return ""

    def _story(self, q: np.ndarray) -> str:
        """Return what flows into the regions of an unfelt pressure. Collective."""
        named, flows = self._flows(q)
        net = float(flows.sum())
        return (
            f"{named}: what is let in and out does not balance: the fluid in {self.fluid.place(q)} "
            f"is closed, and nothing around it yields, but it would have to {'take up' if net > 0 else 'give off'} "
            f"{abs(net):.4g} {self._unit}. Let as much out as in, open a side, or let a wall give way"
        )

    @property
    def _unit(self) -> str:
        return "m^3/s" if self.fluid.dim == 3 else "m^2/s"

    def _flows(self, q: np.ndarray) -> tuple[str, np.ndarray]:
        """Return what is let in with a pressure's weights, by what lets it in, in words and as such. Collective."""
        system, solid = self.regions.system, self.solid
        ends = system.comm.allgather((q.min(initial=0.0), q.max(initial=0.0)))
        q = q / max((value for pair in ends for value in pair), key=abs)
        parts = {key: q @ rate for key, rate in self.fluid.inflows().items()}
        for n, name in enumerate(solid.names if solid is not None else []):
            assert solid is not None
            outflow = system.couplings[0].held_outflow(solid.surface_bodies() == n)
            if outflow is not None:
                parts[f"solids.{name}.supports"] = -(q @ outflow)
        values = system.comm.allreduce(np.array(list(parts.values())))
        named = [
            f"{key} {value:+.4g}"
            for key, value in zip(parts, values, strict=True)
            if abs(value) > LEFT_OVER * np.abs(values).max()
        ]
        return f"{', '.join(named)} {self._unit}", values
