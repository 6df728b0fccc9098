"""The compiled loops over pairs, one set for each dimension and kernel; ``passes`` says what they compute.

The dimension, the kernel's number and which terms there are, are constants of the factories' closures, so dead branches
vanish and Numba's cache on disk tells the sets apart. Indices are unsigned, because Numba tests signed ones for
counting from the end; divisions are not tested for zero, because such tests keep loops from being vectors.

Packed rows hold x, v, V = m/rho and rho; sums hold f, S, the power lost and the fullness. The loops over fluid pairs
go over each row's list three times: one gathers what the pairs need from rows j into blocks of eight pairs, the next
computes on whole blocks (the processor's vectors, which are far quicker at square roots and divisions), and the last
adds to the rows in order. All is IEEE arithmetic as written (no fastmath), so it does not matter where in a block a
pair stands. ``lanes`` is always 8 but an argument: of a loop with a known end LLVM makes eight copies instead of
vectors.
"""

from __future__ import annotations

import functools

import numpy as np
from numba import njit

from petfsi.compiled import compiled_for
from petfsi.fields.sph.kernels import shape

X, V, VOLUME, RHO = 0, 3, 6, 7
F, S, POWER, FULL = 0, 3, 6, 7

# where a block keeps its eight values of each quantity (what comes out apart from what goes in), and its length
R0, R1, R2, U0, U1, U2, Q2, UR, VJ, RJ, SCALED, PUSH, DRAG, SHIFT, LOST, FILL = (np.uint64(8 * k) for k in range(16))
RISE, TERM, FLUX = SCALED, PUSH, SHIFT
BLOCK = 128
LANES, LANE, EIGHTH, ONE = np.uint64(8), np.uint64(7), np.uint64(3), np.uint64(1)


@njit(cache=True)
def _blocks(start, n):
    """Return memory for the blocks of the longest list, all finite: what fills up the last block is computed on."""
    longest = np.uint64(0)
    for i in range(n):
        longest = max(longest, start[i + ONE] - start[i])
    return np.ones(((longest + LANE) // LANES, BLOCK))


@functools.cache
def density_loop(dim: int, kernel: int, diffuses: bool):
    """Return the pass of fluid pairs that adds to the rates of density, with or without diffusion."""

    @compiled_for(dim, kernel, diffuses, error_model="numpy")
    def density(start, other, rows, inv_s, f_scale, diffusion, g, lanes, total, diffusive):
        n = np.uint64(total.size)
        blocks = _blocks(start, n)
        g0, g1, g2 = g[0], g[1], g[2]
        for i in range(n):
            x0, x1, x2 = rows[i, 0], rows[i, 1], rows[i, 2] if dim == 3 else 0.0
            v0, v1, v2 = rows[i, 3], rows[i, 4], rows[i, 5] if dim == 3 else 0.0
            volume, rho = rows[i, VOLUME], rows[i, RHO]
            begin, count = start[i], start[i + ONE] - start[i]
            for k in range(count):
                j, block, lane = other[begin + k], k >> EIGHTH, k & LANE
                r0, r1 = x0 - rows[j, 0], x1 - rows[j, 1]
                u0, u1 = v0 - rows[j, 3], v1 - rows[j, 4]
                q2, ur, gr = r0 * r0 + r1 * r1, u0 * r0 + u1 * r1, g0 * r0 + g1 * r1
                if dim == 3:
                    r2, u2 = x2 - rows[j, 2], v2 - rows[j, 5]
                    q2, ur, gr = q2 + r2 * r2, ur + u2 * r2, gr + g2 * r2
                blocks[block, Q2 + lane], blocks[block, UR + lane] = q2, ur
                blocks[block, VJ + lane] = rows[j, VOLUME]
                if diffuses:
                    blocks[block, RISE + lane] = rows[j, RHO] - rho + gr
            _density_terms(blocks, (count + LANE) >> EIGHTH, lanes, kernel, inv_s, diffuses)
            sum_total = sum_diffusive = 0.0
            for k in range(count):
                j, block, lane = other[begin + k], k >> EIGHTH, k & LANE
                other_volume, term = blocks[block, VJ + lane], blocks[block, TERM + lane]
                sum_total += other_volume * term
                total[j] += volume * term
                if diffuses:
                    flux = blocks[block, FLUX + lane]
                    sum_diffusive += other_volume * flux
                    diffusive[j] -= volume * flux
            total[i] += sum_total
            if diffuses:
                diffusive[i] += sum_diffusive
        for i in range(n):
            diffusive[i] *= diffusion * f_scale
            total[i] = total[i] * rows[i, RHO] * f_scale + diffusive[i]

    return density


@njit(cache=True, error_model="numpy", inline="always")
def _density_terms(blocks, n_blocks, lanes, kernel, inv_s, diffuses):
    """Multiply what the blocks hold by the kernel's f."""
    for block in range(n_blocks):
        for lane in range(lanes):
            w, f = shape(kernel, np.sqrt(blocks[block, Q2 + lane]) * inv_s)
            blocks[block, TERM + lane] = f * blocks[block, UR + lane]
            if diffuses:
                blocks[block, FLUX + lane] = f * blocks[block, RISE + lane]


@functools.cache
def wall_density_loop(dim: int, kernel: int, sided: bool):
    """Return the pass of pairs with walls that adds to the rates of density; of ``sided`` walls, the part seen."""

    @compiled_for(dim, kernel, sided, error_model="numpy")
    def wall_density(start, other, rows, x, v, volume, seen, inv_s, f_scale, total):
        for i in range(total.size):
            added = 0.0
            for k in range(start[i], start[i + np.uint64(1)]):
                d = other[k]
                r2 = ur = 0.0
                for a in range(dim):
                    r = rows[i, X + a] - x[d, a]
                    r2 += r * r
                    ur += (rows[i, V + a] - v[d, a]) * r
                w, f = shape(kernel, np.sqrt(r2) * inv_s)
                if sided:
                    f *= seen[k]
                added += volume[d] * f * ur
            total[i] += added * rows[i, RHO] * f_scale

    return wall_density


@functools.cache
def wall_pressure_loop(dim: int, kernel: int, sided: bool):
    """Return the pass that averages the fluid's pressure, continued to the wall rows."""

    @compiled_for(dim, kernel, sided, error_model="numpy")
    def wall_pressure(start, other, x, rho, p, x_wall, a_wall, seen, g, inv_s, pressure, weight):
        for i in range(rho.size):
            for k in range(start[i], start[i + np.uint64(1)]):
                d = other[k]
                r2 = rise = 0.0
                for a in range(dim):
                    r = x_wall[d, a] - x[i, a]
                    r2 += r * r
                    rise += (g[a] - a_wall[d, a]) * r
                w, f = shape(kernel, np.sqrt(r2) * inv_s)
                if sided:
                    w *= seen[k]
                pressure[d] += w * (p[i] + rho[i] * rise)
                weight[d] += w
        for d in range(pressure.size):
            pressure[d] = pressure[d] / weight[d] if weight[d] > 0.0 else 0.0

    return wall_pressure


@functools.cache
def force_loop(dim: int, kernel: int, artificial: bool, laminar: bool):
    """Return the pass of fluid pairs that adds to forces, S and the power lost; with Pi, with c_ij or without."""

    @compiled_for(dim, kernel, artificial, laminar, error_model="numpy")
    def force(start, other, rows, scaled, inv_s, f_scale, w_unit, alpha2, soft2, nu4, lanes, sums):
        n = np.uint64(scaled.size)
        blocks = _blocks(start, n)
        for i in range(n):
            begin, count = start[i], start[i + ONE] - start[i]
            volume, rho = rows[i, VOLUME], rows[i, RHO]
            _gather(rows, scaled, other, i, begin, count, blocks, dim, artificial, laminar)
            scales = inv_s, w_unit, alpha2, soft2, nu4
            row = volume * rho, rho, scaled[i]
            _force_terms(blocks, (count + LANE) >> EIGHTH, lanes, kernel, row, scales, dim, artificial, laminar)
            _scatter(sums, volume, other, i, begin, count, blocks, dim, artificial, laminar)
        for i in range(n):
            for a in range(8):
                sums[i, a] *= f_scale

    return force


@njit(cache=True, inline="always")
def _gather(rows, scaled, other, i, begin, count, blocks, dim, artificial, laminar):
    """Fill the blocks of row i with what its pairs need."""
    x0, x1, x2 = rows[i, 0], rows[i, 1], rows[i, 2] if dim == 3 else 0.0
    v0, v1, v2 = rows[i, 3], rows[i, 4], rows[i, 5] if dim == 3 else 0.0
    for k in range(count):
        j, block, lane = other[begin + k], k >> EIGHTH, k & LANE
        r0, r1 = x0 - rows[j, 0], x1 - rows[j, 1]
        q2 = r0 * r0 + r1 * r1
        if dim == 3:
            r2 = x2 - rows[j, 2]
            q2 += r2 * r2
            blocks[block, R2 + lane] = r2
        blocks[block, R0 + lane], blocks[block, R1 + lane], blocks[block, Q2 + lane] = r0, r1, q2
        blocks[block, VJ + lane], blocks[block, RJ + lane] = rows[j, VOLUME], rows[j, RHO]
        blocks[block, SCALED + lane] = scaled[j]
        if artificial or laminar:
            u0, u1 = v0 - rows[j, 3], v1 - rows[j, 4]
            ur = u0 * r0 + u1 * r1
            if dim == 3:
                u2 = v2 - rows[j, 5]
                ur += u2 * r2
            if artificial:
                blocks[block, UR + lane] = ur
            if laminar:
                blocks[block, U0 + lane], blocks[block, U1 + lane] = u0, u1
                if dim == 3:
                    blocks[block, U2 + lane] = u2


@njit(cache=True, error_model="numpy", inline="always")
def _force_terms(blocks, n_blocks, lanes, kernel, row, scales, dim, artificial, laminar):
    """Compute what multiplies r and v_ij of the blocks' pairs, and the power that they lose."""
    mass, rho, scaled = row
    inv_s, w_unit, alpha2, soft2, nu4 = scales
    for block in range(n_blocks):
        for lane in range(lanes):
            q2, vj, rj = blocks[block, Q2 + lane], blocks[block, VJ + lane], blocks[block, RJ + lane]
            w, f = shape(kernel, np.sqrt(q2) * inv_s)
            mm = mass * f * (vj * rj)
            push, lost = scaled + blocks[block, SCALED + lane], 0.0
            if artificial:
                # Pi with the mean density as half of the sum
                ur = blocks[block, UR + lane]
                extra = alpha2 * min(ur, 0.0) / ((rho + rj) * (q2 + soft2))
                push -= extra
                lost -= mm * extra * ur
            if laminar:
                u0, u1, u2 = blocks[block, U0 + lane], blocks[block, U1 + lane], blocks[block, U2 + lane]
                drag = nu4 * mm / (rho + rj)
                lost -= drag * (u0 * u0 + u1 * u1 + u2 * u2 if dim == 3 else u0 * u0 + u1 * u1)
                blocks[block, DRAG + lane] = drag
            w *= w_unit
            w *= w
            blocks[block, PUSH + lane] = push * mm
            blocks[block, SHIFT + lane] = f * (1.0 + w * w)
            blocks[block, LOST + lane] = lost
            blocks[block, FILL + lane] = -f * q2


@njit(cache=True, inline="always")
def _scatter(sums, volume, other, i, begin, count, blocks, dim, artificial, laminar):
    """Add the blocks' pairs to row i and to their rows j."""
    f0 = f1 = f2 = s0 = s1 = s2 = power = full = 0.0
    for k in range(count):
        j, block, lane = other[begin + k], k >> EIGHTH, k & LANE
        r0, r1, push = blocks[block, R0 + lane], blocks[block, R1 + lane], blocks[block, PUSH + lane]
        shift = blocks[block, SHIFT + lane]
        mine, its = shift * blocks[block, VJ + lane], shift * volume
        t0, t1 = push * r0, push * r1
        if laminar:
            drag = blocks[block, DRAG + lane]
            t0, t1 = t0 - drag * blocks[block, U0 + lane], t1 - drag * blocks[block, U1 + lane]
        if artificial or laminar:
            power += blocks[block, LOST + lane]
        f0, f1, s0, s1 = f0 - t0, f1 - t1, s0 + mine * r0, s1 + mine * r1
        fill = blocks[block, FILL + lane]
        full += fill * blocks[block, VJ + lane]
        sums[j, FULL] += fill * volume
        sums[j, 0] += t0
        sums[j, 1] += t1
        sums[j, 3] -= its * r0
        sums[j, 4] -= its * r1
        if dim == 3:
            r2 = blocks[block, R2 + lane]
            t2 = push * r2
            if laminar:
                t2 -= drag * blocks[block, U2 + lane]
            f2, s2 = f2 - t2, s2 + mine * r2
            sums[j, 2] += t2
            sums[j, 5] -= its * r2
    sums[i, 0] += f0
    sums[i, 1] += f1
    sums[i, 3] += s0
    sums[i, 4] += s1
    if dim == 3:
        sums[i, 2] += f2
        sums[i, 5] += s2
    sums[i, POWER] = power
    sums[i, FULL] += full


@functools.cache
def wall_force_loop(dim: int, kernel: int, sided: bool):
    """Return the pass of pairs with walls that adds to forces on both, S and the power lost."""

    @compiled_for(dim, kernel, sided, error_model="numpy")
    def wall_force(
        start, other, rows, scaled, x, v, normal, depth, seen, no_slip, scaled_wall, rho_wall, volume, inv_s,
        f_scale, w_unit, nu4, near, stop, sums, f_wall,
    ):  # fmt: skip
        r, u = np.zeros(dim), np.zeros(dim)
        for i in range(scaled.size):
            rho = rows[i, RHO]
            mass = rows[i, VOLUME] * rho
            for k in range(start[i], start[i + np.uint64(1)]):
                d = other[k]
                r2 = height = uu = 0.0
                for a in range(dim):
                    r[a], u[a] = rows[i, X + a] - x[d, a], rows[i, V + a] - v[d, a]
                    r2, uu, height = r2 + r[a] * r[a], uu + u[a] * u[a], height + r[a] * normal[d, a]
                w, f = shape(kernel, np.sqrt(r2) * inv_s)
                f *= f_scale
                if sided:
                    f *= seen[k]
                mm = mass * (volume[d] * rho_wall[d]) * f
                push, drag = scaled[i] + scaled_wall[d], 0.0
                if r2 < near * near:
                    push = max(push, stop * (1.0 - np.sqrt(r2) / near))
                push *= mm
                if nu4 > 0.0 and no_slip[d]:
                    # beta: depth behind the wall over the distance before it, which must not be too small
                    before = height - depth[d]
                    beta = depth[d] / before if depth[d] < 1.5 * before else 1.5
                    drag = (1.0 + beta) * nu4 * mm / (rho + rho_wall[d])
                    sums[i, POWER] -= drag * uu
                w *= w_unit
                w *= w
                sums[i, FULL] -= volume[d] * f * r2
                shift = volume[d] * f * (1.0 + w * w)
                for a in range(dim):
                    t = drag * u[a] - push * r[a]
                    sums[i, F + a] += t
                    f_wall[d, a] -= t
                    sums[i, S + a] += shift * r[a]

    return wall_force


@functools.cache
def seen_loop(dim: int, n_bounds: int):
    """Return the pass that finds how much a particle sees of wall rows: of sided ones through their own face alone.

    All from before the facet, where the straight way to it crosses the face within its rims, else nothing; in between
    it grows over a small part of a spacing, so that forces have no jumps there.
    """

    @compiled_for(dim, n_bounds, error_model="numpy")
    def part_seen(start, other, x, x_wall, normal, depth, sided, outward, limit, inv_edge, seen):
        for i in range(x.shape[0]):
            for k in range(start[i], start[i + np.uint64(1)]):
                d = other[k]
                seen[k] = 1.0
                if not sided[d]:
                    continue
                height = -depth[d]
                for a in range(dim):
                    height += (x[i, a] - x_wall[d, a]) * normal[d, a]
                part = min(max(height * inv_edge, 0.0), 1.0)
                if part > 0.0:
                    t = height / (height + depth[d])
                    for b in range(n_bounds):
                        beyond = -limit[d, b]
                        for a in range(dim):
                            beyond += (x[i, a] + t * (x_wall[d, a] - x[i, a])) * outward[d, b, a]
                        part *= min(max(0.5 - beyond * inv_edge, 0.0), 1.0)
                seen[k] = part

    return part_seen


@njit(cache=True, error_model="numpy")
def pack(x, v, rho, m, rows):
    """Fill the packed rows."""
    for i in range(rho.size):
        rows[i, X], rows[i, X + 1], rows[i, V], rows[i, V + 1] = x[i, 0], x[i, 1], v[i, 0], v[i, 1]
        if x.shape[1] == 3:
            rows[i, X + 2], rows[i, V + 2] = x[i, 2], v[i, 2]
        rows[i, VOLUME], rows[i, RHO] = m[i] / rho[i], rho[i]


@njit(cache=True, error_model="numpy")
def start_forces(p, rho, scaled, sums):
    """Fill p/rho^2 and clear the sums."""
    for i in range(rho.size):
        scaled[i] = p[i] / (rho[i] * rho[i])
        sums[i] = 0.0


@njit(cache=True, error_model="numpy")
def unpack(sums, f, S_, power, full):
    """Copy the sums out."""
    for i in range(power.size):
        f[i, 0], f[i, 1], S_[i, 0], S_[i, 1] = sums[i, F], sums[i, F + 1], sums[i, S], sums[i, S + 1]
        if f.shape[1] == 3:
            f[i, 2], S_[i, 2] = sums[i, F + 2], sums[i, S + 2]
        power[i], full[i] = sums[i, POWER], sums[i, FULL] / f.shape[1]
