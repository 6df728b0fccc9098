"""What probes may ask of whom; each check yields the mistakes it finds."""

from __future__ import annotations

from petfsi.scene.mistakes import ABSENT, Problem
from petfsi.scene.schema import Probe, Scene
from petfsi.scene.shape_checks import NO_Z, OPPOSITE, Problems, length, outside_grid

SOLID_QUANTITIES = ("displacement", "velocity")
#: What a fluid of each kind has.
FLUID_QUANTITIES = {
    "mac": ("velocity", "pressure", "smoke"),
    "sph": ("velocity", "pressure", "front", "level"),
}


def probes(scene: Scene) -> Problems:
    """Judge what is probed, of whom and where."""
    for name, probe in scene.probes.items():
        key = f"probes.{name}"
        yield from length(f"{key}.at", probe.at, scene.dim)
        if probe.quantity not in ("front", "force") and probe.at is None:
            yield Problem(f"{key}.at", ABSENT, "is missing: a point (m)", (f"{key}.quantity",))
        if probe.quantity == "force":
            yield from _force_probe(scene, key, probe)
        elif probe.of == "fluid":
            yield from _fluid_probe(scene, key, probe)
        elif probe.of not in scene.solids:
            known = ", ".join([*(["fluid"] if scene.fluid else []), *scene.solids]) or "fluid, or a solid's name"
            yield Problem(f"{key}.of", probe.of, f"must be one of {known}", (f"solids.{probe.of}",))
        elif probe.quantity == "angle" and scene.solids[probe.of].shape.beam is None:
            yield Problem(f"{key}.quantity", probe.quantity, "only a beam has an angle", (f"{key}.of",))
        elif probe.quantity not in (*SOLID_QUANTITIES, "angle"):
            allowed = f"a solid has {' and '.join(SOLID_QUANTITIES)}, a beam an angle, too"
            yield Problem(f"{key}.quantity", probe.quantity, allowed, (f"{key}.of",))


def _force_probe(scene: Scene, key: str, probe: Probe) -> Problems:
    """Judge a force: that of particles on a side or an obstacle."""
    if scene.fluid is None or scene.fluid.kind != "sph":
        yield Problem(f"{key}.quantity", "force", "is known of particles only (fluid.kind = sph)", ("fluid.kind",))
        return
    sides = [side for pair in OPPOSITE[: scene.dim] for side in pair]
    if probe.of in OPPOSITE[2] and scene.dim == 2:
        yield Problem(f"{key}.of", probe.of, NO_Z, ("dim",))
    elif probe.of not in (*sides, *scene.obstacles):
        known = ", ".join([*sides, *scene.obstacles])
        yield Problem(
            f"{key}.of", probe.of, f"a force is on a side or an obstacle: {known}", (f"obstacles.{probe.of}",)
        )


def _fluid_probe(scene: Scene, key: str, probe: Probe) -> Problems:
    fluid = scene.fluid
    if fluid is None:
        yield Problem(f"{key}.of", "fluid", f"the scene has no [fluid], only {', '.join(scene.solids)}", ("fluid",))
        return
    has = FLUID_QUANTITIES[fluid.kind]
    if probe.quantity not in has:
        allowed = f"a fluid has {', '.join(has[:-1])} and {has[-1]}"
        yield Problem(f"{key}.quantity", probe.quantity, allowed, (f"{key}.of", "fluid.kind"))
    elif probe.quantity == "smoke" and fluid.smoke is None:
        yield Problem(f"{key}.quantity", "smoke", "the fluid has no [fluid.smoke]", (f"{key}.of", "fluid.smoke"))
    if probe.at is not None and len(probe.at) == scene.dim:
        for problem in outside_grid(fluid, f"{key}.at", probe.at, probe.at):
            yield Problem(problem.key, probe.at, problem.allowed, (*problem.uses, f"{key}.of"))
            break
