"""Cauchy stress at the nodes, read from the stored energy of the cells around them.

Inside a cell the second Piola-Kirchhoff stress is the derivative of the energy: a constant part at the centre, and a
linear part from the bending and twisting modes (assumed strain: no stress across a bending direction). Seen from one
of the cell's corners these are `FEATURES` numbers that mirror images leave alike. A matrix per kind of corner turns
them into the stress at the node: plain addition (`plain_matrix`), or what `stress_readout` learned. It is turned by
the cell's F and averaged over the cells of a node.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float

from zsdt.tignn.cell_kernel import LANES, _conjugate, _fast, _gather, _slopes, _squares, _strain, mode_slopes

FEATURES = 18


def plain_matrix() -> Float[np.ndarray, "6 features"]:
    """Stress at a corner as constant plus linear part; the trilinear mode is left out."""
    matrix = np.zeros((6, FEATURES))
    for row, columns in enumerate(((0, 6, 7), (1, 8, 9), (2, 10, 11), (3, 12), (4, 13), (5, 14))):
        matrix[row, list(columns)] = 1.0
    return matrix


@_fast
@no_type_check
def _corner_features(g, t, k, corner, f):
    """Stress features f [FEATURES] of one corner, mirrored to the corner (+, +, +)."""
    x = 1.0 if corner & 1 else -1.0
    y = 1.0 if corner & 2 else -1.0
    z = 1.0 if corner & 4 else -1.0
    f[0], f[1], f[2] = g[0, k], g[1, k], g[2, k]
    f[3], f[4], f[5] = 0.5 * x * y * g[3, k], 0.5 * x * z * g[4, k], 0.5 * y * z * g[5, k]
    f[6], f[7] = 3.0 * y * t[6, k], 3.0 * z * t[3, k]
    f[8], f[9] = 3.0 * x * t[7, k], 3.0 * z * t[1, k]
    f[10], f[11] = 3.0 * x * t[5, k], 3.0 * y * t[2, k]
    turn = x * y * z
    f[12] = turn * 1.5 * (t[0, k] + t[4, k] - t[8, k])
    f[13] = turn * 1.5 * (t[0, k] + t[8, k] - t[4, k])
    f[14] = turn * 1.5 * (t[4, k] + t[8, k] - t[0, k])
    f[15], f[16], f[17] = 3.0 * y * z * t[9, k], 3.0 * x * z * t[10, k], 3.0 * x * y * t[11, k]


@_fast
@no_type_check
def corner_stress(tables, memory, u, keep, gain, kinds, matrices, out, features, gradients):
    """Cauchy stress out [8 cells, 6] Pa of each cell towards its corners; memory as `internal_force` left it.

    kinds [8 cells]: which of `matrices` [kinds, 6, FEATURES] holds for a corner. Where they are not empty, features
    [8 cells, FEATURES] Pa and gradients (F) [cells, 3, 3] are written too.
    """
    hidden = tables.inner.shape[0]
    m, e, d, g = np.empty((21, LANES)), np.empty((18, LANES)), np.empty((18, LANES)), np.empty((18, LANES))
    t, p, slope = np.empty((12, LANES)), np.empty((8, LANES)), np.empty((8, LANES))
    work, unused = np.empty((17 + 3 * hidden, LANES)), np.empty(tables.cells.shape[0])
    f, s, grad = np.empty(FEATURES), np.empty(6), np.empty((3, 3))
    for first in range(0, tables.cells.shape[0], LANES):
        _gather(tables.cells, first, u, tables.pitch, m)
        _strain(m, e)
        _squares(e, p)
        _slopes(tables, first, p, slope, unused, work)
        for j in range(18):
            for k in range(LANES):
                d[j, k] = (memory.history[j, first + k] + gain * e[j, k]) / keep if gain > 0.0 else 0.0
        _conjugate(tables, first, e, d, slope, g)
        mode_slopes(g, t)
        for k in range(LANES):
            cell = first + k
            for i in range(3):
                for j in range(3):
                    grad[i, j] = m[3 * j + i, k] + (1.0 if i == j else 0.0)
            for corner in range(8):
                row = 8 * cell + corner
                _corner_features(g, t, k, corner, f)
                matrix = matrices[kinds[row]]
                for i in range(6):
                    total = 0.0
                    for j in range(FEATURES):
                        total += matrix[i, j] * f[j]
                    s[i] = total
                _turn(s, grad, corner, out[row])
                if features.shape[0] > 0:
                    features[row] = f
            if gradients.shape[0] > 0:
                gradients[cell] = grad


@_fast
@no_type_check
def _turn(s, f, corner, out):
    """Mirrors the stress s [6] of a corner back and pushes it forward, sigma = F S F' / J."""
    x = 1.0 if corner & 1 else -1.0
    y = 1.0 if corner & 2 else -1.0
    z = 1.0 if corner & 4 else -1.0
    s01, s02, s12 = s[3] * x * y, s[4] * x * z, s[5] * y * z
    jac = (
        f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
        - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
        + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
    )
    a0 = f[0, 0] * s[0] + f[0, 1] * s01 + f[0, 2] * s02
    a1 = f[0, 0] * s01 + f[0, 1] * s[1] + f[0, 2] * s12
    a2 = f[0, 0] * s02 + f[0, 1] * s12 + f[0, 2] * s[2]
    b0 = f[1, 0] * s[0] + f[1, 1] * s01 + f[1, 2] * s02
    b1 = f[1, 0] * s01 + f[1, 1] * s[1] + f[1, 2] * s12
    b2 = f[1, 0] * s02 + f[1, 1] * s12 + f[1, 2] * s[2]
    c0 = f[2, 0] * s[0] + f[2, 1] * s01 + f[2, 2] * s02
    c1 = f[2, 0] * s01 + f[2, 1] * s[1] + f[2, 2] * s12
    c2 = f[2, 0] * s02 + f[2, 1] * s12 + f[2, 2] * s[2]
    out[0] = (a0 * f[0, 0] + a1 * f[0, 1] + a2 * f[0, 2]) / jac
    out[1] = (b0 * f[1, 0] + b1 * f[1, 1] + b2 * f[1, 2]) / jac
    out[2] = (c0 * f[2, 0] + c1 * f[2, 1] + c2 * f[2, 2]) / jac
    out[3] = (a0 * f[1, 0] + a1 * f[1, 1] + a2 * f[1, 2]) / jac
    out[4] = (a0 * f[2, 0] + a1 * f[2, 1] + a2 * f[2, 2]) / jac
    out[5] = (b0 * f[2, 0] + b1 * f[2, 1] + b2 * f[2, 2]) / jac


@_fast
@no_type_check
def node_average(offset, slot, values, out):
    """Mean of the slots [8 cells, components] of each node, out [nodes, components]."""
    for n in range(out.shape[0]):
        count = offset[n + 1] - offset[n]
        for j in range(out.shape[1]):
            total = 0.0
            for a in range(offset[n], offset[n + 1]):
                total += values[slot[a], j]
            out[n, j] = total / count


@_fast
@no_type_check
def node_gradient(offset, slot, gradients, out):
    """Mean F of the cells around each node, out [nodes, 3, 3]."""
    for n in range(out.shape[0]):
        out[n] = 0.0
        for a in range(offset[n], offset[n + 1]):
            out[n] += gradients[slot[a] // 8]
        out[n] /= offset[n + 1] - offset[n]


@_fast
@no_type_check
def push_forward(second, gradient, stress):
    """Adds F S F' / J of second Piola-Kirchhoff stresses [nodes, 6] Pa to `stress` [nodes, 6] Pa."""
    for n in range(stress.shape[0]):
        f, s, total = gradient[n], second[n], stress[n]
        jac = (
            f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
            - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
            + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
        )
        for k in range(6):
            i = 0 if k in (0, 3, 4) else (1 if k in (1, 5) else 2)
            j = k if k < 3 else (1 if k == 3 else 2)
            total[k] += (
                f[i, 0] * (s[0] * f[j, 0] + s[3] * f[j, 1] + s[4] * f[j, 2])
                + f[i, 1] * (s[3] * f[j, 0] + s[1] * f[j, 1] + s[5] * f[j, 2])
                + f[i, 2] * (s[4] * f[j, 0] + s[5] * f[j, 1] + s[2] * f[j, 2])
            ) / jac


def pull_back(stress: Float[np.ndarray, "nodes 6"], gradient: Float[np.ndarray, "nodes 3 3"]) -> np.ndarray:
    """Second Piola-Kirchhoff stress J F^-1 sigma F^-T [nodes, 6] Pa of Cauchy stress [nodes, 6] Pa."""
    i, j = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    tensor = np.empty((len(stress), 3, 3))
    tensor[:, i, j] = tensor[:, j, i] = stress
    back = np.linalg.inv(gradient)
    second = np.linalg.det(gradient)[:, None, None] * (back @ tensor @ back.transpose(0, 2, 1))
    return np.ascontiguousarray(second[:, i, j])
