"""How a liquid in a vessel answers a sudden uniform push: the potential flow that walls and a free surface allow.

A push by a uniform impulse e (per mass) raises a pressure impulse P with laplace P = 0 inside, P = 0 at the free
surface and dP/dn = e.n at the wall; the liquid starts with e - grad P (Lamb, Hydrodynamics, art. 11; Cooker and
Peregrine 1995). The answer is linear in e, so three solutions, for x, y and z, hold it for every push: a tensor field
of the geometry alone. With gravity as the push it is the acceleration by which a tilted surface falls back.

On particles P minimises `sum_ij w_ij (P_j - P_i - e.(x_j - x_i))^2`, whose natural condition is the wall's. Where the
neighbourhood of a particle, mirrored at the wall, is not full, the rest of it is air with P = 0: that is the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

from zsdt.radius_graph import RadiusGraph

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

REACH = 2.0  # radius of the neighbourhood in particle spacings
# Sum of the weights (1 - r/R)^2 over a full neighbourhood, the particle itself left out.
FULL = 4.0 * math.pi / 30.0 * REACH**3 - 1.0
UNEVEN = 0.05  # share of a neighbourhood that may be missing without being air: packings are uneven
STIFF = 3.0  # of the air against the edges: the surface gives way less than the liquid
ABOVE = 0.5  # spacings from the uppermost particles to the surface
TOLERANCE, STEPS = 1e-7, 400


@_jit
@no_type_check
def _weigh(offset, neighbour, x, distance, normal, reach, spacing, weight, air, pull):
    """Weights of the edges; air [n]: missing weight of each particle, pull [n, 3] m: its moment, sum of w (x - x_i)."""
    for i in range(x.shape[0]):
        total, mx, my, mz = 0.0, 0.0, 0.0, 0.0
        for k in range(offset[i], offset[i + 1] + 1):
            j = neighbour[k] if k < offset[i + 1] else i  # itself last: it has no weight, but a mirror image
            if k < offset[i + 1]:
                dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
                w = max(1.0 - math.sqrt(dx * dx + dy * dy + dz * dz) / reach, 0.0) ** 2
                weight[k] = w
                total, mx, my, mz = total + w, mx + w * dx, my + w * dy, mz + w * dz
            if distance[j] < reach:
                back = 2.0 * max(distance[j], 0.25 * spacing)
                dx = x[j, 0] - back * normal[j, 0] - x[i, 0]
                dy = x[j, 1] - back * normal[j, 1] - x[i, 1]
                dz = x[j, 2] - back * normal[j, 2] - x[i, 2]
                w = max(1.0 - math.sqrt(dx * dx + dy * dy + dz * dz) / reach, 0.0) ** 2
                total, mx, my, mz = total + w, mx + w * dx, my + w * dy, mz + w * dz
        missing = max(1.0 - total / FULL, 0.0)
        share = min(max((missing - UNEVEN) / UNEVEN, 0.0), 1.0)
        length = math.sqrt(mx * mx + my * my + mz * mz) + 1e-30
        # Beyond an edge of the vessel nothing is mirrored: what is missing towards a wall is no air.
        away = (mx * normal[i, 0] + my * normal[i, 1] + mz * normal[i, 2]) / length
        share *= min(max((distance[i] / spacing - 0.8 * away - 0.2) / 0.4, 0.0), 1.0)
        air[i] = STIFF * share * missing * FULL
        above = ABOVE * spacing * air[i] / length
        pull[i, 0], pull[i, 1], pull[i, 2] = -above * mx, -above * my, -above * mz


@_jit
@no_type_check
def _apply(offset, neighbour, weight, air, p, out):
    """out = A p for the three columns of p [n, 3]."""
    for i in range(p.shape[0]):
        a, b, c = air[i] * p[i, 0], air[i] * p[i, 1], air[i] * p[i, 2]
        for k in range(offset[i], offset[i + 1]):
            j, w = neighbour[k], weight[k]
            a, b, c = a + w * (p[i, 0] - p[j, 0]), b + w * (p[i, 1] - p[j, 1]), c + w * (p[i, 2] - p[j, 2])
        out[i, 0], out[i, 1], out[i, 2] = a, b, c


@_jit
@no_type_check
def _solve(offset, neighbour, weight, air, right, p):
    """Conjugate gradients with the diagonal, the three columns side by side; leaves the solution in p [n, 3]."""
    n = p.shape[0]
    diagonal = np.empty(n)
    for i in range(n):
        diagonal[i] = air[i] + 1e-6
        for k in range(offset[i], offset[i + 1]):
            diagonal[i] += weight[k]
    residual, image = np.empty((n, 3)), np.empty((n, 3))
    _apply(offset, neighbour, weight, air, p, image)
    residual[:] = right - image
    heading = residual / diagonal.reshape(-1, 1)
    size = (residual * heading).sum(0)
    goal = TOLERANCE**2 * (right * (right / diagonal.reshape(-1, 1))).sum(0) + 1e-300
    for _ in range(STEPS):
        if (size <= goal).all():
            break
        _apply(offset, neighbour, weight, air, heading, image)
        stride = size / ((heading * image).sum(0) + 1e-300)
        p += stride * heading
        residual -= stride * image
        fresh = residual / diagonal.reshape(-1, 1)
        now = (residual * fresh).sum(0)
        heading = fresh + now / (size + 1e-300) * heading
        size = now


@_jit
@no_type_check
def _right_sides(offset, neighbour, weight, x, pull, right):
    """right[i] [m]: what a unit push along each axis drives towards particle i."""
    for i in range(x.shape[0]):
        for d in range(3):
            right[i, d] = -pull[i, d]
        for k in range(offset[i], offset[i + 1]):
            for d in range(3):
                right[i, d] -= weight[k] * (x[neighbour[k], d] - x[i, d])


@_jit
@no_type_check
def _slopes(offset, neighbour, weight, x, p, slope):
    """Gradients of the columns of p [n, 3] by least squares: slope [n, 3 of space, 3 of p]."""
    square, mixed = np.empty((3, 3)), np.empty((3, 3))
    r = np.empty(3)
    for i in range(x.shape[0]):
        square[:], mixed[:] = 0.0, 0.0
        for k in range(offset[i], offset[i + 1]):
            j, w = neighbour[k], weight[k]
            for a in range(3):
                r[a] = x[j, a] - x[i, a]
            for a in range(3):
                for b in range(3):
                    square[a, b] += w * r[a] * r[b]
                    mixed[a, b] += w * r[a] * (p[j, b] - p[i, b])
        trace = square[0, 0] + square[1, 1] + square[2, 2]
        for a in range(3):
            square[a, a] += 1e-3 * trace + 1e-30
        slope[i] = np.linalg.solve(square, mixed)


@dataclass(frozen=True)
class Impulse:
    """Answer of a liquid to a unit push along x, y and z.

    response [n, 3, 3]: velocity of a particle [row] to a push along an axis [column], 1 where it moves freely and 0
    where walls hold it; pressure [n, 3] m: P of each push; of the one upwards minus the depth. air [n]: share of a
    particle's neighbourhood that is air, times STIFF.
    """

    response: Float[np.ndarray, "n 3 3"]
    pressure: Float[np.ndarray, "n 3"]
    air: Float[np.ndarray, " n"]


def impulse_of(
    positions: Float[np.ndarray, "n 3"],
    distance: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, "n 3"],
    spacing: float,
) -> Impulse:
    """Impulse response of particles at `positions` [m], `spacing` [m] apart; `distance` [m] to the wall, its normal.

    Raises: RunRejected where a position is not a finite number.
    """
    n, reach = len(positions), REACH * spacing
    built = RadiusGraph(reach)
    built.update(positions)
    lists: tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " directed"]] = (built.offset, built.neighbour)
    x = np.ascontiguousarray(positions, np.float64)
    weight, air = np.empty(len(built.neighbour)), np.empty(n)
    pull, right, p, slope = np.empty((n, 3)), np.empty((n, 3)), np.zeros((n, 3)), np.empty((n, 3, 3))
    _weigh(*lists, x, distance, normal, reach, spacing, weight, air, pull)
    _right_sides(*lists, weight, x, pull, right)
    _solve(*lists, weight, air, right, p)
    _slopes(*lists, weight, x, p, slope)
    return Impulse(response=np.eye(3) - slope, pressure=p, air=air / FULL)
