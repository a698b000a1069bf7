"""Compiled loops of the SPH solver: pair sums, what the wall adds, kick and drift (DESIGN 3.2).

Particles are columns of a record: position 0:3, velocity 3:6, projected velocity K v 6:9, density 9, pressure 10,
volume 11. Pair sums have the columns pressure force 0:3 [N], friction 3:6 [N], divergence 6 [1/s], diffusion of
density 7, heat 8 [W], filled share 9 (3 in the bulk).

Near a wall `K = (I - n n') / max(gamma, 1/2.2) + n n'`, n the direction of grad gamma. Pressure force
`-V_i K_i [sum (p_i + p_j) A_ij - 2 p_i grad gamma_i]` and divergence `sum (K_i v_i - K_j v_j).A_ij - 2 K_i v_i.grad
gamma_i` with `A_ij = V_j grad W_ij` are exact adjoints: what the pressure takes from the motion is what it stores.
"""

from __future__ import annotations

import math
from typing import Any, no_type_check

import numpy as np
from numba import njit

from zsdt.fluid.distance_grid import table_distance
from zsdt.fluid.kernel import slope_factor
from zsdt.fluid.wall_tables import COLUMNS, GAMMA, GRADIENT, LIFT, SHEAR, SHEAR_DEPTH, table_lift_slope, table_row

# Sums over pairs may be reordered, which is what makes them fast. Nothing else may: the compiler keeps a copy of a
# called function in every caller, copies that may be reordered give other last digits than each other, and then a run
# would depend on what was compiled before it.
_reordering: Any = njit(cache=True, fastmath=True, error_model="numpy")
_jit: Any = njit(cache=True, error_model="numpy")

RECORD, SUMS, WALL = 12, 10, 4 + COLUMNS + 9
_SLOPE = 4 + COLUMNS
# columns of the rates [W] that the ledger integrates; INERTIAL without the work of the vessel's straight acceleration
HEAT, APPROACH, DIFFUSION, WALL_WORK, INERTIAL, RATES = 0, 1, 2, 3, 4, 5
_GAMMA_MIN = 1.0 / 2.2
_IMPULSE_MAX = 0.3
_SPRAY = 1.35  # filled share below which a particle is spray


@_jit
@no_type_check
def fill_records(x, v, density, mass, liquid, h, distances, dlow, dinverse, table, low, inverse, record, wall):
    """Records of all particles; rows of `wall`: distance, normal, table's columns, slope of the lift."""
    rest, sound = liquid[0], liquid[1]
    for i in range(x.shape[0]):
        rho = density[i]
        for d in range(3):
            record[d, i] = x[i, d]
            record[3 + d, i] = v[i, d]
            record[6 + d, i] = v[i, d]
        record[9, i] = rho
        record[10, i] = rest * sound * sound * (1.0 - rest / rho)
        record[11, i] = mass[i] / rho
        w = wall[i]
        w[0], w[1], w[2], w[3] = table_distance(distances, dlow, dinverse, x[i, 0], x[i, 1], x[i, 2])
        w[4 + GAMMA] = 1.0
        if w[0] < 2.0 * h:
            table_row(table, low, inverse, x[i, 0], x[i, 1], x[i, 2], w[4:])
            table_lift_slope(table, low, inverse, x[i, 0], x[i, 1], x[i, 2], w[_SLOPE:])
            g0, g1, g2 = w[4 + GRADIENT], w[5 + GRADIENT], w[6 + GRADIENT]
            square = g0 * g0 + g1 * g1 + g2 * g2 + 1e-30
            stretch = 1.0 / max(w[4 + GAMMA], _GAMMA_MIN)
            normal = (1.0 - stretch) * (v[i, 0] * g0 + v[i, 1] * g1 + v[i, 2] * g2) / square
            record[6, i] = stretch * v[i, 0] + normal * g0
            record[7, i] = stretch * v[i, 1] + normal * g1
            record[8, i] = stretch * v[i, 2] + normal * g2


@_reordering
@no_type_check
def sum_pairs(offset, neighbour, record, h, liquid, diffusion_gradient, approach, sums):
    """Fills `sums` over all neighbours nearer than 2 h; returns the heat of approaching pairs alone [W].

    diffusion_gradient [3]: gradient of density of the liquid at rest, to which the delta term relaxes. Every pair is
    met from both sides: without scattered writes and branches the loop runs in vector registers.
    """
    rest, sound, viscosity = liquid[0], liquid[1], liquid[2]
    factor, softening, half = slope_factor(h), 0.01 * h * h, 0.5 / h
    slope, impedance, friction = approach / sound, rest * sound, 10.0 * viscosity
    e0, e1, e2 = diffusion_gradient[0], diffusion_gradient[1], diffusion_gradient[2]
    xs, ys, zs, us, vs, ws = record[0], record[1], record[2], record[3], record[4], record[5]
    kus, kvs, kws, densities, pressures, volumes = record[6], record[7], record[8], record[9], record[10], record[11]
    approach_heat = 0.0
    for i in range(xs.size):
        x, y, z, u, v, w = xs[i], ys[i], zs[i], us[i], vs[i], ws[i]
        ku, kv, kw, density, pressure, volume = kus[i], kvs[i], kws[i], densities[i], pressures[i], volumes[i]
        px, py, pz, fx, fy, fz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        divergence, diffusion, heat, impact, filled = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            dx, dy, dz = x - xs[j], y - ys[j], z - zs[j]
            square = dx * dx + dy * dy + dz * dz
            r = math.sqrt(square)
            t = max(1.0 - half * r, 0.0)
            f = factor * t * t * t * volumes[j]
            divergence += ((ku - kus[j]) * dx + (kv - kvs[j]) * dy + (kw - kws[j]) * dz) * f
            diffusion -= (densities[j] - density + e0 * dx + e1 * dy + e2 * dz) * f
            filled -= square * f
            push = -(pressure + pressures[j]) * f
            closing = (u - us[j]) * dx + (v - vs[j]) * dy + (w - ws[j]) * dz
            speed = max(-closing / (r + 1e-12), 0.0)
            impulse = -min(slope * speed, _IMPULSE_MAX) * impedance * speed * f
            drag = friction * closing / (square + softening) * f + impulse
            impact -= impulse * closing
            heat -= drag * closing
            px += push * dx
            py += push * dy
            pz += push * dz
            fx += drag * dx
            fy += drag * dy
            fz += drag * dz
        s = sums[i]
        s[0], s[1], s[2] = px * volume, py * volume, pz * volume
        s[3], s[4], s[5] = fx * volume, fy * volume, fz * volume
        s[6], s[7], s[8], s[9] = divergence, diffusion, 0.5 * heat * volume, filled
        approach_heat += 0.5 * impact * volume
    return approach_heat


@_jit
@no_type_check
def _wall_friction(w, shear, depth, v, force):
    """force = -(B shear + B1 depth) v."""
    for a in range(3):
        force[a] = 0.0
        for b in range(3):
            c = a if a == b else a + b + 2
            force[a] -= (w[4 + SHEAR + c] * shear + w[4 + SHEAR_DEPTH + c] * depth) * v[b]


@_jit
@no_type_check
def _add_wall(record, w, s, mass, liquid, wall_options, field, force, stored):
    """Adds what the wall does to one particle; returns the heat of its impact [W].

    Sums `s` become totals, `force` [3] becomes friction and impulse, `stored` [3] the barrier and the lift, which have
    a potential [N].
    """
    v, kv = record[3:6], record[6:9]
    pressure, volume = record[10], record[11]
    rest, sound, viscosity = liquid[0], liquid[1], liquid[2]
    approach, depth_min, barrier, barrier_depth, lift = wall_options
    gradient = w[4 + GRADIENT : 7 + GRADIENT]
    along, square, toward = 0.0, 1e-30, 0.0
    for d in range(3):
        s[6] -= 2.0 * kv[d] * gradient[d]
        s[d] += 2.0 * pressure * volume * gradient[d]
        along += s[d] * gradient[d]
        toward += v[d] * gradient[d]
        square += gradient[d] * gradient[d]
    stretch = 1.0 / max(w[4 + GAMMA], _GAMMA_MIN)
    for d in range(3):
        s[d] = stretch * s[d] + (1.0 - stretch) * along / square * gradient[d]
    _wall_friction(w, viscosity * volume, viscosity * volume / max(w[0], depth_min), v, force)
    for d in range(3):
        s[8] -= force[d] * v[d]
    closing = max(-toward / math.sqrt(square), 0.0)
    impulse = 2.0 * closing * rest * sound * min(2.0 * approach * closing / sound, _IMPULSE_MAX) * volume
    s[8] -= impulse * toward
    push = 0.0
    if w[0] < barrier_depth:
        push = mass * barrier * barrier / barrier_depth * (1.0 - w[0] / barrier_depth)
    for a in range(3):
        force[a] += impulse * gradient[a]
        stored[a] = push * w[1 + a]
        for b in range(3):
            stored[a] -= lift * mass * w[_SLOPE + 3 * b + a] * field[b]
    return -impulse * toward


@_jit
@no_type_check
def finish(record, wall, sums, mass, h, liquid, diffusion, wall_options, gravity, frame, acceleration, inner, rate,
           warming, rates, moment):  # fmt: skip
    """Accelerations [m/s2], rates of density [kg/m3/s] and of internal energy [W/kg]; what the ledger integrates.

    inner [particles, 3]: the part of the accelerations by which motion becomes internal energy (pressure, friction).

    frame [9]: acceleration of the vessel, its angular velocity and angular acceleration. rates: columns of the module
    [W]; moment [3]: sum of m (x - q) [kg m], whose product with gravity is minus the potential energy.
    """
    force, stored, field, inertia = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for d in range(3):
        field[d] = gravity[d] - frame[d]
    o0, o1, o2 = frame[3], frame[4], frame[5]
    c0, c1, c2 = frame[6], frame[7], frame[8]
    lift = wall_options[4]
    rates[DIFFUSION] = rates[WALL_WORK] = rates[INERTIAL] = rates[HEAT] = 0.0
    moment[:] = 0.0
    for i in range(mass.size):
        r, s, w, m = record[:, i], sums[i], wall[i], mass[i]
        force[:] = 0.0
        stored[:] = 0.0
        for d in range(3):
            moment[d] += m * r[d]
        # -a - angular acceleration x r - omega x (omega x r); Coriolis does no work and is added below
        swing = o0 * r[0] + o1 * r[1] + o2 * r[2]
        spin = o0 * o0 + o1 * o1 + o2 * o2
        inertia[0] = -frame[0] - (c1 * r[2] - c2 * r[1]) - (o0 * swing - spin * r[0])
        inertia[1] = -frame[1] - (c2 * r[0] - c0 * r[2]) - (o1 * swing - spin * r[1])
        inertia[2] = -frame[2] - (c0 * r[1] - c1 * r[0]) - (o2 * swing - spin * r[2])
        for d in range(3):
            rates[INERTIAL] += m * (inertia[d] + frame[d]) * r[3 + d]  # the solver books the straight part
        if w[0] < 2.0 * h:
            rates[APPROACH] += _add_wall(r, w, s, m, liquid, wall_options, field, force, stored)
            for a in range(3):
                moment[a] -= lift * m * w[4 + LIFT + a]
                for b in range(3):
                    rates[INERTIAL] += lift * m * w[_SLOPE + 3 * b + a] * frame[b] * r[3 + a]
        inertia[0] -= 2.0 * (o1 * r[5] - o2 * r[4])
        inertia[1] -= 2.0 * (o2 * r[3] - o0 * r[5])
        inertia[2] -= 2.0 * (o0 * r[4] - o1 * r[3])
        work = r[10] * r[11] * s[6]
        rates[WALL_WORK] += work
        for d in range(3):
            rates[WALL_WORK] += s[d] * r[3 + d]
            inner[i, d] = (s[d] + s[3 + d] + force[d]) / m
            acceleration[i, d] = inner[i, d] + stored[d] / m + gravity[d] + inertia[d]
        rates[HEAT] += s[8]
        rates[DIFFUSION] += r[10] * r[11] / r[9] * diffusion * s[7]
        rate[i] = r[9] * s[6] + diffusion * s[7]
        warming[i] = (work + s[8]) / m


@_jit
@no_type_check
def kick_drift(dt, x, v, density, energy, acceleration, inner, rate, warming, ahead_v, ahead_density, wall, mass, near,
               guard, rim, distances, dlow, dinverse, counts):  # fmt: skip
    """First half kick and drift by dt; predicted velocity and density for the forces; the guard at the wall.

    `warming` belongs to the velocities `ahead_v` predicted in the step before, but over a half kick the force takes
    from the motion what it does along the mean of the velocities before and after: the difference is added, so that no
    energy is lost. A particle nearer to the wall than `guard` [m] is put back to that distance and its motion into the
    wall becomes heat: counts[0] += 1, counts[1] += joules.
    """
    for i in range(x.shape[0]):
        ahead_density[i] = density[i] + dt * rate[i]
        density[i] += 0.5 * dt * rate[i]
        warm = warming[i]
        for d in range(3):
            warm -= inner[i, d] * (v[i, d] + 0.25 * dt * acceleration[i, d] - ahead_v[i, d])
            ahead_v[i, d] = v[i, d] + dt * acceleration[i, d]
            v[i, d] += 0.5 * dt * acceleration[i, d]
            x[i, d] += dt * v[i, d]
        energy[i] += 0.5 * dt * warm
        if wall[i, 0] < near and x[i, 2] < rim:
            depth, n0, n1, n2 = table_distance(distances, dlow, dinverse, x[i, 0], x[i, 1], x[i, 2])
            if depth < guard:
                shift = guard - depth
                x[i, 0] += shift * n0
                x[i, 1] += shift * n1
                x[i, 2] += shift * n2
                counts[0] += 1.0
                into = -(v[i, 0] * n0 + v[i, 1] * n1 + v[i, 2] * n2)
                if into > 0.0:
                    counts[1] += 0.5 * mass[i] * into * into
                    energy[i] += 0.5 * into * into
                    v[i, 0] += into * n0
                    v[i, 1] += into * n1
                    v[i, 2] += into * n2
                into = -(ahead_v[i, 0] * n0 + ahead_v[i, 1] * n1 + ahead_v[i, 2] * n2)
                if into > 0.0:
                    ahead_v[i, 0] += into * n0
                    ahead_v[i, 1] += into * n1
                    ahead_v[i, 2] += into * n2


@_jit
@no_type_check
def kick(dt, v, density, energy, acceleration, inner, rate, warming, ahead_v, sums, mass, liquid, low, high, counts):
    """Second half kick (see `kick_drift`); densities out of range and those of spray are clipped: counts[2] += 1,
    counts[3] += joules."""
    rest, sound = liquid[0], liquid[1]
    for i in range(v.shape[0]):
        density[i] += 0.5 * dt * rate[i]
        warm = warming[i]
        for d in range(3):
            warm -= inner[i, d] * (v[i, d] + 0.25 * dt * acceleration[i, d] - ahead_v[i, d])
            v[i, d] += 0.5 * dt * acceleration[i, d]
        energy[i] += 0.5 * dt * warm
        floor = rest if sums[i, 9] < _SPRAY else low * rest  # spray keeps no memory of tension
        kept = min(max(density[i], floor), high * rest)
        if kept != density[i]:
            before, after = 1.0 - rest / density[i], 1.0 - rest / kept
            counts[2] += 1.0
            counts[3] += 0.5 * mass[i] * sound * sound * (after * after - before * before)
            density[i] = kept
