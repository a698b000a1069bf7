"""Cauchy stress at the nodes, read from the stored energy of the cells around them.

Inside a cell the second Piola-Kirchhoff stress is the derivative of the energy: constant part from the centre, linear
part from the bending and twisting modes (assumed strain: no stress across a bending direction). It is evaluated at
`corner` times the way from the centre to each node, turned by the cell's F and averaged over the cells of the node.
"""

from __future__ import annotations

import numpy as np

from zsdt.tignn.cell_kernel import LANES, _conjugate, _fast, _gather, _slopes, _squares, _strain, mode_slopes


@_fast
def corner_stress(tables, memory, u, keep, gain, reach, out):
    """Cauchy stress out [8 cells, 6] Pa of each cell towards its corners; memory as `internal_force` left it."""
    hidden = tables.inner.shape[0]
    m, e, d, g = np.empty((21, LANES)), np.empty((18, LANES)), np.empty((18, LANES)), np.empty((18, LANES))
    t, p, slope = np.empty((12, LANES)), np.empty((8, LANES)), np.empty((8, LANES))
    work, unused = np.empty((17 + 3 * hidden, LANES)), np.empty(tables.cells.shape[0])
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
            _turn(m, g, t, k, 8 * (first + k), reach, out)


@_fast
def _turn(m, g, t, k, row, reach, out):
    """Stress of one cell at its eight corners, sigma = F S F' / J."""
    f00, f01, f02 = 1.0 + m[0, k], m[3, k], m[6, k]
    f10, f11, f12 = m[1, k], 1.0 + m[4, k], m[7, k]
    f20, f21, f22 = m[2, k], m[5, k], 1.0 + m[8, k]
    jac = f00 * (f11 * f22 - f12 * f21) - f01 * (f10 * f22 - f12 * f20) + f02 * (f10 * f21 - f11 * f20)
    s12z = 1.5 * (t[0, k] + t[4, k] - t[8, k])
    s13y = 1.5 * (t[0, k] + t[8, k] - t[4, k])
    s23x = 1.5 * (t[4, k] + t[8, k] - t[0, k])
    for corner in range(8):
        x = reach if corner & 1 else -reach
        y = reach if corner & 2 else -reach
        z = reach if corner & 4 else -reach
        s00 = g[0, k] + 3.0 * (y * t[6, k] + z * t[3, k])
        s11 = g[1, k] + 3.0 * (x * t[7, k] + z * t[1, k])
        s22 = g[2, k] + 3.0 * (x * t[5, k] + y * t[2, k])
        s01, s02, s12 = 0.5 * g[3, k] + z * s12z, 0.5 * g[4, k] + y * s13y, 0.5 * g[5, k] + x * s23x
        a0, a1, a2 = (
            f00 * s00 + f01 * s01 + f02 * s02,
            f00 * s01 + f01 * s11 + f02 * s12,
            f00 * s02 + f01 * s12 + f02 * s22,
        )
        b0, b1, b2 = (
            f10 * s00 + f11 * s01 + f12 * s02,
            f10 * s01 + f11 * s11 + f12 * s12,
            f10 * s02 + f11 * s12 + f12 * s22,
        )
        c0, c1, c2 = (
            f20 * s00 + f21 * s01 + f22 * s02,
            f20 * s01 + f21 * s11 + f22 * s12,
            f20 * s02 + f21 * s12 + f22 * s22,
        )
        out[row + corner, 0] = (a0 * f00 + a1 * f01 + a2 * f02) / jac
        out[row + corner, 1] = (b0 * f10 + b1 * f11 + b2 * f12) / jac
        out[row + corner, 2] = (c0 * f20 + c1 * f21 + c2 * f22) / jac
        out[row + corner, 3] = (a0 * f10 + a1 * f11 + a2 * f12) / jac
        out[row + corner, 4] = (a0 * f20 + a1 * f21 + a2 * f22) / jac
        out[row + corner, 5] = (b0 * f20 + b1 * f21 + b2 * f22) / jac


@_fast
def node_average(offset, slot, values, out):
    """Mean of the slots [8 cells, components] of each node, out [nodes, components]."""
    for n in range(out.shape[0]):
        count = offset[n + 1] - offset[n]
        for j in range(out.shape[1]):
            total = 0.0
            for a in range(offset[n], offset[n + 1]):
                total += values[slot[a], j]
            out[n, j] = total / count
