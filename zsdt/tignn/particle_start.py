"""Hidden strain of the particles at the first frame: the pressure that keeps an incompressible liquid together.

Positions and velocities are observed, the pressure is not. It is found as the one under which the divergence of the
velocities stays as it is, `D (g + friction + V/m D* p) + (dD/dt) v = 0`, by conjugate gradients with the engine's own
adjoint pair `D`, `D*` (so the matrix is symmetric and positive semi-definite).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from zsdt.tignn.particle_kernel import sense_walls, widen
from zsdt.tignn.particle_pairs import divergence, pair_forces, pressure_sums, refresh_list
from zsdt.tignn.particle_walls import _fast

LOOK_AHEAD = 0.1  # spacings that sound runs: how far the particles move on for the rate of change of their divergence


@_fast
@no_type_check
def pressure_accelerations(c, table, p, w, out):
    """out [n, 3] m/s2 of pressures p [n] Pa."""
    pressure_sums(c, table, p, w, out)
    for i in range(p.shape[0]):
        row = w.wall[i]
        widen(row, out[i, 0] + p[i] * row[4], out[i, 1] + p[i] * row[5], out[i, 2] + p[i] * row[6], out[i])
        for m in range(3):
            out[i, m] *= c.volume / c.mass


@_fast
@no_type_check
def divergence_of(c, table, field, w, out):
    """out [n] = D of a vector field [n, 3]; uses w.wide and w.rate."""
    for i in range(field.shape[0]):
        widen(w.wall[i], field[i, 0], field[i, 1], field[i, 2], w.wide[i])
    divergence(c, table, w.rate, w)
    out[:] = w.rate


@_fast
@no_type_check
def balance(c, walls, pair_table, wall_table, x, v, load, w, p, iterations, tolerance):
    """Pressures p [n] Pa that balance gravity, friction and `load` [n, 3] N in the present positions and velocities.

    Starts from the given p. Returns the residual over the right-hand side, or -1 for a broken neighbour list.
    """
    n = x.shape[0]
    if refresh_list(c, x, w) < 0:
        return -1.0
    field, back, ahead = np.empty((n, 3)), np.empty(n), np.empty(n)
    span = LOOK_AHEAD * c.spacing / math.sqrt(c.stiffness / c.density)
    shifted = x + span * v
    sense_walls(c, walls, wall_table, shifted, w)
    pair_forces(c, pair_table, shifted, v, np.zeros(n), w)
    divergence_of(c, pair_table, v, w, ahead)
    sense_walls(c, walls, wall_table, x, w)
    pair_forces(c, pair_table, x, v, np.zeros(n), w)
    divergence_of(c, pair_table, v, w, back)
    ahead = (ahead - back) / span
    for i in range(n):
        for m in range(3):
            field[i, m] = c.gravity[m] + (load[i, m] + w.sums[i, 3 + m]) / c.mass
            for k in range(3):
                field[i, m] -= w.wall[i, 8 + (k if k == m else k + m + 2)] * v[i, k] / c.mass
            if w.wall[i, 0] < c.cutoff * c.spacing:
                for k in range(3):
                    field[i, m] -= c.lift * w.wall[i, 14 + 3 * k + m] * (c.gravity[k] + load[i, k] / c.mass)
    divergence_of(c, pair_table, field, w, back)
    # V/m D D* p = -D field - (dD/dt) v
    right = -back - ahead
    pressure_accelerations(c, pair_table, p, w, field)
    divergence_of(c, pair_table, field, w, back)
    residual = right - back
    direction = residual.copy()
    size = np.dot(residual, residual)
    start = np.dot(right, right) + 1e-300
    for _ in range(iterations):
        if size <= tolerance * tolerance * start:
            break
        pressure_accelerations(c, pair_table, direction, w, field)
        divergence_of(c, pair_table, field, w, back)
        step = size / np.dot(direction, back)
        p += step * direction
        residual -= step * back
        new = np.dot(residual, residual)
        direction = residual + new / size * direction
        size = new
    return np.sqrt(size / start)
