"""What the tests of beams share: rows of elements, dense matrices, Newton's iteration."""

import numpy as np
from scipy.linalg import eigh

from petfsi.fields.beam.elements import THEORIES, BeamElements, Sections

#: Corners of a three-node element in the row of nodes: start, end, middle.
_NODES = {3: (0, 2, 1), 2: (0, 1)}


def section(thickness, young=1.0, poisson=0.3, density=1.0, lumped=False, damping=(0.0, 0.0)):
    one = np.ones(1)
    return Sections.rectangular(
        thickness * one, young * one, poisson * one, density * one, np.array([lumped]), np.array([damping])
    )


def row(theory, n, sections, length=1.0, angle=0.0, seed=None):
    """Return a straight beam of ``n`` elements from the origin, of random lengths with a seed, and its points."""
    corners = _NODES[THEORIES[theory].n_nodes]
    step = len(corners) - 1
    ends = np.linspace(0, 1, n + 1)
    if seed is not None:
        ends[1:-1] += np.random.default_rng(seed).uniform(-0.3, 0.3, n - 1) / n
    s = np.interp(np.arange(step * n + 1) / step, np.arange(n + 1), ends)
    points = length * s[:, None] * [np.cos(angle), np.sin(angle)]
    cells = (step * np.arange(n)[:, None] + np.array(corners)).astype(np.int32)
    return BeamElements(points, cells, np.zeros(n, dtype=np.int32), sections, theory), points


def added(elements, blocks, n):
    """Return the sum of the elements' vectors or matrices over all unknowns of ``n`` nodes."""
    where = (3 * elements.cells[:, :, None] + np.arange(3)).reshape(len(elements.cells), -1)
    total = np.zeros((3 * n,) * (blocks.ndim - 1))
    if blocks.ndim == 2:
        np.add.at(total, where, blocks)
    else:
        np.add.at(total, (where[:, :, None], where[:, None, :]), blocks)
    return total


def respond(elements, d):
    """Return energy, forces and tangent of all nodes' d, shape (n, 3)."""
    W, f, K = elements.theory.respond(elements._of_elements(d))
    return W.sum(), added(elements, f, len(d)), added(elements, K, len(d))


def equilibrium(elements, d, load, held, tolerance=1e-8):
    """Solve K(d) = load by Newton's iteration from ``d``; return d and the norms of its residuals over the first."""
    free = np.setdiff1d(np.arange(d.size), held)
    norms = []
    for _ in range(40):
        _, f, K = respond(elements, d)
        r = (load.ravel() - f)[free]
        norms.append(np.linalg.norm(r))
        if norms[-1] <= tolerance * norms[0]:
            return d, np.array(norms) / norms[0]
        d = d.copy()
        d.reshape(-1)[free] += np.linalg.solve(K[np.ix_(free, free)], r)
    raise AssertionError(f"Newton's iteration does not converge: {norms}")


def frequencies(elements, d, held, count):
    """Return the lowest angular frequencies of small oscillations about d."""
    free = np.setdiff1d(np.arange(d.size), held)
    _, _, K = respond(elements, d)
    M = added(elements, elements.mass, len(d))
    return np.sqrt(eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)[:count])
