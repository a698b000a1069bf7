"""The sub-step loop of the cell engine in one compiled kernel: node -> cell -> node, without intermediate tensors.

Cells go through in blocks of `LANES`; every inner loop runs over the lanes of a block, so the compiler vectorises
it. The mathematics is that of `cell_energy` (torch), to which a test holds it at 1e-10.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, no_type_check

import numba as nb
import numpy as np
from jaxtyping import Int

LANES = 16
SCALE = 0.1
_fast = nb.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False)
_R2, _R3, _R6 = 1 / math.sqrt(2.0), 1 / math.sqrt(3.0), 1 / math.sqrt(6.0)


class CellTables(NamedTuple):
    """What the kernel needs of one body; cells are padded to whole blocks with an extra, immobile node.

    cells [blocks * LANES, 8]; offset [nodes + 1], slot [8 cells]: where the forces of a node lie (slot = 8 cell +
    corner); relaxed, viscous [groups, cells]; inner, bias (flags folded in) [hidden, cells], outer, outer_bias: the
    correction (hidden = 0 switches it off); numbers: pitch, tau, reach of the correction.
    """

    cells: Any
    offset: Any
    slot: Any
    relaxed: Any
    viscous: Any
    inner: Any
    bias: Any
    outer: Any
    outer_bias: Any
    pitch: float
    tau: float
    reach: float


class CellMemory(NamedTuple):
    """Per cell: history [18, cells] of the exponential memory, overstress energy density and heat density [cells]."""

    history: Any
    overstress: Any
    heat: Any
    elastic: Any


def pad_cells(cells: Int[np.ndarray, "cells 8"], nodes: int) -> Int[np.ndarray, "padded 8"]:
    """Cells filled up to whole blocks; a filler has all corners at the immobile node `nodes`."""
    blocks = -(-len(cells) // LANES)
    out = np.full((blocks * LANES, 8), nodes, np.int64)
    out[: len(cells)] = cells
    return out


def node_slots(
    cells: Int[np.ndarray, "cells 8"], nodes: int
) -> tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " slots"]]:
    """CSR lists of the (cell, corner) slots of each node: offsets [nodes + 1] and slots [8 cells]."""
    flat = cells.ravel()
    order = np.argsort(flat, kind="stable")
    return np.searchsorted(flat[order], np.arange(nodes + 1)).astype(np.int64), order.astype(np.int64)


def new_memory(padded: int) -> CellMemory:
    """Relaxed memory of `padded` cells."""
    return CellMemory(np.zeros((18, padded)), np.zeros(padded), np.zeros(padded), np.zeros(padded))


@_fast
@no_type_check
def _gather(cells, first, u, pitch, m):
    """Corner displacements of a block -> Hadamard modes m [21, LANES] (row 3 * pattern + component)."""
    scale = 0.25 / pitch
    for lane in range(LANES):
        c = first + lane
        for i in range(3):
            a0, a1 = u[cells[c, 0], i], u[cells[c, 1], i]
            a2, a3 = u[cells[c, 2], i], u[cells[c, 3], i]
            a4, a5 = u[cells[c, 4], i], u[cells[c, 5], i]
            a6, a7 = u[cells[c, 6], i], u[cells[c, 7], i]
            s0, s1, s2, s3 = a0 + a1, a2 + a3, a4 + a5, a6 + a7
            d0, d1, d2, d3 = a1 - a0, a3 - a2, a5 - a4, a7 - a6
            ss0, ss1, sd0, sd1 = s0 + s1, s2 + s3, s1 - s0, s3 - s2
            ds0, ds1, dd0, dd1 = d0 + d1, d2 + d3, d1 - d0, d3 - d2
            m[i, lane] = scale * (ds0 + ds1)
            m[3 + i, lane] = scale * (sd0 + sd1)
            m[6 + i, lane] = scale * (ss1 - ss0)
            m[9 + i, lane] = scale * (sd1 - sd0)
            m[12 + i, lane] = scale * (ds1 - ds0)
            m[15 + i, lane] = scale * (dd0 + dd1)
            m[18 + i, lane] = scale * (dd1 - dd0)


@_fast
@no_type_check
def _strain(m, e):
    """Modes of a block -> strain measures e [18, LANES]."""
    for k in range(LANES):
        h00, h10, h20 = m[0, k], m[1, k], m[2, k]
        h01, h11, h21 = m[3, k], m[4, k], m[5, k]
        h02, h12, h22 = m[6, k], m[7, k], m[8, k]
        e[0, k] = h00 + 0.5 * (h00 * h00 + h10 * h10 + h20 * h20)
        e[1, k] = h11 + 0.5 * (h01 * h01 + h11 * h11 + h21 * h21)
        e[2, k] = h22 + 0.5 * (h02 * h02 + h12 * h12 + h22 * h22)
        e[3, k] = 0.5 * (h01 + h10 + h00 * h01 + h10 * h11 + h20 * h21)
        e[4, k] = 0.5 * (h02 + h20 + h00 * h02 + h10 * h12 + h20 * h22)
        e[5, k] = 0.5 * (h12 + h21 + h01 * h02 + h11 * h12 + h21 * h22)
        yz0 = m[9, k] + h00 * m[9, k] + h10 * m[10, k] + h20 * m[11, k]
        yz1 = m[10, k] + h01 * m[9, k] + h11 * m[10, k] + h21 * m[11, k]
        yz2 = m[11, k] + h02 * m[9, k] + h12 * m[10, k] + h22 * m[11, k]
        xz0 = m[12, k] + h00 * m[12, k] + h10 * m[13, k] + h20 * m[14, k]
        xz1 = m[13, k] + h01 * m[12, k] + h11 * m[13, k] + h21 * m[14, k]
        xz2 = m[14, k] + h02 * m[12, k] + h12 * m[13, k] + h22 * m[14, k]
        xy0 = m[15, k] + h00 * m[15, k] + h10 * m[16, k] + h20 * m[17, k]
        xy1 = m[16, k] + h01 * m[15, k] + h11 * m[16, k] + h21 * m[17, k]
        xy2 = m[17, k] + h02 * m[15, k] + h12 * m[16, k] + h22 * m[17, k]
        e[6, k], e[9, k] = _R2 * (xy0 + yz2), _R2 * (xy0 - yz2)
        e[7, k], e[10, k] = _R2 * (xy1 + xz2), _R2 * (xy1 - xz2)
        e[8, k], e[11, k] = _R2 * (xz0 + yz1), _R2 * (xz0 - yz1)
        e[12, k] = _R3 * (yz0 + xz1 + xy2)
        e[13, k] = _R2 * (yz0 - xz1)
        e[14, k] = _R6 * (yz0 + xz1 - 2.0 * xy2)
        e[15, k] = m[18, k] + h00 * m[18, k] + h10 * m[19, k] + h20 * m[20, k]
        e[16, k] = m[19, k] + h01 * m[18, k] + h11 * m[19, k] + h21 * m[20, k]
        e[17, k] = m[20, k] + h02 * m[18, k] + h12 * m[19, k] + h22 * m[20, k]


@_fast
@no_type_check
def _squares(e, p):
    """Squared group amplitudes p [8, LANES]; row 0 holds the trace itself, not its square."""
    for k in range(LANES):
        t = e[0, k] + e[1, k] + e[2, k]
        a, b, c = e[0, k] - t / 3.0, e[1, k] - t / 3.0, e[2, k] - t / 3.0
        p[0, k] = t
        p[1, k] = a * a + b * b + c * c
        p[2, k] = 2.0 * (e[3, k] ** 2 + e[4, k] ** 2 + e[5, k] ** 2)
        p[3, k] = e[6, k] ** 2 + e[7, k] ** 2 + e[8, k] ** 2
        p[4, k] = e[9, k] ** 2 + e[10, k] ** 2 + e[11, k] ** 2
        p[5, k] = e[12, k] ** 2
        p[6, k] = e[13, k] ** 2 + e[14, k] ** 2
        p[7, k] = e[15, k] ** 2 + e[16, k] ** 2 + e[17, k] ** 2


@_fast
@no_type_check
def _slopes(tables, first, p, slope, elastic, work):
    """Energy density of a block and its slopes [8, LANES] by trace (row 0) and by the squares (rows 1-7)."""
    relaxed = tables.relaxed
    hidden = tables.inner.shape[0]
    for k in range(LANES):
        elastic[first + k] = relaxed[0, first + k] * p[0, k] * p[0, k]
        slope[0, k] = 2.0 * relaxed[0, first + k] * p[0, k]
    for j in range(1, 8):
        for k in range(LANES):
            elastic[first + k] += relaxed[j, first + k] * p[j, k]
            slope[j, k] = relaxed[j, first + k]
    if hidden > 0:
        _corrected(tables, first, p, slope, elastic, work)


@_fast
@no_type_check
def _corrected(tables, first, p, slope, elastic, work):
    """Multiplies the group energies by the network's factors; `work` [16 + 2 hidden + 1, LANES]."""
    relaxed, inner, outer, reach = tables.relaxed, tables.inner, tables.outer, tables.reach
    hidden = inner.shape[0]
    x, dx = work[0:8], work[8:16]
    act, der = work[16 : 16 + hidden], work[16 + hidden : 16 + 2 * hidden]
    acc = work[16 + 2 * hidden]
    for k in range(LANES):
        z = p[0, k] / SCALE
        r = 1.0 / math.sqrt(1.0 + z * z)
        x[0, k] = z * r
        dx[0, k] = r * r * r / SCALE
    for j in range(1, 8):
        for k in range(LANES):
            r = 1.0 / (SCALE * SCALE + p[j, k])
            x[j, k] = p[j, k] * r
            dx[j, k] = SCALE * SCALE * r * r
    for h in range(hidden):
        for k in range(LANES):
            acc[k] = tables.bias[h, first + k]
        for j in range(8):
            weight = inner[h, j]
            for k in range(LANES):
                acc[k] += weight * x[j, k]
        for k in range(LANES):
            r = 1.0 / math.sqrt(1.0 + acc[k] * acc[k])
            act[h, k] = acc[k] * r
            der[h, k] = r * r * r
    for k in range(LANES):
        elastic[first + k] = 0.0
    back = work[17 + 2 * hidden : 17 + 3 * hidden]
    back[:] = 0.0
    for j in range(8):
        for k in range(LANES):
            acc[k] = tables.outer_bias[j]
        for h in range(hidden):
            weight = outer[j, h]
            for k in range(LANES):
                acc[k] += weight * act[h, k]
        for k in range(LANES):
            r = 1.0 / math.sqrt(1.0 + acc[k] * acc[k])
            factor = 1.0 + reach * acc[k] * r
            square = p[0, k] * p[0, k] if j == 0 else p[j, k]
            energy = relaxed[j, first + k] * square
            elastic[first + k] += energy * factor
            slope[j, k] *= factor
            acc[k] = energy * reach * r * r * r
        for h in range(hidden):
            weight = outer[j, h]
            for k in range(LANES):
                back[h, k] += weight * acc[k]
    for h in range(hidden):
        for k in range(LANES):
            back[h, k] *= der[h, k]
        for j in range(8):
            weight = inner[h, j]
            for k in range(LANES):
                slope[j, k] += weight * back[h, k] * dx[j, k]


@_fast
@no_type_check
def _remember(tables, memory, first, keep, gain, e, d, p):
    """Exponential memory: strain d [18, LANES] that the dashpots still hold, for a strain that ran linearly."""
    history = memory.history
    for j in range(18):
        for k in range(LANES):
            d[j, k] = history[j, first + k] + gain * e[j, k]
            history[j, first + k] = keep * d[j, k] - gain * e[j, k]
    _squares(d, p)
    for k in range(LANES):
        held = 0.0
        for j in range(1, 8):
            held += tables.viscous[j, first + k] * p[j, k]
        memory.overstress[first + k] = held


@_fast
@no_type_check
def _conjugate(tables, first, e, d, slope, g):
    """Derivatives g [18, LANES] of the energy density by the strain measures (shear counted as one number)."""
    v = tables.viscous
    for k in range(LANES):
        c = first + k
        t, td = (e[0, k] + e[1, k] + e[2, k]) / 3.0, (d[0, k] + d[1, k] + d[2, k]) / 3.0
        for j in range(3):
            g[j, k] = slope[0, k] + 2.0 * slope[1, k] * (e[j, k] - t) + 2.0 * v[1, c] * (d[j, k] - td)
            g[3 + j, k] = 4.0 * slope[2, k] * e[3 + j, k] + 4.0 * v[2, c] * d[3 + j, k]
            g[6 + j, k] = 2.0 * slope[3, k] * e[6 + j, k] + 2.0 * v[3, c] * d[6 + j, k]
            g[9 + j, k] = 2.0 * slope[4, k] * e[9 + j, k] + 2.0 * v[4, c] * d[9 + j, k]
            g[15 + j, k] = 2.0 * slope[7, k] * e[15 + j, k] + 2.0 * v[7, c] * d[15 + j, k]
        g[12, k] = 2.0 * slope[5, k] * e[12, k] + 2.0 * v[5, c] * d[12, k]
        g[13, k] = 2.0 * slope[6, k] * e[13, k] + 2.0 * v[6, c] * d[13, k]
        g[14, k] = 2.0 * slope[6, k] * e[14, k] + 2.0 * v[6, c] * d[14, k]


@_fast
@no_type_check
def mode_slopes(g, t):
    """Derivatives of the energy by the pulled-back modes, t [12, LANES]: yz, xz, xy, xyz, three components each."""
    for k in range(LANES):
        twist = _R3 * g[12, k] + _R6 * g[14, k]
        t[0, k] = twist + _R2 * g[13, k]
        t[4, k] = twist - _R2 * g[13, k]
        t[8, k] = _R3 * g[12, k] - 2.0 * _R6 * g[14, k]
        t[6, k], t[2, k] = _R2 * (g[6, k] + g[9, k]), _R2 * (g[6, k] - g[9, k])
        t[7, k], t[5, k] = _R2 * (g[7, k] + g[10, k]), _R2 * (g[7, k] - g[10, k])
        t[3, k], t[1, k] = _R2 * (g[8, k] + g[11, k]), _R2 * (g[8, k] - g[11, k])
        t[9, k], t[10, k], t[11, k] = g[15, k], g[16, k], g[17, k]


@_fast
@no_type_check
def _push(m, g, t, b):
    """Derivatives of the energy density by the modes, b [21, LANES]."""
    for k in range(LANES):
        s00, s11, s22 = g[0, k], g[1, k], g[2, k]
        s01, s02, s12 = 0.5 * g[3, k], 0.5 * g[4, k], 0.5 * g[5, k]
        for c in range(3):
            f0, f1, f2 = m[c, k], m[3 + c, k], m[6 + c, k]
            if c == 0:
                f0 += 1.0
            elif c == 1:
                f1 += 1.0
            else:
                f2 += 1.0
            m3, m4, m5, m6 = m[9 + c, k], m[12 + c, k], m[15 + c, k], m[18 + c, k]
            b[c, k] = f0 * s00 + f1 * s01 + f2 * s02 + m3 * t[0, k] + m4 * t[3, k] + m5 * t[6, k] + m6 * t[9, k]
            b[3 + c, k] = f0 * s01 + f1 * s11 + f2 * s12 + m3 * t[1, k] + m4 * t[4, k] + m5 * t[7, k] + m6 * t[10, k]
            b[6 + c, k] = f0 * s02 + f1 * s12 + f2 * s22 + m3 * t[2, k] + m4 * t[5, k] + m5 * t[8, k] + m6 * t[11, k]
            b[9 + c, k] = f0 * t[0, k] + f1 * t[1, k] + f2 * t[2, k]
            b[12 + c, k] = f0 * t[3, k] + f1 * t[4, k] + f2 * t[5, k]
            b[15 + c, k] = f0 * t[6, k] + f1 * t[7, k] + f2 * t[8, k]
            b[18 + c, k] = f0 * t[9, k] + f1 * t[10, k] + f2 * t[11, k]


@_fast
@no_type_check
def _spread(first, b, pitch, corner):
    """Modes' derivatives -> forces at the corners, corner [8 cells, 3] N."""
    scale = -0.25 * pitch * pitch
    for lane in range(LANES):
        row = 8 * (first + lane)
        for i in range(3):
            x, y, z = b[i, lane], b[3 + i, lane], b[6 + i, lane]
            yz, xz, xy, xyz = b[9 + i, lane], b[12 + i, lane], b[15 + i, lane], b[18 + i, lane]
            for high in range(2):
                s = 1.0 if high else -1.0
                px, py, pxy, po = x + s * xz, y + s * yz, xy + s * xyz, s * z
                corner[row + 4 * high, i] = scale * (po - px - py + pxy)
                corner[row + 4 * high + 1, i] = scale * (po + px - py - pxy)
                corner[row + 4 * high + 2, i] = scale * (po - px + py - pxy)
                corner[row + 4 * high + 3, i] = scale * (po + px + py + pxy)


@_fast
@no_type_check
def internal_force(tables, memory, u, keep, gain, corner, force):
    """Forces [nodes, 3] N = minus the gradient of the stored energy at displacements u [nodes + 1, 3] m.

    Moves the memory on by one step with factors `keep` = exp(-dt/tau) and `gain` = (1 - keep) tau/dt of a strain that
    runs linearly; keep = 1, gain = 1 holds the dashpots, keep = gain = 0 gives the relaxed body.
    """
    hidden = tables.inner.shape[0]
    m, e, d, g = np.empty((21, LANES)), np.empty((18, LANES)), np.empty((18, LANES)), np.empty((18, LANES))
    t, b, p, q = np.empty((12, LANES)), np.empty((21, LANES)), np.empty((8, LANES)), np.empty((8, LANES))
    slope, work = np.empty((8, LANES)), np.empty((17 + 3 * hidden, LANES))
    for first in range(0, tables.cells.shape[0], LANES):
        _gather(tables.cells, first, u, tables.pitch, m)
        _strain(m, e)
        _squares(e, p)
        _slopes(tables, first, p, slope, memory.elastic, work)
        _remember(tables, memory, first, keep, gain, e, d, q)
        _conjugate(tables, first, e, d, slope, g)
        mode_slopes(g, t)
        _push(m, g, t, b)
        _spread(first, b, tables.pitch, corner)
    for n in range(force.shape[0]):
        x, y, z = 0.0, 0.0, 0.0
        for a in range(tables.offset[n], tables.offset[n + 1]):
            row = tables.slot[a]
            x += corner[row, 0]
            y += corner[row, 1]
            z += corner[row, 2]
        force[n, 0], force[n, 1], force[n, 2] = x, y, z
