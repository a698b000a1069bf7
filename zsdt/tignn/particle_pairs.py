"""The pair passes of the particle engine: who acts on whom, and the two sums over neighbours of a sub-step.

Both sums meet every pair from both sides: without scattered writes and branches the loops run in vector registers.
Rows of the neighbour list are filled up to a multiple of the register's width with the particle itself, which acts on
itself with exactly nothing, so no row has a slow rest. In single precision the loops are nearly twice as fast: places
are then relative to the first particle, sums over a row are of a hundred terms, and what is summed over sub-steps stays
in double precision.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import numba as nb
import numpy as np

from zsdt.radius_graph import _moved, fill_neighbours, workspace
from zsdt.tignn.particle_walls import _fast

DIFFUSION = 0.1  # of the strain, over support times speed of sound (delta-SPH: 2 delta h c)
CAPACITY = 64  # neighbours per particle that the lists hold at first; a fuller list is refused
LANES = 8  # numbers that go through a register at once: rows of the list are filled up to a multiple of them
BROKEN_LIST = -1

_vector = nb.njit(cache=True, fastmath=True, error_model="numpy", boundscheck=False)


class Constants(NamedTuple):
    """Numbers of one body: spacing m, mass kg, volume m3, stiffness rho0 c^2 Pa, viscosity Pa s, density kg/m3,
    cutoff (in spacings), skin m, guard m, gravity [3] m/s2; the soft barrier before a wall:
    reach m, speed m/s that climbs it; lift: weight of `WallTables`' lift."""

    spacing: float
    mass: float
    volume: float
    stiffness: float
    viscosity: float
    density: float
    cutoff: float
    skin: float
    guard: float
    gravity: Any
    reach: float
    climb: float
    lift: float


class Scratch(NamedTuple):
    """Work arrays of the kernel for n particles; nothing in it is state (the list is valid while nobody strays).

    offset, neighbour: the list with its filled rows. record [7, n]: what the pair loops read of a particle, in their
    precision.
    """

    since: Any
    integers: Any
    floats: Any
    bare: Any
    offset: Any
    found: Any
    sorted: Any
    neighbour: Any
    record: Any
    wall: Any
    sums: Any
    wide: Any
    rate: Any
    spread: Any
    blend: Any


def new_scratch(particles: int, cutoff: float, single: bool = False) -> Scratch:
    """Scratch for `particles` particles; the first use builds the neighbour list. single: pair loops in float32."""
    n = particles
    entries = int(n * max(CAPACITY, 6.0 * (cutoff + 0.5) ** 3))
    integers, floats = workspace(n)
    found, ordered = np.empty(entries, np.int32), np.empty(entries, np.int32)
    return Scratch(
        np.full((n, 3), np.inf), integers, floats, np.zeros(n + 1, np.int32), np.zeros(n + 1, np.int32), found, ordered,
        np.empty(entries + LANES * n, np.int32), np.zeros((7, n), np.float32 if single else np.float64),
        np.zeros((n, 27)), np.zeros((n, 7)), np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n),
    )  # fmt: skip


@_fast
@no_type_check
def refresh_list(c, x, w):
    """Builds the neighbour list anew if somebody moved by half the skin; 1 if it did, negative if it broke."""
    if _moved(x, w.since) <= (0.5 * c.skin) ** 2:
        return 0
    reach = c.cutoff * c.spacing + c.skin
    total = fill_neighbours(x, reach, w.integers, w.floats, w.bare, w.found, w.sorted)
    if total < 0 or total >= w.found.size:
        return BROKEN_LIST
    end = 0
    for i in range(x.shape[0]):
        for k in range(w.bare[i], w.bare[i + 1]):
            w.neighbour[end] = w.sorted[k]
            end += 1
        while end % LANES != 0:
            w.neighbour[end] = i
            end += 1
        w.offset[i + 1] = end
    w.since[:] = x
    return 1


@_fast
@no_type_check
def record_places(x, record):
    """First three rows of the record: places [m], relative to the first particle so that few digits suffice."""
    for i in range(x.shape[0]):
        for k in range(3):
            record[k, i] = x[i, k] - x[0, k]


@_vector
@no_type_check
def pair_forces(c, table, x, v, s, w):
    """First pass over the neighbours: per particle in w.sums the pressure sum [Pa/m] (0-2), friction [N] (3-5) and
    half the heat of its pairs [W] (6)."""
    record = w.record
    record_places(x, record)
    r0, r1, r2, r3, r4, r5, r6 = record[0], record[1], record[2], record[3], record[4], record[5], record[6]
    for i in range(x.shape[0]):
        r3[i], r4[i], r5[i] = v[i, 0], v[i, 1], v[i, 2]
        r6[i] = c.stiffness * s[i]
    number = record.dtype.type
    zero, one, half = number(0.0), number(1.0), number(0.5)
    inverse, unit = number(1.0 / (c.cutoff * c.spacing)), number(1.0 / (c.spacing * c.spacing))
    viscous, shock = number(10.0 * c.viscosity * c.spacing), number(3.0 * c.density * c.spacing)
    softening = number(0.0025 * (c.cutoff * c.spacing) ** 2)
    p0, p1, p2, p3 = number(table[0, 0]), number(table[0, 1]), number(table[0, 2]), number(table[0, 3])
    n0, n1, n2, n3 = number(table[1, 0]), number(table[1, 1]), number(table[1, 2]), number(table[1, 3])
    i0, i1, i2, i3 = number(table[2, 0]), number(table[2, 1]), number(table[2, 2]), number(table[2, 3])
    q0, q1, q2, q3 = number(table[3, 0]), number(table[3, 1]), number(table[3, 2]), number(table[3, 3])
    neighbour = w.neighbour
    for i in range(x.shape[0]):
        xi, yi, zi, ui, vi, wi, pi = r0[i], r1[i], r2[i], r3[i], r4[i], r5[i], r6[i]
        px, py, pz, fx, fy, fz, heat = zero, zero, zero, zero, zero, zero, zero
        for k in range(w.offset[i], w.offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = xi - r0[j], yi - r1[j], zi - r2[j]
            square = dx * dx + dy * dy + dz * dz
            t = math.sqrt(square) * inverse
            slope = max(one - t, zero)
            slope = slope * slope * slope
            f = slope * (p0 + t * (p1 + t * (p2 + t * p3))) * unit
            du, dv, dw = ui - r3[j], vi - r4[j], wi - r5[j]
            along = du * dx + dv * dy + dw * dz
            normal = viscous * (n0 + t * (n1 + t * (n2 + t * n3)))
            steep = shock * (q0 + t * (q1 + t * (q2 + t * q3))) * max(-along, zero)
            strength = slope * (normal + steep) / (square + softening) * along
            isotropic = slope * viscous * (i0 + t * (i1 + t * (i2 + t * i3)))
            f *= pi + r6[j]
            px += f * dx
            py += f * dy
            pz += f * dz
            fx -= strength * dx + isotropic * du
            fy -= strength * dy + isotropic * dv
            fz -= strength * dz + isotropic * dw
            heat += strength * along + isotropic * (du * du + dv * dv + dw * dw)
        row = w.sums[i]
        row[0], row[1], row[2], row[3], row[4], row[5], row[6] = px, py, pz, fx, fy, fz, half * heat


@_fast
@no_type_check
def settle_heat(v, w):
    """Makes the heat of friction what the motion loses, to the rounding of double precision: a common factor near
    one takes up the rounding of the pair loop."""
    lost, heat = 0.0, 0.0
    for i in range(v.shape[0]):
        row = w.sums[i]
        lost -= v[i, 0] * row[3] + v[i, 1] * row[4] + v[i, 2] * row[5]
        heat += row[6]
    if heat > 0.0 and abs(lost - heat) < 0.01 * heat:
        factor = lost / heat
        for i in range(v.shape[0]):
            w.sums[i, 6] *= factor


@_vector
@no_type_check
def divergence(c, table, s, w):
    """Second pass: w.rate [1/s] = sum_j (u_i - u_j) . a_ij + u_i . b_i with u = w.wide, at the places of the first,
    and the diffusion of the strain beyond that of rest: w.spread [1/s] and half of sum_j (s_j - s_i)^2 w.blend."""
    r0, r1, r2, r3, r4, r5 = w.record[0], w.record[1], w.record[2], w.record[3], w.record[4], w.record[5]
    r6 = w.record[6]
    tilt = c.density / c.stiffness
    for i in range(w.rate.shape[0]):
        r3[i], r4[i], r5[i] = w.wide[i, 0], w.wide[i, 1], w.wide[i, 2]
        r6[i] = s[i] - tilt * (c.gravity[0] * r0[i] + c.gravity[1] * r1[i] + c.gravity[2] * r2[i])
    number = w.record.dtype.type
    zero, one = number(0.0), number(1.0)
    inverse = number(1.0 / (c.cutoff * c.spacing))
    unit = 1.0 / (c.spacing * c.spacing)
    p0, p1, p2, p3 = (
        number(unit * table[0, 0]), number(unit * table[0, 1]), number(unit * table[0, 2]), number(unit * table[0, 3])
    )  # fmt: skip
    fast = DIFFUSION * c.cutoff * math.sqrt(c.stiffness / c.density) / c.spacing
    d0, d1, d2, d3 = (
        number(fast * table[4, 0]), number(fast * table[4, 1]), number(fast * table[4, 2]), number(fast * table[4, 3])
    )  # fmt: skip
    neighbour = w.neighbour
    for i in range(w.rate.shape[0]):
        xi, yi, zi, ui, vi, wi, si = r0[i], r1[i], r2[i], r3[i], r4[i], r5[i], r6[i]
        flow, spread, blend = zero, zero, zero
        for k in range(w.offset[i], w.offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = xi - r0[j], yi - r1[j], zi - r2[j]
            t = math.sqrt(dx * dx + dy * dy + dz * dz) * inverse
            slope = max(one - t, zero)
            along = (ui - r3[j]) * dx + (vi - r4[j]) * dy + (wi - r5[j]) * dz
            slope = slope * slope * slope
            flow += slope * (p0 + t * (p1 + t * (p2 + t * p3))) * along
            gap = r6[j] - si
            wide = slope * (d0 + t * (d1 + t * (d2 + t * d3))) * gap
            spread += wide
            blend += wide * gap
        row = w.wall[i]
        w.spread[i], w.blend[i] = spread, 0.5 * blend
        w.rate[i] = flow + w.wide[i, 0] * row[4] + w.wide[i, 1] * row[5] + w.wide[i, 2] * row[6]


@_vector
@no_type_check
def pressure_sums(c, table, p, w, out):
    """out [n, 3] = sum_j (p_i + p_j) a_ij [Pa/m] at the places of the last pair pass."""
    r0, r1, r2, r6, neighbour = w.record[0], w.record[1], w.record[2], w.record[6], w.neighbour
    for i in range(p.shape[0]):
        r6[i] = p[i]
    number = w.record.dtype.type
    zero, one = number(0.0), number(1.0)
    inverse = number(1.0 / (c.cutoff * c.spacing))
    unit = 1.0 / (c.spacing * c.spacing)
    p0, p1, p2, p3 = (
        number(unit * table[0, 0]), number(unit * table[0, 1]), number(unit * table[0, 2]), number(unit * table[0, 3])
    )  # fmt: skip
    for i in range(p.shape[0]):
        xi, yi, zi, pi = r0[i], r1[i], r2[i], r6[i]
        a, b, d = zero, zero, zero
        for k in range(w.offset[i], w.offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = xi - r0[j], yi - r1[j], zi - r2[j]
            t = math.sqrt(dx * dx + dy * dy + dz * dz) * inverse
            slope = max(one - t, zero)
            f = slope * slope * slope * (p0 + t * (p1 + t * (p2 + t * p3))) * (pi + r6[j])
            a += f * dx
            b += f * dy
            d += f * dz
        out[i, 0], out[i, 1], out[i, 2] = a, b, d
