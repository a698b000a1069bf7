"""Vibration modes of a body at rest: the smooth fields in which an observation corrects what no camera sees.

Noise of a fraction of a millimetre between neighbouring nodes would be a strain of a percent. The lowest modes of the
body hold almost all of its motion and stay smooth, so a correction along them moves hidden nodes as the material does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Bool, Float, Int

from zsdt.tignn.cell_energy import PATTERNS
from zsdt.tignn.cell_engine import CellEngine
from zsdt.trajectory import Body


@dataclass(frozen=True)
class Modes:
    """shapes [nodes, 3, modes] in kg^-1/2 (orthonormal in the inertia), frequency [modes] rad/s of the relaxed body,
    planar [modes]: motion in the plane of the picture."""

    shapes: Float[np.ndarray, "nodes 3 modes"]
    frequency: Float[np.ndarray, " modes"]
    planar: Bool[np.ndarray, " modes"]


def vibration_modes(engine: CellEngine, position: Float[np.ndarray, "nodes 3"], planar: int, sideways: int) -> Modes:
    """The lowest modes of the prepared body about `position` [m]: `planar` ones that the plane in the middle of the
    width mirrors into themselves, then `sideways` ones that it turns round (bending out of the picture, torsion).

    A body that is not its own mirror image gives its lowest `planar + sideways` modes.
    """
    body = engine.body
    stiffness = stiffness_matrix(engine, position)
    inertia = np.repeat(engine.inertia, 3)
    partner = mirror_partner(body.points)
    free = np.repeat(~body.clamped, 3)
    spaces: list[tuple[sp.csr_matrix, int]]
    if partner is None:
        spaces = [(sp.identity(3 * body.nodes, format="csr"), planar + sideways)]
    else:
        spaces = [(_symmetric_fields(partner, sign), count) for sign, count in ((1.0, planar), (-1.0, sideways))]
    shapes, squares = [], []
    for space, count in spaces:
        kept = space.T.multiply(free).tocsr()
        kept.eliminate_zeros()
        kept = kept[kept.getnnz(axis=1) > 0]
        count = min(count, kept.shape[0] - 2)
        if count < 1:
            continue
        k = (kept @ stiffness @ kept.T).tocsc()
        m = (kept @ sp.diags(inertia) @ kept.T).tocsc()
        start = np.linspace(1.0, 2.0, k.shape[0])  # fixed, so that the same body gives the same modes bit by bit
        value, vector = scipy.sparse.linalg.eigsh(k, count, m, sigma=0.0, v0=start)
        order = np.argsort(value)
        shapes.append(kept.T @ vector[:, order])
        squares.append(value[order])
    together = np.concatenate(shapes, axis=1).reshape(body.nodes, 3, -1)
    flat = np.arange(together.shape[2]) < (len(squares[0]) if partner is not None else together.shape[2])
    return Modes(np.ascontiguousarray(together), np.sqrt(np.maximum(np.concatenate(squares), 1e-6)), flat)


class ModeWarp:
    """Modes of the body at rest, turned along with the body as it bends.

    A mode is a field of small strains; its displacements belong to the shape at which it was computed. In a bent beam
    they would stretch it. So the differences of a mode along the edges of the grid are turned by the local rotation,
    and the field with these differences (least squares, clamp fixed) is the mode of the bent body.
    """

    def __init__(self, body: Body, modes: Modes, rest: Float[np.ndarray, "nodes 3"]):
        self.modes, self.body = modes, body
        edges, nodes = np.arange(len(body.pairs)), body.nodes
        ones = np.ones(len(edges))
        difference = sp.csr_matrix(
            (np.r_[ones, -ones], (np.r_[edges, edges], np.r_[body.pairs[:, 1], body.pairs[:, 0]])), (len(edges), nodes)
        )
        self.free = np.flatnonzero(~body.clamped)
        self.gather = difference[:, self.free].T.tocsr()
        # Dense: for some hundred nodes a product is far quicker than sparse triangles.
        self.inverse = np.linalg.inv((self.gather @ self.gather.T).toarray())
        self.differences = (difference @ modes.shapes.reshape(nodes, -1)).reshape(len(edges), 3, -1)
        self.around = _cells_of_edges(body)
        self.back = self._rotations(rest - body.points).transpose(0, 2, 1)

    def _rotations(self, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "cells 3 3"]:
        """Rotation of each cell: of F at its centre."""
        slope = np.einsum("an,cni->cia", PATTERNS[:3] / (4 * self.body.pitch), u[self.body.cells])
        left, _, right = np.linalg.svd(np.eye(3) + slope)
        return left @ right

    def shapes(self, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3 modes"]:
        """Shapes of the modes at displacements u [m]."""
        turned = self._rotations(u) @ self.back
        of_edges = (self.around @ turned.reshape(len(turned), 9)).reshape(-1, 3, 3)
        wanted = of_edges @ self.differences
        right = self.gather @ wanted.reshape(len(wanted), -1)
        shapes = np.zeros_like(self.modes.shapes)
        shapes[self.free] = (self.inverse @ right).reshape(len(self.free), 3, -1)
        return shapes


def _cells_of_edges(body: Body) -> sp.csr_matrix:
    """Matrix [edges, cells] that averages over the cells which share an edge."""
    nodes, count = body.nodes, len(body.cells)
    touch = sp.csr_matrix(
        (np.ones(body.cells.size), (body.cells.ravel(), np.repeat(np.arange(count), 8))), (nodes, count)
    )
    both = touch[body.pairs[:, 0]].multiply(touch[body.pairs[:, 1]]).tocsr()
    return sp.csr_matrix(sp.diags(1.0 / np.asarray(both.sum(axis=1)).ravel()) @ both)


def stiffness_matrix(engine: CellEngine, position: Float[np.ndarray, "nodes 3"]) -> sp.csr_matrix:
    """Relaxed tangent stiffness [3 nodes, 3 nodes] N/m about `position` [m], by differences of the internal force.

    Nodes three cells apart share no cell, so 27 groups of nodes can be moved at once.
    """
    body = engine.body
    place = np.rint((body.points - body.points.min(axis=0)) / body.pitch).astype(np.int64)
    colour = (place % 3) @ np.array([1, 3, 9])
    touch = sp.csr_matrix((np.ones(body.cells.size), (body.cells.ravel(), np.repeat(np.arange(len(body.cells)), 8))))
    near = sp.coo_matrix(touch @ touch.T)
    step = 1e-4 * body.pitch
    rows, columns, values = [], [], []
    for group in range(27):
        picked = colour == group
        if not picked.any():
            continue
        pair = picked[near.col]
        receiver, source = near.row[pair], near.col[pair]
        for axis in range(3):
            move = np.zeros_like(position)
            move[picked, axis] = step
            change = engine.internal_force(position - move) - engine.internal_force(position + move)
            for component in range(3):
                rows.append(3 * receiver + component)
                columns.append(3 * source + axis)
                values.append(change[receiver, component] / (2 * step))
    size = 3 * body.nodes
    matrix = sp.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (size, size))
    return 0.5 * (matrix + matrix.T)


def mirror_partner(points: Float[np.ndarray, "nodes 3"]) -> Int[np.ndarray, " nodes"] | None:
    """Mirror image of each node in the plane through the middle of the width; None where there is none."""
    image = points.copy()
    image[:, 1] = points[:, 1].min() + points[:, 1].max() - points[:, 1]
    ours, theirs = (np.lexsort(np.round(p, 7).T) for p in (points, image))
    if not np.allclose(points[ours], image[theirs], atol=1e-6):
        return None
    partner = np.empty(len(points), np.int64)
    partner[ours] = theirs
    return partner


def _symmetric_fields(partner: Int[np.ndarray, " nodes"], sign: float) -> sp.csr_matrix:
    """Orthonormal basis [3 nodes, fields] of the fields that a mirror maps to `sign` times themselves."""
    nodes = np.arange(len(partner))
    rows, columns, values, count = [], [], [], 0
    for axis in range(3):
        parity = sign * (-1.0 if axis == 1 else 1.0)
        for node in nodes[nodes <= partner]:
            other = partner[node]
            if other == node:
                if parity < 0:
                    continue
                entries = [(node, 1.0)]
            else:
                entries = [(node, 0.5**0.5), (other, parity * 0.5**0.5)]
            for which, value in entries:
                rows.append(3 * which + axis)
                columns.append(count)
                values.append(value)
            count += 1
    return sp.csr_matrix((values, (rows, columns)), (3 * len(partner), count))
