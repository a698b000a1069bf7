"""Compiled pieces of a network's forward pass without gradients: what torch's operators leave on the table on one core.

Matrix products stay with BLAS; everything between them is a short loop here that allocates nothing.
"""

from __future__ import annotations

import math
from typing import Any, no_type_check

import numba
import numpy as np

FEATURES = 10  # edge features that the message loop takes; fewer are filled up with zeros
_jit: Any = numba.njit(fastmath=True, error_model="numpy", cache=True, nogil=True, boundscheck=False)


@_jit
@no_type_check
def normalise(x, bias, scale, shift, small, out, mean):
    """Adds `bias` [width] to x [rows, width] and puts its LayerNorm into `out`; mean [width] over all rows of it."""
    rows, width = x.shape
    zero = x.dtype.type(0)
    one = x.dtype.type(1)
    share = one / x.dtype.type(width)
    for a in range(width):
        mean[a] = zero
    for i in range(rows):
        total = zero
        for a in range(width):
            x[i, a] += bias[a]
            total += x[i, a]
        middle = total * share
        square = zero
        for a in range(width):
            off = x[i, a] - middle
            square += off * off
        inverse = one / math.sqrt(square * share + small)
        for a in range(width):
            value = (x[i, a] - middle) * inverse * scale[a] + shift[a]
            out[i, a] = value
            mean[a] += value
    for a in range(width):
        mean[a] /= x.dtype.type(rows)


@_jit
@no_type_check
def gather_messages(offset, neighbour, edge, ends, weight, out):
    """out[i] = sum over edges of act(receiver_i + sender_j + edge @ weight), act(t) = t/2 (1 + t/(1+|t|)).

    ends [nodes, >= 2 width]: sender's part first, then receiver's. edge [directed, FEATURES], weight [FEATURES,
    width]. All features of an edge are met in one sweep over the width, in registers.
    """
    nodes, width = out.shape
    one, half = out.dtype.type(1), out.dtype.type(0.5)
    for i in range(nodes):
        for a in range(width):
            out[i, a] = 0
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            f0, f1, f2, f3, f4 = edge[k, 0], edge[k, 1], edge[k, 2], edge[k, 3], edge[k, 4]
            f5, f6, f7, f8, f9 = edge[k, 5], edge[k, 6], edge[k, 7], edge[k, 8], edge[k, 9]
            for a in range(width):
                t = ends[j, a] + ends[i, width + a]
                t += f0 * weight[0, a] + f1 * weight[1, a] + f2 * weight[2, a] + f3 * weight[3, a]
                t += f4 * weight[4, a] + f5 * weight[5, a] + f6 * weight[6, a]
                t += f7 * weight[7, a] + f8 * weight[8, a] + f9 * weight[9, a]
                out[i, a] += half * t * (one + t / (one + abs(t)))


@_jit
@no_type_check
def join_ends(offset, neighbour, edge, ends, weight, out):
    """out [directed, width] = receiver_i + sender_j + edge @ weight; `ends` holds the receiver's part first here."""
    width = out.shape[1]
    for i in range(offset.size - 1):
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            f0, f1, f2, f3, f4 = edge[k, 0], edge[k, 1], edge[k, 2], edge[k, 3], edge[k, 4]
            f5, f6, f7, f8, f9 = edge[k, 5], edge[k, 6], edge[k, 7], edge[k, 8], edge[k, 9]
            for a in range(width):
                t = ends[i, a] + ends[j, width + a]
                t += f0 * weight[0, a] + f1 * weight[1, a] + f2 * weight[2, a] + f3 * weight[3, a]
                t += f4 * weight[4, a] + f5 * weight[5, a] + f6 * weight[6, a]
                t += f7 * weight[7, a] + f8 * weight[8, a] + f9 * weight[9, a]
                out[k, a] = t


@_jit
@no_type_check
def solid_edges(offset, neighbour, arm, displacement, velocity, magnitude, pitch, strain, rate, largest, out):
    """Edge features of a solid, as `zsdt.tignn.features.features` says them; out [directed, FEATURES].

    magnitude, pitch [nodes, 1] of the receiver; strain, rate: scales.
    """
    one = out.dtype.type(1)
    cap = one / (largest * largest)
    for i in range(offset.size - 1):
        inverse = one / magnitude[i, 0]
        per_pitch = inverse / pitch[i, 0]
        stretched = strain * magnitude[i, 0]
        for k in range(offset[i], offset[i + 1]):
            j = neighbour[k]
            long, before = out.dtype.type(0), out.dtype.type(0)
            for d in range(3):
                seen = (displacement[j, d] - displacement[i, d]) * (per_pitch / strain)
                bent = arm[k, d] + seen * stretched
                long += bent * bent
                before += arm[k, d] * arm[k, d]
                moving = (velocity[j, d] - velocity[i, d]) * (per_pitch / rate)
                out[k, d] = arm[k, d]
                out[k, 3 + d] = seen / math.sqrt(one + seen * seen * cap)
                out[k, 7 + d] = moving / math.sqrt(one + moving * moving * cap)
            seen = (math.sqrt(long) - math.sqrt(before)) * (inverse / strain)
            out[k, 6] = seen / math.sqrt(one + seen * seen * cap)


def filled(rows: np.ndarray) -> np.ndarray:
    """Weights [features, width] with rows of zeros up to FEATURES."""
    return np.ascontiguousarray(np.concatenate([rows, np.zeros((FEATURES - len(rows), rows.shape[1]), rows.dtype)]))
