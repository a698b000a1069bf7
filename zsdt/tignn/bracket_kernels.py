"""Compiled sums of exact brackets, with their own gradient.

For vectors a, b, c and gradients e, s over the nodes of one bracket (two nodes, or one for the bulk):
`P_g x = x - g (g.x)/(g.g)`, `A = P_s a`, `B = P_s b`, `C = P_e c`, reversible `A (B.e) - B (A.e)`, irreversible
`C (C.s)` (DESIGN 4.1). Then `e.f = (C.e)(C.s) = 0` and `s.f = (C.s)^2 >= 0` to rounding.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float, Int

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True, fastmath={"contract", "reassoc", "arcp", "nsz"})
SMALLEST_SQUARE = 1e-20


@_jit
@no_type_check
def _dot(x, y):
    total = x.dtype.type(0)
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return total


@_jit
@no_type_check
def _remove(x, g, square):
    """Takes the part along `g` out of `x`, twice because the first time leaves rounding; returns the share removed."""
    along = _dot(x, g) / square
    for i in range(x.shape[0]):
        x[i] -= along * g[i]
    rest = _dot(x, g) / square
    for i in range(x.shape[0]):
        x[i] -= rest * g[i]
    return along + rest


@_jit
@no_type_check
def _gather(members, row, values, out):
    d = values.shape[1]
    for m in range(members.shape[1]):
        for i in range(d):
            out[m * d + i] = values[members[row, m], i]


@_jit
@no_type_check
def _load_vectors(places, row, vectors, kind, rank, out):
    d = vectors.shape[3]
    for m in range(places.shape[1]):
        for i in range(d):
            out[m * d + i] = vectors[places[row, m], kind, rank, i]


@_jit
@no_type_check
def _sum_brackets(members, places, vectors, energy, entropy, reversible, irreversible):
    """Adds the brackets of all rows: `members` are their nodes, `places` the rows of `vectors` with their halves."""
    rows, size = members.shape
    ranks, d = vectors.shape[2:]
    n = size * d
    work = np.empty((5, n), energy.dtype)
    e, s, a, b, c = work[0], work[1], work[2], work[3], work[4]
    least = energy.dtype.type(SMALLEST_SQUARE)
    for row in range(rows):
        _gather(members, row, energy, e)
        _gather(members, row, entropy, s)
        ee, ss = max(_dot(e, e), least), max(_dot(s, s), least)
        for k in range(ranks):
            _load_vectors(places, row, vectors, 0, k, a)
            _load_vectors(places, row, vectors, 1, k, b)
            _load_vectors(places, row, vectors, 2, k, c)
            _remove(a, s, ss)
            _remove(b, s, ss)
            _remove(c, e, ee)
            ae, be, cs = _dot(a, e), _dot(b, e), _dot(c, s)
            for m in range(size):
                node = members[row, m]
                for i in range(d):
                    reversible[node, i] += a[m * d + i] * be - b[m * d + i] * ae
                    irreversible[node, i] += c[m * d + i] * cs


@_jit
@no_type_check
def _project_back(x, g, square, share, gx, gg):
    """Gradient of `_remove`: turns `gx` (for P_g x, now in `x`) into that of x and adds to `gg` that of g."""
    delta = _dot(gx, g) / square
    for i in range(x.shape[0]):
        gg[i] += share * (delta * g[i] - gx[i]) - delta * x[i]
        gx[i] -= delta * g[i]


@_jit
@no_type_check
def _bracket_gradients(members, places, vectors, energy, entropy, up_r, up_i, g_vectors, g_energy, g_entropy):
    """Gradients of `_sum_brackets` for the output gradients `up_r`, `up_i`."""
    rows, size = members.shape
    ranks, d = vectors.shape[2:]
    n = size * d
    work = np.empty((12, n), energy.dtype)
    e, s, a, b, c, ur, ui = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    ga, gb, gc, ge, gs = work[7], work[8], work[9], work[10], work[11]
    least = energy.dtype.type(SMALLEST_SQUARE)
    for row in range(rows):
        _gather(members, row, energy, e)
        _gather(members, row, entropy, s)
        _gather(members, row, up_r, ur)
        _gather(members, row, up_i, ui)
        ee, ss = max(_dot(e, e), least), max(_dot(s, s), least)
        ge[:] = 0
        gs[:] = 0
        for k in range(ranks):
            _load_vectors(places, row, vectors, 0, k, a)
            _load_vectors(places, row, vectors, 1, k, b)
            _load_vectors(places, row, vectors, 2, k, c)
            share_a, share_b, share_c = _remove(a, s, ss), _remove(b, s, ss), _remove(c, e, ee)
            ae, be, cs = _dot(a, e), _dot(b, e), _dot(c, s)
            g_ae, g_be, g_cs = -_dot(b, ur), _dot(a, ur), _dot(c, ui)
            for i in range(n):
                ga[i] = be * ur[i] + g_ae * e[i]
                gb[i] = g_be * e[i] - ae * ur[i]
                gc[i] = cs * ui[i] + g_cs * s[i]
                ge[i] += g_ae * a[i] + g_be * b[i]
                gs[i] += g_cs * c[i]
            _project_back(a, s, ss, share_a, ga, gs)
            _project_back(b, s, ss, share_b, gb, gs)
            _project_back(c, e, ee, share_c, gc, ge)
            for m in range(size):
                for i in range(d):
                    g_vectors[places[row, m], 0, k, i] = ga[m * d + i]
                    g_vectors[places[row, m], 1, k, i] = gb[m * d + i]
                    g_vectors[places[row, m], 2, k, i] = gc[m * d + i]
        for m in range(size):
            for i in range(d):
                g_energy[members[row, m], i] += ge[m * d + i]
                g_entropy[members[row, m], i] += gs[m * d + i]


class _Brackets(torch.autograd.Function):
    """Autograd node around the two loops."""

    @staticmethod
    def forward(ctx: Any, vectors, energy, entropy, members, places):
        arrays = [t.detach().contiguous().numpy() for t in (vectors, energy, entropy)]
        reversible, irreversible = torch.zeros_like(energy), torch.zeros_like(energy)
        _sum_brackets(members, places, *arrays, reversible.numpy(), irreversible.numpy())
        ctx.kept = (members, places, *arrays)
        return reversible, irreversible

    @staticmethod
    def backward(ctx: Any, *upstream):
        kept = ctx.kept
        found = [torch.zeros(a.shape, dtype=upstream[0].dtype) for a in kept[2:]]
        ups = [g.contiguous().numpy() for g in upstream]
        _bracket_gradients(*kept, *ups, *(t.numpy() for t in found))
        return *found, None, None


def sum_brackets(
    members: Int[np.ndarray, "brackets size"],
    places: Int[np.ndarray, "brackets size"],
    vectors: Float[torch.Tensor, "rows 3 rank d"],
    energy: Float[torch.Tensor, "nodes d"],
    entropy: Float[torch.Tensor, "nodes d"],
) -> tuple[Float[torch.Tensor, "nodes d"], Float[torch.Tensor, "nodes d"]]:
    """Reversible and irreversible part per node of a sum of exact brackets.

    members: nodes of each bracket (two for an edge, one for the bulk); places: rows of `vectors` that hold the part
    of each of them; vectors [rows, (a, b, c), rank, d]. Float32 or float64, CPU, one thread.
    """
    return _Brackets.apply(vectors, energy, entropy, members, places)
