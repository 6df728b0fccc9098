"""What linear theory says of a layer under water, and how measured histories are read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq, curve_fit


def p_wave_modulus(young: float, poisson: float) -> float:
    """Return M = E (1 - nu) / ((1 + nu)(1 - 2 nu)), Pa."""
    return young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))


def first_wave_number(mass_ratio: float) -> float:
    """Return the smallest x > 0 with x tan x = mass ratio = rho_s L_s / (rho_f L_f)."""
    return float(brentq(lambda x: x * np.sin(x) - mass_ratio * np.cos(x), 0.0, np.pi / 2, xtol=1e-14))


def root(scheme: str, omega: float, dt: float) -> complex:
    """Return the factor z by which a step of a scheme multiplies a free, undamped mode of frequency ``omega``.

    The one in the upper half plane that tends to exp(i omega dt): with q = (omega dt)^2 and ln z = (i f - g) dt the
    mode is seen to swing at f and to decay at the rate g. To leading order:

    =========  =======================================  ================  =====================
    newmark    (1 + q/2) z^2 - (2 - q/2) z + 1 = 0      f/omega - 1       -0.115 q
                                                        g                 omega^2 dt / 4
    bdf2       3 - 4/z + 1/z^2 = 2 i omega dt           f/omega - 1       -q / 3
                                                        g                 omega^4 dt^3 / 4
    midpoint   2 (z - 1)/(z + 1) = i omega dt           f/omega - 1       -q / 12
                                                        g                 0
    =========  =======================================  ================  =====================
    """
    x = 1j * omega * dt
    if scheme == "newmark":
        q = (omega * dt) ** 2
        return complex(max(np.roots([1 + q / 2, -(2 - q / 2), 1]), key=np.imag))
    if scheme == "bdf2":
        return complex(1 / (2 - np.sqrt(1 + 2 * x)))
    if scheme == "midpoint":
        return complex((2 + x) / (2 - x))
    raise ValueError(f"no theory of the scheme {scheme!r}; there is of newmark, bdf2 and midpoint")


def observed(scheme: str, omega: float, dt: float) -> tuple[float, float]:
    """Return the angular frequency and the damping rate, 1/s, that a mode of frequency ``omega`` shows."""
    exponent = np.log(root(scheme, omega, dt)) / dt
    return float(exponent.imag), float(-exponent.real)


def undo(scheme: str, seen: float, dt: float) -> float:
    """Return the angular frequency of the mode that shows the frequency ``seen`` at steps of ``dt``."""
    return float(brentq(lambda w: observed(scheme, w, dt)[0] - seen, 0.5 * seen, 2.0 * seen, xtol=1e-13))


def fit_damped_sinusoid(t: np.ndarray, y: np.ndarray, omega: float, damping: float) -> tuple[float, float]:
    """Return frequency and damping of y = exp(-damping t) (a cos(omega t) + b sin(omega t)), from first guesses."""
    scale = np.abs(y).max()

    def model(t: np.ndarray, omega: float, damping: float, a: float, b: float) -> np.ndarray:
        return np.exp(-damping * t) * (a * np.cos(omega * t) + b * np.sin(omega * t))

    # the search takes its first step in proportion to the guess, and none at all from a damping of zero
    guess = omega, max(damping, 1e-3 * omega), 0.0, 1.0
    (omega, damping, _, _), _ = curve_fit(model, t, y / scale, p0=guess)
    return float(omega), float(damping)


def frequency(t: np.ndarray, y: np.ndarray) -> float:
    """Return the frequency of an oscillation, Hz, from where it crosses the middle between its extremes.

    Parameters
    ----------
    t, y : ndarray, shape (n,)
        Two crossings at least.
    """
    off = y - (y.max() + y.min()) / 2
    k = np.flatnonzero(off[:-1] * off[1:] < 0)
    crossings = t[k] - off[k] * (t[k + 1] - t[k]) / (off[k + 1] - off[k])
    return float((len(crossings) - 1) / 2 / (crossings[-1] - crossings[0]))


def orders(errors: Sequence[float], sizes: Sequence[float]) -> np.ndarray:
    """Return the observed order between each two neighbours."""
    return np.diff(np.log(np.abs(errors))) / np.diff(np.log(sizes))


# ---- splitting ----------------------------------------------------------------------------------------------


def split_growth(
    mass: np.ndarray | float,
    stiffness: np.ndarray | float,
    added: np.ndarray | float,
    dt: float,
    mass_damping: float = 0.0,
    stiffness_damping: float = 0.0,
) -> float:
    """Return the largest factor by which a step of the split scheme multiplies a state that the fluid feels.

    The recurrence, with h = dt, C = a0 M + a1 K and u_1 the velocity of the step before,

        (M + h C + h^2 K/2) u1 = (M - h^2 K/2) u0 - h K d0 - M_a (u0 - u_1),     d1 = d0 + h/2 (u0 + u1).

    Parameters
    ----------
    mass, stiffness, added : ndarray, shape (n, n), or float
        M, K and the added mass M_a, of n unknowns or of one mode.
    dt, mass_damping, stiffness_damping : float
        h, a0 and a1.
    """
    M, K, A = (np.atleast_2d(x).astype(float) for x in (mass, stiffness, added))
    h, one, none = dt, np.eye(len(M)), np.zeros_like(M)
    left = M + h * (mass_damping * M + stiffness_damping * K) + h * h / 2 * K
    u = np.linalg.solve(left, np.hstack((M - h * h / 2 * K - A, A, -h * K)))  # of u0, u_1, d0
    d = np.hstack((h / 2 * one, none, one)) + h / 2 * u
    step = np.vstack((u, np.hstack((one, none, none)), d))
    roots, states = np.linalg.eig(step)
    velocities = states[: len(M)]
    felt = np.linalg.norm(A @ velocities, axis=0) > 1e-9 * np.linalg.norm(A) * np.linalg.norm(velocities, axis=0)
    return float(np.abs(roots[felt]).max())


def contraction(
    mass: float, stiffness: float, added: float, dt: float, mass_damping: float = 0.0, stiffness_damping: float = 0.0
) -> float:
    """Return m_a / (m + h c + h^2 k/2): the factor by which an iteration between the halves reduces the error."""
    damping = mass_damping * mass + stiffness_damping * stiffness
    return added / (mass + dt * damping + dt * dt * stiffness / 2)


def chain(n: int, density: float, modulus: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return M and K of a bar of ``n`` linear elements, consistent, its foot held; the last node is its top."""
    e = length / n
    M, K = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    for i in range(n):
        M[i : i + 2, i : i + 2] += density * e / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        K[i : i + 2, i : i + 2] += modulus / e * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return M[1:, 1:], K[1:, 1:]


def prony_growth(values: np.ndarray, log_scale: np.ndarray, order: int) -> float:
    """Return the largest root of the linear recurrence that a sequence obeys (Prony's method).

    Parameters
    ----------
    values, log_scale : ndarray, shape (n,)
        The sequence is ``values * exp(log_scale)``, which may be beyond the range of floating point.
    order : int
        Terms of the recurrence; directions in which the sequence says nothing are left out.
    """
    rows, right = [], []
    for n in range(len(values) - order):
        part = slice(n, n + order + 1)
        window = values[part] * np.exp(log_scale[part] - log_scale[part].max())
        window /= np.abs(window).max()
        rows.append(window[:-1])
        right.append(window[-1])
    recurrence = np.linalg.lstsq(np.array(rows), np.array(right), rcond=1e-6)[0]
    return float(np.abs(np.roots(np.concatenate(([1.0], -recurrence[::-1])))).max())
