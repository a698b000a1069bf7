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
from typing import no_type_check

import numba as nb
import numpy as np

from zsdt.fluid.wall_tables import COLUMNS, GAMMA, GRADIENT, LIFT, SHEAR, SHEAR_DEPTH, table_row
from zsdt.tignn.particle_pairs import BROKEN_LIST, divergence, pair_forces, refresh_list, settle_heat
from zsdt.tignn.particle_profiles import ROWS
from zsdt.tignn.particle_walls import _fast, side_distance

ACCOUNT = ("gained", "work_load", "guarded", "builds", "work_diffusion")
LEAST_DISTANCE = 0.25  # in spacings: closer to a wall than this, friction grows no more (DESIGN 3.2)
LEAST_SHARE = 1 / 2.2  # of the kernel's support that counts as liquid, however near the wall


# A whole frame runs without the interpreter's lock: the twin segments the next picture meanwhile.
_frame = nb.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False, nogil=True)


@_fast
@no_type_check
def look_up(table, low, inverse, x, y, z, found, slope):
    """`table_row` and `table_lift_slope` at a point in one go: found [COLUMNS], slope [9]."""
    fx, fy, fz = (x - low[0]) * inverse, (y - low[1]) * inverse, (z - low[2]) * inverse
    a = min(max(int(fx), 0), table.shape[0] - 2)
    b = min(max(int(fy), 0), table.shape[1] - 2)
    c = min(max(int(fz), 0), table.shape[2] - 2)
    fx, fy, fz = min(max(fx - a, 0.0), 1.0), min(max(fy - b, 0.0), 1.0), min(max(fz - c, 0.0), 1.0)
    gx, gy, gz = 1.0 - fx, 1.0 - fy, 1.0 - fz
    w0, w1, w2, w3 = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
    w4, w5, w6, w7 = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz
    for k in range(COLUMNS):
        found[k] = (
            w0 * table[a, b, c, k] + w1 * table[a, b, c + 1, k]
            + w2 * table[a, b + 1, c, k] + w3 * table[a, b + 1, c + 1, k]
            + w4 * table[a + 1, b, c, k] + w5 * table[a + 1, b, c + 1, k]
            + w6 * table[a + 1, b + 1, c, k] + w7 * table[a + 1, b + 1, c + 1, k]
        )  # fmt: skip
    for n in range(3):
        k = LIFT + n
        low_low = gz * table[a, b, c, k] + fz * table[a, b, c + 1, k]
        low_high = gz * table[a, b + 1, c, k] + fz * table[a, b + 1, c + 1, k]
        high_low = gz * table[a + 1, b, c, k] + fz * table[a + 1, b, c + 1, k]
        high_high = gz * table[a + 1, b + 1, c, k] + fz * table[a + 1, b + 1, c + 1, k]
        below = gx * (gy * table[a, b, c, k] + fy * table[a, b + 1, c, k])
        below += fx * (gy * table[a + 1, b, c, k] + fy * table[a + 1, b + 1, c, k])
        above = gx * (gy * table[a, b, c + 1, k] + fy * table[a, b + 1, c + 1, k])
        above += fx * (gy * table[a + 1, b, c + 1, k] + fy * table[a + 1, b + 1, c + 1, k])
        slope[3 * n] = inverse * (gy * (high_low - low_low) + fy * (high_high - low_high))
        slope[3 * n + 1] = inverse * (gx * (low_high - low_low) + fx * (high_high - high_low))
        slope[3 * n + 2] = inverse * (above - below)


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
        look_up(walls.rows, walls.low, walls.inverse, x[i, 0], x[i, 1], x[i, 2], found, row[14:23])
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
        settle_heat(v, w)
        kick(c, x, v, s, heat, load, load_next, (step + 0.5) / steps, dt, w, account)
        divergence(c, pair_table, s, w)
        drift(c, walls, x, v, s, heat, dt, w, account)
    return 0
