"""Exact potential flows past bodies, and the fluid that bodies in channels and beams between layers carry along."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import lpmv

#: Images of a body in the walls of its channel that are summed one by one, on either side.
IMAGES = 10
#: Multipoles of a body along the channel's axis, and the symmetries about it that are looked at.
DEGREES, SYMMETRIES = 9, (0, 4, 8)


@dataclass(frozen=True)
class Round:
    """A disk or a ball in a stream.

    The potential of the flow past it is  U . r (1 + (R/r)^d / (d - 1))  with r from its centre.

    Attributes
    ----------
    centre : tuple of float
        m.
    radius : float
        R, m.
    stream : tuple of float
        U, the velocity far away, m/s.

    References
    ----------
    H. Lamb, Hydrodynamics (1932), articles 68 and 92.
    """

    centre: tuple[float, ...]
    radius: float
    stream: tuple[float, ...]

    def velocity(self, points: np.ndarray) -> np.ndarray:
        """Return the velocity at points, (n, dim), m/s; inside the body that of the same formula."""
        dim, U = len(self.centre), np.array(self.stream)
        r = points - np.array(self.centre)
        square = np.sum(r**2, axis=1)[:, None]
        part = (self.radius**2 / square) ** (dim / 2) / (dim - 1)
        return U * (1 + part) - dim * part * (r @ U)[:, None] * r / square

    def inflow(self, axis: int, plane: float, dx: list[float]) -> str:
        """Return the mean velocity along ``axis`` over a face of a plane about x, y, z, as a scene's expression.

        It is the circulation of the stream function, in 3D of the vector potential U x r (1 - (R/r)^3) / 2, about the
        face, so that what comes in through the sides of a box goes out again, but for round-off.
        """
        if len(dx) == 2:
            return self._along_segment(axis, plane, dx)
        return self._about_face(axis, plane, dx)

    def _place(self, axis: int, plane: float, off: dict[int, float]) -> list[str]:
        """Return expressions of x, y, z from the centre: those of a face's centre, on a plane, and ``off`` it."""
        names, shift = list("xyz"), [off.get(a, 0.0) - c for a, c in enumerate(self.centre)]
        names[axis], shift[axis] = "", shift[axis] + plane
        return [f"({name}{s:+.14g})" for name, s in zip(names, shift, strict=False)]

    def _along_segment(self, axis: int, plane: float, dx: list[float]) -> str:
        """Return the difference of U x r (1 - (R/r)^2) between a face's ends over its length: v = (d/dy, -d/dx)."""
        other = 1 - axis
        ends = []
        for sign in (1, -1):
            x, y = self._place(axis, plane, {other: sign * dx[other] / 2})
            cross = f"({self.stream[0]!r}*{y}-({self.stream[1]!r})*{x})"
            ends.append(f"{cross}*(1-{self.radius**2!r}/({x}**2+{y}**2))")
        return f"({ends[0]}-{ends[1]})/({dx[other] if axis == 0 else -dx[other]!r})"

    def _about_face(self, axis: int, plane: float, dx: list[float]) -> str:
        """Return the circulation about a face over its area.

        Along an edge parallel to axis a at the distance q from the centre's parallel, (U x r)_a is constant, and

            int_s^t (1 - (R/r)^3) dr_a = t - s - R^3/q^2 (t/sqrt(t^2 + q^2) - s/sqrt(s^2 + q^2)) .
        """
        b, c = (axis + 1) % 3, (axis + 2) % 3
        terms = []
        for along, across, sign in ((b, c, -1), (b, c, 1), (c, b, 1), (c, b, -1)):
            # v = d A_c / d b - d A_b / d c
            s, t = (
                self._place(axis, plane, {across: sign * dx[across] / 2, along: end * dx[along] / 2}) for end in (-1, 1)
            )
            u, w = (along + 1) % 3, (along + 2) % 3
            q = f"({t[u]}**2+{t[w]}**2)"
            cross = f"({self.stream[u]!r}*{t[w]}-({self.stream[w]!r})*{t[u]})"
            reach = f"({t[along]}/sqrt({t[along]}**2+{q})-{s[along]}/sqrt({s[along]}**2+{q}))"
            turn = "-" if (sign < 0) == (along == c) else "+"
            terms.append(f"{turn}{cross}*({dx[along]!r}-{self.radius**3:.14g}*{reach}/{q})")
        return f"({''.join(terms)})/({2 * dx[b] * dx[c]!r})"


def sides(flow: Round, origin: list[float], size: list[float], cells: list[int]) -> dict[str, dict]:
    """Return the sides of a box, all of them inflows, that a flow passes through."""
    dx = [s / n for s, n in zip(size, cells, strict=True)]
    found = {}
    for axis, names in enumerate((("left", "right"), ("bottom", "top"), ("back", "front"))[: len(cells)]):
        for upper, name in enumerate(names):
            speed = flow.inflow(axis, origin[axis] + upper * size[axis], dx)
            found[name] = {"inflow": {"speed": f"-({speed})" if upper else speed}}
    return found


# ---- bodies that move in channels ---------------------------------------------------------------------------


def added_mass_in_channel(dim: int, radius: float) -> float:
    """Return the added mass over the displaced mass of a disk or a ball that moves along the middle of a channel.

    The channel, between two walls in 2D and square in 3D, is 1 wide and closed far away. With its images in the
    walls the body is one of a row (a square lattice) that move alike across it. The potential is a sum of
    multipoles, equal in all bodies, of the symmetry of the row (the lattice),

        phi = sum_k a_k sum_images f_k(x - x_image),  d phi / d n = n_y on one body,  m_a/m = - int phi n_y dA / V ,

    whose coefficients are those of least squares on points of one body. In 2D  f_k = Re i^... (z^-k)  sums to
    derivatives of pi coth(pi z); in 3D f = P_l^m(cos t) cos(m p) / r^(l+1), with t from the channel's axis, l odd and
    m a multiple of four, is summed over a square of images, the tail of the dipoles as an integral.

    References
    ----------
    Lord Rayleigh, On the influence of obstacles arranged in rectangular order upon the properties of a medium (1892).
    """
    return _disk_in_channel(radius) if dim == 2 else _ball_in_channel(radius)


def _disk_in_channel(radius: float) -> float:
    """Return that of a disk: multipoles of odd order, each of a row of bodies at x = 0, +-1, ..."""
    angle = np.pi * (np.arange(64) + 0.5) / 128  # a quarter is enough
    n = np.exp(1j * angle)  # from y, the way it goes, towards x
    z = radius * n
    images = np.arange(-4000, 4001)[:, None] * 1j
    orders = range(1, DEGREES + 1, 2)
    # a row of 1/z sums to pi coth(pi z); the higher orders converge by themselves
    row = {k: ((z - images) ** -k).sum(axis=0) for k in (*orders, *(k + 1 for k in orders))}
    row[1], row[2] = np.pi / np.tanh(np.pi * z), (np.pi / np.sinh(np.pi * z)) ** 2
    phi = np.array([row[k].real for k in orders])
    flux = np.array([-k * (row[k + 1] * n).real for k in orders])
    scale = np.abs(flux).max(axis=1)
    a = np.linalg.lstsq((flux / scale[:, None]).T, n.real, rcond=None)[0]
    return float(-2 * np.mean((a / scale) @ phi * n.real) / radius)


def _ball_in_channel(radius: float) -> float:
    """Return that of a ball: l odd, m = 0, 4, 8."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    cosine, weights = nodes[nodes > 0], weights[nodes > 0]
    turn = np.pi / 4 * (np.arange(8) + 0.5) / 8
    c, p = (g.ravel() for g in np.meshgrid(cosine, turn, indexing="ij"))
    s = np.sqrt(1 - c**2)
    n = np.column_stack((s * np.cos(p), c, s * np.sin(p)))
    kinds = [(degree, m) for m in SYMMETRIES for degree in range(1, DEGREES + 1, 2) if m <= degree]
    step = 5e-3 * radius
    phi, flux = [], []
    for degree, m in kinds:
        below2, below, at, above, above2 = (_lattice((radius + k * step) * n, degree, m) for k in range(-2, 3))
        phi.append(at)
        flux.append((8 * (above - below) - (above2 - below2)) / (12 * step))
    scale = np.abs(flux).max(axis=1)
    a = np.linalg.lstsq((np.array(flux) / scale[:, None]).T, n[:, 1], rcond=None)[0]
    value = (a / scale) @ np.array(phi) * n[:, 1]
    area = 4 * np.pi * radius**2 * np.average(value, weights=np.repeat(weights, len(turn)))
    return float(-area / (4 / 3 * np.pi * radius**3))


def _lattice(points: np.ndarray, degree: int, m: int) -> np.ndarray:
    """Return a multipole about y at points, (n, 3), summed over the images at integer x and z."""
    total = np.zeros(len(points))
    for i, k in product(range(-IMAGES, IMAGES + 1), repeat=2):
        x, y, z = (points - np.array([i, 0, k])).T
        r = np.sqrt(x * x + y * y + z * z)
        total += lpmv(m, degree, y / r) * np.cos(m * np.arctan2(z, x)) / r ** (degree + 1)
    if degree == 1:
        total += points[:, 1] * 4 * np.sqrt(2) / (IMAGES + 0.5)
    return total


# ---- beams --------------------------------------------------------------------------------------------------


def beam_between_layers(
    wave: float, rigidity: float, beam: float, inertia: float, fluid: float, closed: float, opened: float
) -> float:
    """Return the angular frequency of a thin beam that swings as cos(k x) between two layers of fluid, rad/s.

    One layer ends at a wall: it moves as cos(k x) cosh(k (y - wall)) and has the mass  rho coth(k H) / k  per length;
    the other at an open surface: cos(k x) sinh(k (y - surface)) and  rho tanh(k H) / k. For a beam without shear

        omega^2 = E I k^4 / (rho_s t + rho_s I k^2 + rho (coth k H_1 + tanh k H_2) / k) .

    Parameters
    ----------
    wave : float
        k, 1/m.
    rigidity : float
        E I, N m.
    beam, inertia : float
        rho_s t and rho_s I, kg/m^2 and kg.
    fluid : float
        rho, kg/m^3.
    closed, opened : float
        H_1 and H_2, m.
    """
    layers = 1 / np.tanh(wave * closed) + np.tanh(wave * opened)
    return float(np.sqrt(rigidity * wave**4 / (beam + inertia * wave**2 + fluid / wave * layers)))
