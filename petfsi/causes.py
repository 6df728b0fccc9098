"""What a step failed of, beyond what its solver can tell."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from petfsi.errors import FinalError, NoSolutionError, SolveError, TouchError
from petfsi.fields.solids import SolidField
from petfsi.scene.schema import Time
from petfsi.solving.equations import Equations
from petfsi.solving.splitting import SplitWatch
from petfsi.touch import WHY, Watch


@contextmanager
def touch_named(solid: SolidField | None, watch: Watch | None, t: float, dt: float, last: bool) -> Iterator[None]:
    """Say that bodies meet if the step whose equations fail inside would bring them there. Collective.

    The fluid's interface goes ahead of the step's solution. Where that leads a body into something the equations are
    those of no fluid: what supports sweep does not balance, or nothing converges.

    Parameters
    ----------
    solid : SolidField or None
    watch : Watch or None
    t, dt : float
        When the step began, and its length, s.
    last : bool
        Whether no shorter steps will be tried.

    Raises
    ------
    TouchError
        If they meet on the way that supports and the last velocities foresee.
    SolveError
        If what does not balance is due to where the step's equations are taken, which that way does not reach.
    """
    try:
        yield
    except SolveError as error:
        if solid is None or watch is None or not (last or isinstance(error, FinalError)):
            raise
        unbalanced = isinstance(error, NoSolutionError)
        said = watch.foresee(solid.surface_arrival(solid.foreseen(), dt), t, dt)
        if said:
            # what does not balance is a consequence, and what it advises no help
            words = "" if unbalanced else f". The step failed of it: {error}"
            raise TouchError(f"{said}. {WHY}{words}") from error
        said = watch.foresee(solid.surface_positions(), t, dt) if unbalanced else ""
        if said:
            where = f"ahead of the step, where its equations are taken, {said}"
            raise SolveError(f"{where}: shorter steps go on from nearer by") from error
        raise


@contextmanager
def elements_named(solid: SolidField | None) -> Iterator[None]:
    """Name the body that has an element inside out where equations were taken of which a solve fails. Collective."""
    try:
        yield
    except SolveError as error:
        said = solid.inside_out() if solid is not None else ""
        if not said:
            raise
        raise SolveError(f"{said}: {error}") from error


@contextmanager
def squeezing_named(equations: Equations, last: bool) -> Iterator[None]:
    """Say that what comes into a closed region squeezes its solids where the last try of a step fails. Collective."""
    try:
        yield
    except SolveError as error:
        said = equations.squeezed() if last and not isinstance(error, FinalError) else ""
        if not said:
            raise
        raise type(error)(f"{said}. The step failed of it: {_without_advice(error)}") from error


@contextmanager
def splitting_named(watch: SplitWatch | None) -> Iterator[None]:
    """Say that time splitting is unstable if that shows when a step fails inside of it, in whatever way. Collective.

    What the failure itself advises is no help then.
    """
    try:
        yield
    except SolveError as error:
        said = watch.story() if watch is not None else ""
        if not said:
            raise
        raise FinalError(f"{said}. The step failed of it: {_without_advice(error)}") from error


def _without_advice(error: SolveError) -> str:
    """Return what has failed, in a word: the first sentence."""
    return str(error).split(". ")[0].rstrip(".")


def advice(time: Time, solid: SolidField | None, exact: bool, splitting: SplitWatch | None) -> str:
    """Return what may help a run that blows up.

    Parameters
    ----------
    time : Time
        Of the scene.
    solid : SolidField or None
    exact : bool
        Whether linearising once a step is not at fault: it is not done, or steps are explicit.
    splitting : SplitWatch or None
    """
    if splitting is not None:
        story = splitting.story()
        other = "Try monolithic.opts, which tells splitting from the physics, a smaller dt, or more damping."
        return f"{story[0].upper()}{story[1:]}." if story else other
    if not time.scheme.inertia:
        return "Try smaller steps of the load, by a smaller dt."
    helps = ["a smaller dt"]
    if solid is not None:
        helps += [] if solid.is_linear or exact else ["-fsi_snes_type newtonls"]
        helps += ["more damping"]
        helps += [] if time.scheme.damps else ['time.integrator = "bdf2"']
    return f"Try {' or '.join(filter(None, [', '.join(helps[:-1]), helps[-1]]))}."
