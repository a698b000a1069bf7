"""Learned local read-out of stress: how the nodal stress of the truth follows from the cells of the coarse graph.

Stresses at a clamp or an edge depend on the mesh: a node of the truth averages corners of fine cells, the coarse graph
corners of coarse ones. For each kind of corner (where its node lies: at the clamp, beside it, at the tip, on a side,
inside) one matrix maps the stress features of the cell to its share of the nodal stress. Linear, so it scales with
the material; mirrored, so a left side teaches a right one; fitted in closed form (ridge regression) on rollouts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.tignn.cell_stress import FEATURES, plain_matrix, pull_back

KINDS = 20
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
SIGNS = np.array([[1 if n >> a & 1 else -1 for a in range(3)] for n in range(8)], float)
# Sign that a mirrored stress component takes at each of the eight corners [8, 6].
MIRROR = np.stack([SIGNS[:, i] * SIGNS[:, j] for i, j in _PAIRS], axis=1)


def corner_kinds(cells: Int[np.ndarray, "cells 8"], clamped: Bool[np.ndarray, " nodes"]) -> Int[np.ndarray, " corners"]:
    """Kind of each corner of each cell, [8 cells] in 0..19.

    Along x: 0 inside, 1 node held, 2 cell beside the clamp, 3 the cell across is beside the clamp, 4 free end; times
    whether the node lies on a side across y and across z.
    """
    held = clamped[cells]
    nodes = len(clamped)
    around = np.zeros(nodes, np.int64)
    np.add.at(around, cells.ravel(), 1)
    kinds = np.zeros(cells.shape, np.int64)
    on_side = {axis: _on_side(cells, nodes, axis) for axis in range(3)}
    beside = np.zeros(nodes, bool)
    for corner in range(8):
        beside[cells[held[:, corner ^ 1] & ~held[:, corner], corner]] = True
    for corner in range(8):
        node = cells[:, corner]
        along = np.where(beside[node], 3, 0)
        along = np.where(on_side[0][node], 4, along)
        along = np.where(held[:, corner ^ 1], 2, along)
        along = np.where(held[:, corner], 1, along)
        kinds[:, corner] = along * 4 + 2 * on_side[1][node] + on_side[2][node]
    return kinds.ravel()


def _on_side(cells: Int[np.ndarray, "cells 8"], nodes: int, axis: int) -> Bool[np.ndarray, " nodes"]:
    """Nodes that have cells on one side only along `axis`."""
    low, high = np.zeros(nodes, bool), np.zeros(nodes, bool)
    for corner in range(8):
        (high if corner >> axis & 1 else low)[cells[:, corner]] = True
    return ~(low & high)


@dataclass
class StressReadout:
    """Matrices [kinds, 6, FEATURES] of the read-out."""

    matrices: Float[np.ndarray, "kinds 6 features"]

    @staticmethod
    def plain() -> StressReadout:
        """The read-out before any learning: constant plus linear part of the energy's own stress."""
        return StressReadout(np.repeat(plain_matrix()[None], KINDS, axis=0))


@dataclass
class Equations:
    """Linear equations of one frame for each stress component: rows [6, nodes, unknowns], gaps [6, nodes] Pa."""

    rows: Float[np.ndarray, "6 nodes unknowns"]
    gaps: Float[np.ndarray, "6 nodes"]

    def less(self, other: Equations) -> Equations:
        """What changed since another frame."""
        return Equations(self.rows - other.rows, self.gaps - other.gaps)


def equations(
    features: Float[np.ndarray, "corners features"],
    gradients: Float[np.ndarray, "cells 3 3"],
    kinds: Int[np.ndarray, " corners"],
    cells: Int[np.ndarray, "cells 8"],
    stress: Float[np.ndarray, "nodes 6"],
    free: Bool[np.ndarray, " nodes"],
) -> Equations:
    """Equations from corner features and F of the model and the Cauchy stress of the truth; free nodes only.

    Stress is pulled back with the mean F of a node's cells; how much F differs between them is left out here.
    """
    nodes, flat = len(stress), cells.ravel()
    count = np.bincount(flat, minlength=nodes).astype(float)
    mean = np.zeros((nodes, 3, 3))
    np.add.at(mean, flat, np.repeat(gradients, 8, axis=0))
    target = pull_back(stress, mean / count[:, None, None])
    mirror = np.tile(MIRROR, (len(cells), 1))
    plain = features @ plain_matrix().T
    rows, gaps = np.empty((6, free.sum(), KINDS * FEATURES)), np.empty((6, free.sum()))
    for k in range(6):
        row = np.zeros((nodes, KINDS, FEATURES))
        np.add.at(row, (flat, kinds), mirror[:, k, None] * features)
        rows[k] = (row / count[:, None, None])[free].reshape(free.sum(), -1)
        expected = np.bincount(flat, mirror[:, k] * plain[:, k], minlength=nodes) / count
        gaps[k] = (target[:, k] - expected)[free]
    return Equations(rows, gaps)


class ReadoutFit:
    """Gathers normal equations of the read-out, frame by frame, and solves them."""

    def __init__(self) -> None:
        size = KINDS * FEATURES
        self.normal = np.zeros((6, size, size))
        self.right = np.zeros((6, size))

    def add(self, equations: Equations, weight: float) -> None:
        """Adds the equations of a frame, or of a change between two."""
        for k in range(6):
            self.normal[k] += weight * equations.rows[k].T @ equations.rows[k]
            self.right[k] += weight * equations.rows[k].T @ equations.gaps[k]

    def solve(self, ridge: float = 1e-5) -> StressReadout:
        """Ridge regression towards the plain read-out; kinds that no node showed keep it."""
        readout = StressReadout.plain()
        for k in range(6):
            matrix = self.normal[k]
            pull = ridge * np.trace(matrix) / len(matrix)
            change = np.linalg.solve(matrix + pull * np.eye(len(matrix)), self.right[k])
            readout.matrices[:, k] += change.reshape(KINDS, FEATURES)
        return readout
