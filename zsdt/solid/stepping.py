"""Compiled loops over the brick grid: internal forces, pressure, central differences, and nodal output.

Arrays of nodes are flat with one block of `stride` values per component (stride = nodes + padding), node
``n = i + NX (j + NY k)``. Elements are numbered like the node at their lower corner; one slab (constant k) is cut into
tiles of `LANES` consecutive numbers, so a tile runs across the ends of rows. The elements that this counts at i = nx
do not exist: their `weight` is zero.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from zsdt.solid.element_kernels import (
    FAST,
    corner_stress,
    full_fields,
    full_force,
    stabilised_fields,
    stabilised_force,
)
from zsdt.solid.kernel_parts import CORNER, LANES, MEMORY, OUT, ROW

DONE, OUT_OF_RANGE, NOT_FINITE = 0, 1, 2
PADDING = LANES + 1
MARGIN = OUT + 24 * LANES
ENERGY = OUT + 69 * LANES


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def gather_tile(u, stride, first, nx1, nxy, weight, tile):
    """Displacements of a tile's nodes and the weights of its elements as the rows that a kernel reads."""
    for c in range(3):
        for line in range(4):
            start = c * stride + first + (line & 1) * nx1 + (line >> 1) * nxy
            line_nodes = u[start : start + LANES + 1]
            row = (c * 4 + line) * ROW
            for n in range(LANES + 1):
                tile[row + n] = line_nodes[n]
    for n in range(LANES):
        tile[12 * ROW + n] = weight[n]


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def scatter_tile(tile, f, stride, first, nx1, nxy):
    """Adds the 24 rows of nodal forces to `f`."""
    for c in range(3):
        for line in range(4):
            start = c * stride + first + (line & 1) * nx1 + (line >> 1) * nxy
            nodes = f[start : start + LANES + 1]
            low = tile[OUT + (c * 8 + 2 * line) * LANES : OUT + (c * 8 + 2 * line + 2) * LANES]
            for n in range(LANES):
                nodes[n] += low[n]
            for n in range(LANES):
                nodes[n + 1] += low[LANES + n]


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def internal_forces(full, remember, grid, u, f, memory, weight, constants, tile):
    """Sets `f` to the internal forces at `u`; number of elements outside the watched range.

    `remember` moves the memory on; without, the caller promises that the material has none (keep = m_vis = 0).
    """
    nx1, _, nz, nxy, stride, tiles, rows = grid
    ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi = constants
    f[:] = 0.0
    size = rows * LANES
    bad = 0
    for k in range(nz):
        for t in range(tiles):
            first = k * nxy + t * LANES
            weights = weight[t * LANES : (t + 1) * LANES]
            gather_tile(u, stride, first, nx1, nxy, weights, tile)
            past = memory[(k * tiles + t) * size : (k * tiles + t + 1) * size]
            if full:
                full_force(tile, past, ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi)
            else:
                if remember:
                    for n in range(43 * LANES):
                        tile[MEMORY + n] = past[n]
                stabilised_force(tile, ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi)
                if remember:
                    for n in range(43 * LANES):
                        past[n] = tile[MEMORY + n]
            scatter_tile(tile, f, stride, first, nx1, nxy)
            for n in range(LANES):
                bad += 1 if weights[n] > 0.0 and not tile[MARGIN + n] > 0.0 else 0
    return bad


@njit(cache=True, error_model="numpy")
@no_type_check
def add_pressure(faces, pressure, points, u, stride, load):
    """Adds the forces of `pressure` [Pa] on `faces` [faces, 4] (seen from outside, counter-clockwise) as they lie."""
    edge = np.empty((2, 3))
    for face in range(len(faces)):
        for d in range(2):
            a, b = faces[face, d], faces[face, d + 2]
            for c in range(3):
                edge[d, c] = points[c * stride + b] + u[c * stride + b] - points[c * stride + a] - u[c * stride + a]
        for c in range(3):
            i, j = (c + 1) % 3, (c + 2) % 3
            share = -0.125 * pressure * (edge[0, i] * edge[1, j] - edge[0, j] * edge[1, i])
            for corner in range(4):
                load[c * stride + faces[face, corner]] += share


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def drift(u, v, dt, load):
    """Moves the nodes for `dt`; power of `load` on the way, in J / dt."""
    power = 0.0
    for n in range(len(u)):
        power += load[n] * v[n]
        u[n] += dt * v[n]
    return power


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def kick(v, f, load, weight_force, inverse_mass, slow, dt):
    """Changes the velocities for `dt`; (power of `load`, sum of squared velocities) with the old velocities."""
    power = 0.0
    speed = 0.0
    for n in range(len(v)):
        power += load[n] * v[n]
        v[n] = slow * v[n] + dt * inverse_mass[n] * (load[n] + weight_force[n] - f[n])
        speed += v[n] * v[n]
    return power, speed


@njit(cache=True, error_model="numpy")
@no_type_check
def advance(
    full, grid, u, v, f, load, memory, weight, constants, tile,
    weight_force, inverse_mass, dt, damping, faces, points, pressure, load_low, load_high,
):  # fmt: skip
    """Runs len(pressure) - 1 central-difference steps; (status, work of the load in J, steps done).

    On entry and exit `u` is at a time t, `v` at t + dt/2, `f`, `load` and `memory` at t. `pressure` [steps + 1] acts
    on `faces`; dead nodal loads run linearly from `load_low` to `load_high`. `damping` [1/s] is mass damping.
    """
    steps = len(pressure) - 1
    remember = constants[3] > 0.0  # m_vis
    stride = grid[4]
    slow = (1.0 - 0.5 * damping * dt) / (1.0 + 0.5 * damping * dt)
    kick_dt = dt / (1.0 + 0.5 * damping * dt)
    total = 0.0
    for s in range(1, steps + 1):
        total += drift(u, v, dt, load)
        bad = internal_forces(full, remember, grid, u, f, memory, weight, constants, tile)
        part = s / steps
        load[:] = load_low + part * (load_high - load_low)
        if len(faces):
            add_pressure(faces, pressure[s], points, u, stride, load)
        power, speed = kick(v, f, load, weight_force, inverse_mass, slow, kick_dt)
        total += power
        if not math.isfinite(speed + power):
            return NOT_FINITE, 0.5 * dt * total, s
        if bad:
            return OUT_OF_RANGE, 0.5 * dt * total, s
    return DONE, 0.5 * dt * total, steps


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def add_real(total, values, weights):
    """Adds the values of those elements of a tile that exist."""
    for n in range(LANES):
        total[n] += values[n] if weights[n] > 0.0 else 0.0


@njit(cache=True, fastmath=FAST, error_model="numpy")
@no_type_check
def nodal_output(full, grid, u, memory, weight, constants, tile, stress, energy, norm):
    """Adds up, per node, the corner stresses of its elements (`stress` [6 stride]), their elastic energy density
    (`energy`) and the sum over steps of their |q|^2 (`norm`).

    Divided by the number of elements around a node these are nodal averages.
    """
    nx1, _, nz, nxy, stride, tiles, rows = grid
    ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi = constants
    size = rows * LANES
    for k in range(nz):
        for t in range(tiles):
            first = k * nxy + t * LANES
            weights = weight[t * LANES : (t + 1) * LANES]
            gather_tile(u, stride, first, nx1, nxy, weights, tile)
            past = memory[(k * tiles + t) * size : (k * tiles + t + 1) * size]
            if full:
                full_fields(tile, past, ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi)
            else:
                for n in range(43 * LANES):
                    tile[MEMORY + n] = past[n]
                stabilised_fields(tile, ih, bulk, m_inf, m_vis, keep, cond_s, cond_q, m_last, per_q, lo, hi)
            summed = past[size - LANES :]
            for point in range(8):
                x, y, z = point & 1, (point >> 1) & 1, point >> 2
                node = first + x + y * nx1 + z * nxy
                corner_stress(tile, 2.0 * x - 1.0, 2.0 * y - 1.0, 2.0 * z - 1.0)
                for c in range(6):
                    add_real(stress[c * stride + node :], tile[CORNER + c * LANES :], weights)
                add_real(energy[node:], tile[ENERGY:], weights)
                add_real(norm[node:], summed, weights)
