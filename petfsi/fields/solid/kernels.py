"""The loops over elements, compiled for each dimension and number of nodes."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
from numba import njit


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
    # the same form for all, so that one function makes g
    n_basis = nodes if plain else dim + 1

    @njit(inline="always")
    def shape_gradients(basis, table, g):
        for a in range(nodes):
            for J in range(dim):
                if plain:
                    g[a, J] = basis[a, J]
                else:
                    s = 0.0
                    for m in range(n_basis):
                        s += table[a, m] * basis[m, J]
                    g[a, J] = s

    @njit(cache=True)
    def gradient(cells, basis, table, d, H):
        n_points = table.shape[0]
        g = np.empty((nodes, dim))
        for e in range(cells.shape[0]):
            for q in range(n_points):
                shape_gradients(basis[e], table[q], g)
                for i in range(dim):
                    for J in range(dim):
                        s = 0.0
                        for a in range(nodes):
                            s += d[cells[e, a], i] * g[a, J]
                        H[e * n_points + q, i, J] = s

    @njit(cache=True)
    def contract(C, S, T):
        for p in range(C.shape[0]):
            for i in range(dim):
                for J in range(dim):
                    s = 0.0
                    for k in range(dim):
                        for L in range(dim):
                            s += C[p, i, J, k, L] * S[p, k, L]
                    T[p, i, J] += s

    @njit(cache=True)
    def forces(cells, basis, table, w, T, volume, mass, V, b):
        n_points = table.shape[0]
        g, f = np.empty((nodes, dim)), np.empty((nodes, dim))
        for e in range(cells.shape[0]):
            for a in range(nodes):
                for i in range(dim):
                    f[a, i] = 0.0
                for m in range(nodes):
                    for i in range(dim):
                        f[a, i] += volume[e] * mass[a, m] * V[cells[e, m], i]
            for q in range(n_points):
                shape_gradients(basis[e], table[q], g)
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

    @njit(cache=True)
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

    @njit(inline="always")
    def add_stiffness(g, C, factor, Cg, K):
        """Add  factor g_a . C . g_b  to the blocks 0 < a <= b of K[a, b]."""
        for b in range(1, nodes):
            for i in range(dim):
                for k in range(dim):
                    for J in range(dim):
                        s = 0.0
                        for L in range(dim):
                            s += C[i, J, k, L] * g[b, L]
                        Cg[i, k, J] = factor * s
            for a in range(1, b + 1):
                for i in range(dim):
                    for k in range(dim):
                        s = 0.0
                        for J in range(dim):
                            s += g[a, J] * Cg[i, k, J]
                        if plain:  # the only point
                            K[a, b, i, k] = s
                        else:
                            K[a, b, i, k] += s

    @njit(inline="always")
    def close(K):
        """Fill the blocks K[0, b]: a translation costs nothing, sum_a g_a = 0."""
        for b in range(nodes):
            for i in range(dim):
                for k in range(dim):
                    K[0, b, i, k] = 0.0
        for b in range(1, nodes):
            for a in range(1, b):
                for i in range(dim):
                    for k in range(dim):
                        K[0, b, i, k] -= K[a, b, i, k]
                        K[0, a, i, k] -= K[a, b, k, i]
            for i in range(dim):
                for k in range(dim):
                    K[0, b, i, k] -= K[b, b, min(i, k), max(i, k)]
        for b in range(1, nodes):
            for i in range(dim):
                for k in range(dim):
                    K[0, 0, i, k] -= K[0, b, i, k]

    @njit(inline="always")
    def clear(K):
        for a in range(1, nodes):
            for b in range(a, nodes):
                for i in range(dim):
                    for k in range(dim):
                        K[a, b, i, k] = 0.0

    @njit(cache=True)
    def tangent(cells, basis, table, w, C, volume, mass, A_M, A_K, node_ptr, slots, values):
        n_points = table.shape[0]
        g, Cg = np.empty((nodes, dim)), np.empty((dim, dim, dim))
        K = np.empty((nodes, nodes, dim, dim))
        for e in range(cells.shape[0]):
            if not plain:
                clear(K)
            for q in range(n_points):
                shape_gradients(basis[e], table[q], g)
                add_stiffness(g, C[e * n_points + q], A_K * w[e, q], Cg, K)
            close(K)
            for a in range(nodes):
                for b in range(a, nodes):
                    for i in range(dim):
                        K[a, b, i, i] += A_M * volume[e] * mass[a, b]
            for a in range(nodes):
                row = cells[e, a]
                if row >= node_ptr.shape[0] - 1:
                    continue
                begin = node_ptr[row]
                width = dim * (node_ptr[row + 1] - begin)
                for b in range(nodes):
                    start = dim * (dim * begin + slots[e, a, b] - begin)
                    for i in range(dim):
                        for k in range(dim):
                            # one half is the mirror of the other, so that the matrix is symmetric to the last bit
                            if a < b or (a == b and i <= k):
                                values[start + i * width + k] += K[a, b, i, k]
                            else:
                                values[start + i * width + k] += K[b, a, k, i]

    return SimpleNamespace(
        gradient=gradient, contract=contract, forces=forces, kinetic=kinetic, tangent=tangent,
    )  # fmt: skip
