"""The loops over elements, compiled for each dimension and number of nodes."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
from numba import njit

from petfsi.compiled import compiled_for

# Helpers get the constants of the closures below as arguments: a closure that held a compiled function could not be
# cached on disk.


@njit(inline="always")
def _shape_gradients(basis, table, g, dim, nodes, plain):
    for a in range(nodes):
        for J in range(dim):
            if plain:
                g[a, J] = basis[a, J]
            else:
                s = 0.0
                for m in range(dim + 1):
                    s += table[a, m] * basis[m, J]
                g[a, J] = s


@njit(inline="always")
def _add_stiffness(g, C, factor, T, K, dim, nodes, plain):
    """Add  factor g_a . C . g_b  to the blocks 0 < a <= b of K[a, b]."""
    for a in range(1, nodes):
        # T[i, (k, L)] = factor g_a . C in runs of dim^2 numbers, so that the compiler takes several at a time
        for i in range(dim):
            for c in range(dim * dim):
                T[i, c] = factor * g[a, 0] * C[i, 0, c]
            for J in range(1, dim):
                s = factor * g[a, J]
                for c in range(dim * dim):
                    T[i, c] += s * C[i, J, c]
        for b in range(a, nodes):
            for i in range(dim):
                for k in range(dim):
                    s = 0.0
                    for L in range(dim):
                        s += T[i, dim * k + L] * g[b, L]
                    if plain:  # the only point
                        K[a, b, i, k] = s
                    else:
                        K[a, b, i, k] += s


@njit(inline="always")
def _mirror(K, dim, nodes):
    """Fill one half of the blocks a, b > 0 with the other, so that the matrix is symmetric to the last bit."""
    for a in range(1, nodes):
        for i in range(dim):
            for k in range(i):
                K[a, a, i, k] = K[a, a, k, i]
        for b in range(a + 1, nodes):
            for i in range(dim):
                for k in range(dim):
                    K[b, a, k, i] = K[a, b, i, k]


@njit(inline="always")
def _close(K, dim, nodes):
    """Fill the blocks K[0, b] and K[b, 0]: a translation costs nothing, sum_a g_a = 0."""
    for b in range(1, nodes):
        for i in range(dim):
            for k in range(dim):
                s = 0.0
                for a in range(1, nodes):
                    s -= K[a, b, i, k]
                K[0, b, i, k] = K[b, 0, k, i] = s
    for i in range(dim):
        for k in range(i, dim):
            s = 0.0
            for b in range(1, nodes):
                s -= K[0, b, i, k]
            K[0, 0, i, k] = K[0, 0, k, i] = s


@njit(inline="always")
def _clear(K, dim, nodes):
    for a in range(1, nodes):
        for b in range(a, nodes):
            for i in range(dim):
                for k in range(dim):
                    K[a, b, i, k] = 0.0


@njit(inline="always")
def _add_mass(mass, factor, K, dim, nodes):
    """Add factor mass_ab I, of the half a <= b to both: the two may differ by round-off."""
    for a in range(nodes):
        for i in range(dim):
            K[a, a, i, i] += factor * mass[a, a]
        for b in range(a + 1, nodes):
            s = factor * mass[a, b]
            for i in range(dim):
                K[a, b, i, i] += s
                K[b, a, i, i] += s


@njit(inline="always")
def _scatter(cells, K, node_ptr, slots, values, dim, nodes):
    for a in range(nodes):
        row = cells[a]
        if row >= node_ptr.shape[0] - 1:
            continue
        begin = node_ptr[row]
        width = dim * (node_ptr[row + 1] - begin)
        for b in range(nodes):
            start = dim * (dim * begin + slots[a, b] - begin)
            for i in range(dim):
                for k in range(dim):
                    # of an index without a sign Numba does not ask whether it counts from the end
                    values[np.uint64(start + i * width + k)] += K[a, b, i, k]


@lru_cache
def kernels(dim: int, nodes: int, plain: bool) -> SimpleNamespace:
    """Return the compiled loops for elements with so many nodes.

    With g_a the gradient of shape function a at a quadrature point and w the point's share of the volume:

        gradient(cells, basis, table, d, H)         H = sum_a d_a g_a^T at every point
        contract(C, S, T)                           T += C : S at every point
        forces(cells, basis, table, w, T, volume, mass, V, b)
                                                    b_a += volume mass_ab V_b - w T g_a in the first rows of b
        kinetic(cells, volume, mass, u, v)          returns the sum of volume mass_ab u_a . v_b
        tangent(cells, basis, table, w, C, volume, mass, A_M, A_K, node_ptr, slots, values)
                                                    A_M volume mass_ab I + A_K w g_a . C . g_b, into the rows' values

    Points lie element after element, (ne * Q, dim, dim); ``w`` has shape (ne, Q).

    Parameters
    ----------
    dim, nodes : int
        Constants of the closures: the compiler unrolls the loops over axes and nodes.
    plain : bool
        Whether ``basis`` holds the g_a themselves, one point an element, and ``table`` is not read.
    """

    @compiled_for(dim, nodes, plain)
    def gradient(cells, basis, table, d, H):
        n_points = table.shape[0]
        g = np.empty((nodes, dim))
        for e in range(cells.shape[0]):
            for q in range(n_points):
                _shape_gradients(basis[e], table[q], g, dim, nodes, plain)
                for i in range(dim):
                    for J in range(dim):
                        s = 0.0
                        for a in range(nodes):
                            s += d[cells[e, a], i] * g[a, J]
                        H[e * n_points + q, i, J] = s

    @compiled_for(dim, nodes, plain)
    def contract(C, S, T):
        for p in range(C.shape[0]):
            for i in range(dim):
                for J in range(dim):
                    s = 0.0
                    for k in range(dim):
                        for L in range(dim):
                            s += C[p, i, J, k, L] * S[p, k, L]
                    T[p, i, J] += s

    @compiled_for(dim, nodes, plain)
    def forces(cells, basis, table, w, T, volume, mass, V, b):
        n_points = table.shape[0]
        g, f, v = np.empty((nodes, dim)), np.empty((nodes, dim)), np.empty((nodes, dim))
        for e in range(cells.shape[0]):
            for m in range(nodes):
                for i in range(dim):
                    v[m, i] = volume[e] * V[cells[e, m], i]
            for a in range(nodes):
                for i in range(dim):
                    s = 0.0
                    for m in range(nodes):
                        s += mass[a, m] * v[m, i]
                    f[a, i] = s
            for q in range(n_points):
                _shape_gradients(basis[e], table[q], g, dim, nodes, plain)
                for a in range(nodes):
                    for i in range(dim):
                        s = 0.0
                        for J in range(dim):
                            s += T[e * n_points + q, i, J] * g[a, J]
                        f[a, i] -= w[e, q] * s
            for a in range(nodes):
                row = cells[e, a]
                if row < b.shape[0]:
                    for i in range(dim):
                        b[row, i] += f[a, i]

    @compiled_for(dim, nodes, plain)
    def kinetic(cells, volume, mass, u, v):
        total = 0.0
        for e in range(cells.shape[0]):
            for a in range(nodes):
                for m in range(nodes):
                    s = 0.0
                    for i in range(dim):
                        s += u[cells[e, a], i] * v[cells[e, m], i]
                    total += volume[e] * mass[a, m] * s
        return total

    @compiled_for(dim, nodes, plain)
    def tangent(cells, basis, table, w, C, volume, mass, A_M, A_K, node_ptr, slots, values):
        n_points = table.shape[0]
        rows = C.reshape((C.shape[0], dim, dim, dim * dim))
        g, T = np.empty((nodes, dim)), np.empty((dim, dim * dim))
        K = np.empty((nodes, nodes, dim, dim))
        for e in range(cells.shape[0]):
            if not plain:
                _clear(K, dim, nodes)
            for q in range(n_points):
                _shape_gradients(basis[e], table[q], g, dim, nodes, plain)
                _add_stiffness(g, rows[e * n_points + q], A_K * w[e, q], T, K, dim, nodes, plain)
            _mirror(K, dim, nodes)
            _close(K, dim, nodes)
            _add_mass(mass, A_M * volume[e], K, dim, nodes)
            _scatter(cells[e], K, node_ptr, slots[e], values, dim, nodes)

    return SimpleNamespace(
        gradient=gradient, contract=contract, forces=forces, kinetic=kinetic, tangent=tangent,
    )  # fmt: skip
