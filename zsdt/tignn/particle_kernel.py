"""The sub-step loop of the particle engine in one compiled kernel: particle -> pair -> particle, twice a sub-step.

State of a particle: position, velocity, strain s (1 - volume over its volume at rest; pressure p = rho0 c^2 s, the
linear Us-Up law of `Liquid`), heat [J]. With the profiles of `particle_profiles`, spacing D, volume V = D^3, unit
vector n from j to i, and the widened velocity u = K v near walls, one sub-step of length dt is

    friction (M):   m dv_i = -dt D sum_j [c_n (v_ij . n) n + c_t v_ij],  c_n, c_t >= 0; its heat is what kinetic
                    energy loses, to rounding: -J . v_ij / 2 to each side, less |P_i|^2 / 2m to i
    walls (M):      m dv_i = -dt C_i v_i, implicitly, C_i the no-slip tensor of the wall; the loss is heat
    pressure (L):   m dv_i = dt V K (sum_j (p_i + p_j) a_ij + p_i b_i),   a_ij = f(r) n / D
    weight, load:   m dv_i = dt (m (I - H) g - grad(barrier) + load), H the lift at walls (`WallTables`)
    strain (L):     ds_i = -dt (sum_j (u_i - u_j) . a_ij + u_i . b_i), the exact adjoint of the pressure
    position:       dx = dt v

(symplectic Euler). `gained` sums what conservative forces give to kinetic energy and to compression: with the
energies of position it would vanish but for terms of order dt^2, so the account closes to rounding. A particle nearer
than `guard` to a wall is put back and loses its normal velocity.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import numba as nb
import numpy as np

from zsdt.fluid.wall_tables import COLUMNS, GAMMA, GRADIENT, LIFT, SHEAR, SHEAR_DEPTH, table_lift_slope, table_row
from zsdt.radius_graph import _moved, fill_neighbours, workspace
from zsdt.tignn.particle_profiles import ROWS
from zsdt.tignn.particle_walls import _fast, side_distance

ACCOUNT = ("gained", "work_load", "guarded", "builds", "work_diffusion")
DIFFUSION = 0.1  # of the strain, over support times speed of sound (delta-SPH: 2 delta h c)
CAPACITY = 64  # neighbours per particle that the lists hold at first; a fuller list is refused
BROKEN_LIST = -1
LEAST_DISTANCE = 0.25  # in spacings: closer to a wall than this, friction grows no more (DESIGN 3.2)
LEAST_SHARE = 1 / 2.2  # of the kernel's support that counts as liquid, however near the wall


_vector = nb.njit(cache=True, fastmath=True, error_model="numpy", boundscheck=False)
# A whole frame runs without the interpreter's lock: the twin segments the next picture meanwhile.
_frame = nb.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False, nogil=True)


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
    """Work arrays of the kernel for n particles; nothing in it is state (the list is valid while nobody strays)."""

    since: Any
    integers: Any
    floats: Any
    offset: Any
    found: Any
    neighbour: Any
    record: Any
    wall: Any
    sums: Any
    wide: Any
    rate: Any
    spread: Any
    blend: Any


def new_scratch(particles: int, cutoff: float) -> Scratch:
    """Scratch for `particles` particles; the first use builds the neighbour list."""
    entries = int(particles * max(CAPACITY, 6.0 * (cutoff + 0.5) ** 3))
    integers, floats = workspace(particles)
    n = particles
    return Scratch(
        np.full((n, 3), np.inf), integers, floats, np.zeros(n + 1, np.int32), np.empty(entries, np.int32),
        np.empty(entries, np.int32), np.zeros((7, n)), np.zeros((n, 27)), np.zeros((n, 7)),
        np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n),
    )  # fmt: skip


@_fast
@no_type_check
def refresh_list(c, x, w):
    """Builds the neighbour list anew if somebody moved by half the skin; 1 if it did, negative if it broke."""
    if _moved(x, w.since) <= (0.5 * c.skin) ** 2:
        return 0
    reach = c.cutoff * c.spacing + c.skin
    total = fill_neighbours(x, reach, w.integers, w.floats, w.offset, w.found, w.neighbour)
    if total < 0 or total >= w.found.size:
        return BROKEN_LIST
    w.since[:] = x
    return 1


@_fast
@no_type_check
def sense_walls(c, walls, table, x, w):
    """What the walls do to each particle; row of w.wall: 0 distance from the nearer wall, 1-3 direction of grad gamma,
    4-6 b = 2 grad gamma [1/m], 7 widening, 8-13 friction [kg/s], 14-22 lift slope [-], 23-26 side distance, normal."""
    side, found = np.empty(4), np.empty(COLUMNS)
    scale = ROWS / (c.cutoff * c.spacing)
    for i in range(x.shape[0]):
        side_distance(walls, x[i, 0], x[i, 1], x[i, 2], side)
        row = w.wall[i]
        row[23], row[24], row[25], row[26] = side[0], side[1], side[2], side[3]
        row[0] = min(side[0], x[i, 2])
        row[1:23] = 0.0
        row[7] = 1.0
        t = max(row[0], 0.0) * scale
        if t >= ROWS:
            continue
        table_row(walls.rows, walls.low, walls.inverse, x[i, 0], x[i, 1], x[i, 2], found)
        a = int(t)
        t -= a
        pressure = 2.0 * (table[a, 0] + (table[a + 1, 0] - table[a, 0]) * t)
        friction = c.viscosity * c.volume * (table[a, 1] + (table[a + 1, 1] - table[a, 1]) * t)
        widening = table[a, 2] + (table[a + 1, 2] - table[a, 2]) * t
        g0, g1, g2 = found[GRADIENT], found[GRADIENT + 1], found[GRADIENT + 2]
        size = 1.0 / (math.sqrt(g0 * g0 + g1 * g1 + g2 * g2) + 1e-30)
        row[1], row[2], row[3] = g0 * size, g1 * size, g2 * size
        row[4], row[5], row[6] = pressure * g0, pressure * g1, pressure * g2
        row[7] = 1.0 + widening * (1.0 / max(found[GAMMA], LEAST_SHARE) - 1.0)
        depth = 1.0 / max(row[0], LEAST_DISTANCE * c.spacing)
        for k in range(6):
            row[8 + k] = friction * (found[SHEAR + k] + depth * found[SHEAR_DEPTH + k])
        table_lift_slope(walls.rows, walls.low, walls.inverse, x[i, 0], x[i, 1], x[i, 2], row[14:23])


@_vector
@no_type_check
def pair_forces(c, table, x, v, s, w):
    """First pass over the neighbours: per particle in w.sums the pressure sum [Pa/m] (0-2), friction [N] (3-5) and
    half the heat of its pairs [W] (6).

    Every pair is met from both sides: without scattered writes and branches the loop runs in vector registers.
    """
    record = w.record
    r0, r1, r2, r3, r4, r5, r6 = record[0], record[1], record[2], record[3], record[4], record[5], record[6]
    for i in range(x.shape[0]):
        r0[i], r1[i], r2[i] = x[i, 0], x[i, 1], x[i, 2]
        r3[i], r4[i], r5[i] = v[i, 0], v[i, 1], v[i, 2]
        r6[i] = c.stiffness * s[i]
    spacing = c.spacing
    inverse = 1.0 / (c.cutoff * spacing)
    unit = 1.0 / (spacing * spacing)
    viscous, shock, softening = 10.0 * c.viscosity * spacing, 3.0 * c.density * spacing, 0.0025 / inverse**2
    p0, p1, p2, p3 = table[0, 0], table[0, 1], table[0, 2], table[0, 3]
    n0, n1, n2, n3 = table[1, 0], table[1, 1], table[1, 2], table[1, 3]
    i0, i1, i2, i3 = table[2, 0], table[2, 1], table[2, 2], table[2, 3]
    q0, q1, q2, q3 = table[3, 0], table[3, 1], table[3, 2], table[3, 3]
    neighbour = w.neighbour
    for i in range(x.shape[0]):
        xi, yi, zi, ui, vi, wi, pi = r0[i], r1[i], r2[i], r3[i], r4[i], r5[i], r6[i]
        px, py, pz, fx, fy, fz, heat = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(w.offset[i], w.offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = xi - r0[j], yi - r1[j], zi - r2[j]
            square = dx * dx + dy * dy + dz * dz
            t = math.sqrt(square) * inverse
            slope = max(1.0 - t, 0.0)
            slope = slope * slope * slope
            f = slope * (p0 + t * (p1 + t * (p2 + t * p3))) * unit
            du, dv, dw = ui - r3[j], vi - r4[j], wi - r5[j]
            along = du * dx + dv * dy + dw * dz
            normal = viscous * (n0 + t * (n1 + t * (n2 + t * n3)))
            steep = shock * (q0 + t * (q1 + t * (q2 + t * q3))) * max(-along, 0.0)
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
        row[0], row[1], row[2], row[3], row[4], row[5], row[6] = px, py, pz, fx, fy, fz, 0.5 * heat


@_fast
@no_type_check
def widen(row, a, b, d, out):
    """out = K (a, b, d), K = widening (I - n n') + n n', which is symmetric."""
    rest = (1.0 - row[7]) * (a * row[1] + b * row[2] + d * row[3])
    out[0], out[1], out[2] = row[7] * a + rest * row[1], row[7] * b + rest * row[2], row[7] * d + rest * row[3]


@_fast
@no_type_check
def stored(c, walls, x):
    """Energies [J] that depend on positions x [n, 3] alone: weight (with the lift at walls), barrier at the walls."""
    side, found = np.empty(4), np.empty(COLUMNS)
    g = c.gravity
    weight, barrier = 0.0, 0.0
    for i in range(x.shape[0]):
        weight -= g[0] * x[i, 0] + g[1] * x[i, 1] + g[2] * x[i, 2]
        side_distance(walls, x[i, 0], x[i, 1], x[i, 2], side)
        if min(side[0], x[i, 2]) < c.cutoff * c.spacing:
            table_row(walls.rows, walls.low, walls.inverse, x[i, 0], x[i, 1], x[i, 2], found)
            for k in range(3):
                weight += c.lift * g[k] * found[LIFT + k]
        barrier += 0.5 * (c.climb * max(1.0 - side[0] / c.reach, 0.0)) ** 2
        barrier += 0.5 * (c.climb * max(1.0 - x[i, 2] / c.reach, 0.0)) ** 2
    return c.mass * weight, c.mass * barrier


@_fast
@no_type_check
def rub(row, share, v):
    """v after the friction of the wall, (I + share C)^-1 v (implicit: stable however thin the layer)."""
    a, b, d = 1.0 + share * row[8], 1.0 + share * row[9], 1.0 + share * row[10]
    e, f, h = share * row[11], share * row[12], share * row[13]
    p, q, r = b * d - h * h, f * h - e * d, e * h - f * b
    inverse = 1.0 / (a * p + e * q + f * r)
    x, y, z = v[0], v[1], v[2]
    s, t, u = a * d - f * f, e * f - a * h, a * b - e * e
    v[0] = inverse * (p * x + q * y + r * z)
    v[1] = inverse * (q * x + s * y + t * z)
    v[2] = inverse * (r * x + t * y + u * z)


@_fast
@no_type_check
def kick(c, x, v, s, heat, load, load_next, share, dt, w, account):
    """Velocities after friction, walls, pressure, weight and load; w.wide = K v. Adds heat and account."""
    g, mass = c.gravity, c.mass
    steep = c.climb * c.climb / c.reach
    out, now, field = np.empty(3), np.empty(3), np.empty(3)
    for i in range(v.shape[0]):
        row, sums = w.wall[i], w.sums[i]
        near = row[0] < c.cutoff * c.spacing
        lost = dt * sums[6] - 0.5 * dt * dt / mass * (sums[3] ** 2 + sums[4] ** 2 + sums[5] ** 2)
        for k in range(3):
            now[k] = v[i, k] + dt / mass * sums[3 + k]
            field[k] = g[k]
        if near:
            before = now[0] ** 2 + now[1] ** 2 + now[2] ** 2
            rub(row, dt / mass, now)
            lost += 0.5 * mass * (before - (now[0] ** 2 + now[1] ** 2 + now[2] ** 2))
            hard = steep * max(1.0 - row[23] / c.reach, 0.0)
            for k in range(3):
                field[k] += hard * row[24 + k]
                for m in range(3):
                    field[k] -= c.lift * row[14 + 3 * m + k] * g[m]
            field[2] += steep * max(1.0 - x[i, 2] / c.reach, 0.0)
        heat[i] += lost
        p = c.stiffness * s[i]
        widen(row, sums[0] + p * row[4], sums[1] + p * row[5], sums[2] + p * row[6], out)
        for k in range(3):
            ext = load[i, k] + share * (load_next[i, k] - load[i, k])
            if near:  # a wall lifts against inertia as it does against gravity
                for m in range(3):
                    ext -= c.lift * row[14 + 3 * m + k] * (load[i, m] + share * (load_next[i, m] - load[i, m]))
            pressed = dt * (c.volume * out[k] + mass * field[k])
            new = now[k] + (pressed + dt * ext) / mass
            middle = 0.5 * (now[k] + new)
            account[0] += pressed * middle
            account[1] += dt * ext * middle
            v[i, k] = new
        widen(row, v[i, 0], v[i, 1], v[i, 2], w.wide[i])


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
    inverse = 1.0 / (c.cutoff * c.spacing)
    unit = 1.0 / (c.spacing * c.spacing)
    p0, p1, p2, p3 = unit * table[0, 0], unit * table[0, 1], unit * table[0, 2], unit * table[0, 3]
    fast = DIFFUSION * c.cutoff * math.sqrt(c.stiffness / c.density) / c.spacing
    d0, d1, d2, d3 = fast * table[4, 0], fast * table[4, 1], fast * table[4, 2], fast * table[4, 3]
    neighbour = w.neighbour
    for i in range(w.rate.shape[0]):
        xi, yi, zi, ui, vi, wi, si = r0[i], r1[i], r2[i], r3[i], r4[i], r5[i], r6[i]
        flow, spread, blend = 0.0, 0.0, 0.0
        for k in range(w.offset[i], w.offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = xi - r0[j], yi - r1[j], zi - r2[j]
            t = math.sqrt(dx * dx + dy * dy + dz * dz) * inverse
            slope = max(1.0 - t, 0.0)
            along = (ui - r3[j]) * dx + (vi - r4[j]) * dy + (wi - r5[j]) * dz
            slope = slope * slope * slope
            flow += slope * (p0 + t * (p1 + t * (p2 + t * p3))) * along
            gap = r6[j] - si
            wide = slope * (d0 + t * (d1 + t * (d2 + t * d3))) * gap
            spread += wide
            blend += wide * gap
        row = w.wall[i]
        w.spread[i], w.blend[i] = spread, 0.5 * blend
        w.rate[i] = flow + ui * row[4] + vi * row[5] + wi * row[6]


@_fast
@no_type_check
def drift(c, walls, x, v, s, heat, dt, w, account):
    """Moves strains and positions on; puts back what came too near a wall."""
    side = np.empty(4)
    for i in range(x.shape[0]):
        unit = c.stiffness * c.volume
        change = -dt * w.rate[i]
        account[0] += unit * change * (s[i] + 0.5 * change)
        s[i] += change
        change = dt * w.spread[i]
        hot = unit * dt * w.blend[i]
        heat[i] += hot
        account[4] += unit * change * (s[i] + 0.5 * change) + hot
        s[i] += change
        step = 0.0
        for k in range(3):
            x[i, k] += dt * v[i, k]
            step += abs(v[i, k])
        if w.wall[i, 0] - dt * step > c.guard:
            continue
        for _ in range(3):  # a corner needs both walls in turn
            side_distance(walls, x[i, 0], x[i, 1], x[i, 2], side)
            if min(side[0], x[i, 2]) >= c.guard:
                break
            if x[i, 2] < side[0]:
                side[0], side[1], side[2], side[3] = x[i, 2], 0.0, 0.0, 1.0
            account[2] += 1.0
            normal = v[i, 0] * side[1] + v[i, 1] * side[2] + v[i, 2] * side[3]
            if normal < 0.0:
                heat[i] += 0.5 * c.mass * normal * normal
            for k in range(3):
                lift = (c.guard * (1.0 + 1e-9) - side[0]) * side[1 + k]
                x[i, k] += lift
                if normal < 0.0:
                    v[i, k] -= normal * side[1 + k]


@_frame
@no_type_check
def advance(c, walls, pair_table, wall_table, x, v, s, heat, load, load_next, steps, dt, w, account):
    """`steps` sub-steps of `dt` [s]; changes x, v [n, 3], s, heat [n] and account [len(ACCOUNT)].

    load -> load_next [n, 3] N linearly over all steps. Gives BROKEN_LIST where positions are no longer finite or a
    particle has far too many neighbours, else 0.
    """
    for step in range(steps):
        built = refresh_list(c, x, w)
        if built < 0:
            return BROKEN_LIST
        account[3] += built
        sense_walls(c, walls, wall_table, x, w)
        pair_forces(c, pair_table, x, v, s, w)
        kick(c, x, v, s, heat, load, load_next, (step + 0.5) / steps, dt, w, account)
        divergence(c, pair_table, s, w)
        drift(c, walls, x, v, s, heat, dt, w, account)
    return 0
