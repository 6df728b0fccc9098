"""How far histories are from a reference: one definition for sweeps, benches and tests.

A history is never interpolated: the reference is, by a cubic spline through its own steps, to the history's times, and
only where both are known. Read linearly, a reference of three quarters of the step would add half a percent.

References
----------
P. J. Roache, Perspective: a method for uniform reporting of grid refinement studies (1994), for the bar of an
extrapolation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from petfsi.errors import InputError

NORMS = ("l2", "max", "final")
#: Roache's factor of safety; where the order seen is not the scheme's, so many times that.
SAFETY, UNSURE = 1.25, 3.0
#: How far the order seen may be from the scheme's, and the least that is believed.
NEAR, LEAST_ORDER = 0.5, 0.5
#: Part of what is compared that differences show by round-off alone.
ROUND_OFF = 1e-13
#: Steps of a reference below which it has no cubic between them.
_FEWEST = 4
#: Part of a window beyond a reference's end that round-off explains.
_SLACK = 1e-9


@dataclass(frozen=True)
class Series:
    """Values over time.

    Attributes
    ----------
    times : ndarray, shape (n,)
        s, ascending.
    values : ndarray, shape (n, m)
        Of m quantities that are judged together, as a vector's components.
    """

    times: np.ndarray
    values: np.ndarray

    def within(self, window: tuple[float, float] | None) -> Series:
        """Return the part of it in a window of time; round-off is let in."""
        if window is None:
            return self
        slack = _SLACK * max(abs(window[0]), abs(window[1]))
        use = (self.times >= window[0] - slack) & (self.times <= window[1] + slack)
        return Series(self.times[use], self.values[use])

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the values at some times, shape (n, m).

        Raises
        ------
        InputError
            If those are not all between its first and its last, or are between fewer than four steps.
        """
        first, last = float(self.times[0]), float(self.times[-1])
        slack = _SLACK * max(abs(first), abs(last))
        if times[0] < first - slack or times[-1] > last + slack:
            raise InputError(
                f"the reference is known from {first:g} to {last:g} s, the run is asked for from {times[0]:g} to "
                f"{times[-1]:g} s; give a window within both"
            )
        near = np.clip(np.searchsorted(self.times, times - slack), 0, len(self.times) - 1)
        if np.all(np.abs(self.times[near] - times) <= slack):  # its own steps
            return self.values[near]
        if len(self.times) < _FEWEST:
            raise InputError(f"the reference has {len(self.times)} times; a cubic between them wants {_FEWEST}")
        return CubicSpline(self.times, self.values)(np.clip(times, first, last))


def size(times: np.ndarray, values: np.ndarray, norm: str) -> float:
    """Return a norm over time of values, shape (n, m): root of the mean square, largest, or the last one's."""
    magnitude = np.linalg.norm(values, axis=1)
    if norm == "max":
        return float(magnitude.max())
    if norm == "final" or len(times) == 1:
        return float(magnitude[-1])
    weights = np.zeros(len(times))
    weights[:-1] += 0.5 * np.diff(times)
    weights[1:] += 0.5 * np.diff(times)
    return float(np.sqrt(weights @ magnitude**2 / weights.sum()))


def _part(run: Series, window: tuple[float, float] | None) -> Series:
    part = run.within(window)
    if not len(part.times):
        raise InputError("the run has no step in the window")
    return part


def error_of(run: Series, reference: Series, norm: str, window: tuple[float, float] | None = None) -> float:
    """Return how far a run is from a reference, relative to that; absolute where the reference is zero throughout.

    Parameters
    ----------
    run, reference : Series
    norm : str
        One of ``NORMS``.
    window : tuple of float, optional
        From when to when, s.

    Raises
    ------
    InputError
        If the run has no step there, or the reference is not known where the run is asked for.
    """
    part = _part(run, window)
    if norm == "final":
        part = Series(part.times[-1:], part.values[-1:])
    wanted = reference.at(part.times)
    scale = size(part.times, wanted, norm)
    return size(part.times, part.values - wanted, norm) / (scale or 1.0)


@dataclass(frozen=True)
class Extrapolated:
    """What runs of finer and finer steps tend to.

    Attributes
    ----------
    limit : Series
    bar : float
        How far it may be from what it stands for, in the norm that was asked for, relative.
    order : float or None
        Seen; None where there were two runs.
    why : str
        Why the bar is wider than the order's own; empty if it is not.
    """

    limit: Series
    bar: float
    order: float | None
    why: str = ""


def extrapolate(
    runs: Sequence[Series], factor: float, order: float, norm: str, window: tuple[float, float] | None = None
) -> Extrapolated:
    """Return the limit of two or three runs, the coarsest first, each finer by a factor than the one before.

    With differences d1 = u2 - u1 and d2 = u3 - u2 of neighbours and p = log(|d1|/|d2|) / log f, held within .5 and
    the scheme's order: u* = u3 + d2 / (f^p - 1), and the bar is 1.25 |d2| / (f^p - 1) (Roache), three times that where
    p is not the order's, differences grow, or there are two runs only.

    Parameters
    ----------
    runs : sequence of Series
    factor : float
        By which steps or cells are finer, above 1.
    order : float
        The scheme's.
    norm, window
        As for ``error_of``.

    Raises
    ------
    InputError
        As ``error_of`` does.
    """
    finest = _part(runs[-1], window)
    at = [run.at(finest.times) for run in runs[:-1]] + [finest.values]
    differences = [b - a for a, b in zip(at, at[1:], strict=False)]
    sizes = [size(finest.times, one, norm) for one in differences]
    seen, why = None, "two runs show no order"
    if len(runs) > 2:
        why = ""
        nothing = ROUND_OFF * size(finest.times, finest.values, norm)
        if max(sizes) <= nothing:
            seen, sizes = order, [0.0, 0.0]
        else:
            seen = float(np.log(max(sizes[-2], nothing) / max(sizes[-1], nothing)) / np.log(factor))
        if sizes[-1] > sizes[-2]:
            why = "differences grow"
        elif abs(seen - order) > NEAR:
            why = f"order {seen:.2f} seen, {order:g} expected"
    held = min(max(order if seen is None else seen, LEAST_ORDER), order)
    rest = differences[-1] / (factor**held - 1.0)
    limit = Series(finest.times, finest.values + rest)
    scale = size(limit.times, limit.values, norm) or 1.0
    bar = SAFETY * size(limit.times, rest, norm) / scale
    return Extrapolated(limit, bar * (UNSURE if why else 1.0), seen, why)
