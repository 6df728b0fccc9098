"""Notes on solids: what holds them, whether their elements lock, and how their swings compare with the step."""

from __future__ import annotations

import math

from petfsi.notes.bending import bending_period, carried, excess, wave_time
from petfsi.notes.forms import Bend
from petfsi.notes.note import Note, Notes, View
from petfsi.scene.schema import Time
from petfsi.scene.solids import Solid

#: Elements that bend too stiffly by more than this part are warned of; the advice gets below the second part.
STIFF, FINE = 0.5, 0.15
#: Beyond this it is not said how much.
MOST_SAID = 30.0
#: Elements so many times as long as thick lock even if they are quadratic.
LONG = 3.0
#: A period wants so many steps; with fewer than the second it is blurred, as far as an estimate can tell, and with
#: fewer than the third it is not seen at all: the solid follows its loads.
RESOLVED, BLURRED, SEEN = 10.0, 7.0, 2.0


def loose(view: View) -> Notes:
    """Tell of solids that nothing holds: floats and things that fly are meant to be, others fall."""
    scene = view.scene
    falls = any(value != 0 for value in scene.gravity or [])
    for name, solid in scene.solids.items():
        if solid.supports or not scene.time.scheme.inertia:
            continue
        if scene.fluid is not None:
            ratio = solid.density / scene.fluid.density
            yield Note(f"solids.{name}: nothing holds it in the fluid, of which it has {ratio:.3g} times the density")
        elif falls or solid.loads or solid.body_force:
            what = "gravity" if falls else "its load"
            yield Note(f"solids.{name}: it has no supports and no fluid around it; {what} carries it away", warns=True)
        else:
            yield Note(f"solids.{name}: nothing holds it")


def locking(view: View) -> Notes:
    """Warn of linear elements that are too few across what bends, or too incompressible."""
    dim = view.scene.dim
    for name, form in view.forms.items():
        solid, span = view.scene.solids[name], view.spans[name]
        bend = form.wall if span is None else form.bend(span.axis)
        if bend is None or solid.shape.beam is not None or solid.elements != "linear":
            continue
        part = excess(solid, bend, dim, solid.volumetric)
        if part <= STIFF:
            continue
        times = f"about {1 + part:.2g}" if part < MOST_SAID else f"more than {MOST_SAID:g}"
        yield Note(
            f"solids.{name}: linear elements, {bend.across:.2g} across {'it' if form.filled else 'its wall'}, poisson "
            f"= {solid.poisson:g}: it bends {times} times too stiffly (locking); {_remedy(solid, bend, dim)}",
            warns=True,
        )


def _remedy(solid: Solid, bend: Bend, dim: int) -> str:
    """Return what makes a solid bend as it should."""
    if bend.ratio > LONG:
        beam = ", or give it as a beam" if dim == 2 else ""
        return f'set elements = "quadratic", with more of them along it{beam}'
    full, reduced = (
        math.ceil(bend.across * math.sqrt(excess(solid, bend, dim, kind) / FINE))
        for kind in (solid.volumetric, "reduced")
    )
    more = f'volumetric = "reduced" and {reduced}' if reduced < full else f"{full}"
    return f'set elements = "quadratic", or take {more} across it'


def swings(view: View) -> Notes:
    """Hold periods of bending, and waves through elements, against the step."""
    scene, dt = view.scene, view.dt
    if not scene.time.scheme.inertia:
        return
    for name, form in view.forms.items():
        solid = scene.solids[name]
        wave, span = wave_time(solid, form), view.spans[name]
        waves = f"pressure waves cross an element in {wave:.2g} s"
        if dt is not None:
            waves += f" = {_steps(wave / dt)}" + (f", {_beyond(scene.time)}" if wave < dt else "")
        if span is None:
            yield Note(f"solids.{name}: {waves}")
            continue
        period = bending_period(solid, form, span)
        wet = period
        if scene.fluid is not None:
            wet *= math.sqrt(1 + carried(form, solid.density, scene.fluid.density))
        said = f"solids.{name}: its slowest bending takes about {period:.2g} s"
        said += f" = {_steps(period / dt)}" if dt is not None else ""
        if wet > 1.2 * period:
            said += f" ({wet:.2g} s with the fluid it moves)"
        yield Note(f"{said}; {waves}")
        if dt is not None and SEEN <= wet / dt < BLURRED:
            yield Note(
                f"solids.{name}: its slowest bending takes about {_steps(wet / dt)}, too few to be followed; time.dt = "
                f"{0.95 * wet / RESOLVED:.2g} resolves it",
                warns=True,
            )


def _steps(number: float) -> str:
    """Return a number of steps, or which part of one, to two digits."""
    size = max(number, 1 / number)
    digits = 1 - math.floor(math.log10(size))
    text = f"{round(size, digits):,.{max(digits, 0)}f}" if size < 1e15 else f"{size:.1e}"
    if text == "1.0":
        return "1 step"
    return f"{text} steps" if number >= 1 else f"1/{text} step"


def _beyond(time: Time) -> str:
    """Return what becomes of waves that are too fast for the steps."""
    if time.scheme.explicit:
        return "which limits the step"
    return f"damped by {time.integrator}" if time.scheme.damps else f"which {time.integrator} does not damp"
