"""The skin of a hexahedral body: what a viewer can draw of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import DataError
from zsdt.trajectory import Body

# Faces of a hexahedron (local node x + 2 y + 4 z), corners counter-clockwise as seen from outside.
_FACES = np.array([[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]])


@dataclass(frozen=True)
class Surface:
    """Skin of a body.

    nodes [vertices]: which node of the body a vertex is. triangles [triangles, 3]: vertices, outward. edges
    [edges, 2]: vertices of the sharp edges of the reference shape (the twelve edges of a brick).
    """

    nodes: Int[np.ndarray, " vertices"]
    triangles: Int[np.ndarray, "triangles 3"]
    edges: Int[np.ndarray, "edges 2"]


def surface_of(body: Body) -> Surface:
    """Faces that belong to one cell only, cut into triangles, with the edges where they meet at more than 45 degrees.

    Raises: DataError where the body has no cells.
    """
    if len(body.cells) == 0:
        raise DataError("This body has no cells, so it has no surface to draw; record only bodies with cells.")
    quads = body.cells[:, _FACES].reshape(-1, 4)
    _, first, count = np.unique(np.sort(quads, axis=1), axis=0, return_index=True, return_counts=True)
    quads = quads[np.sort(first[count == 1])]
    nodes, local = np.unique(quads, return_inverse=True)
    local = local.reshape(quads.shape)
    triangles = np.concatenate([local[:, [0, 1, 2]], local[:, [0, 2, 3]]])
    return Surface(nodes, triangles, _sharp_edges(body.points[nodes], local))


def _sharp_edges(points: Float[np.ndarray, "vertices 3"], quads: Int[np.ndarray, "quads 4"]) -> np.ndarray:
    """Edges between two faces whose normals differ by more than 45 degrees."""
    normals = np.cross(points[quads[:, 2]] - points[quads[:, 0]], points[quads[:, 3]] - points[quads[:, 1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ends = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    face = np.repeat(np.arange(len(quads)), 4)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, face = ends[order], face[order]
    twins = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    bent = np.sum(normals[face[twins]] * normals[face[twins + 1]], axis=1) < np.cos(np.pi / 4)
    return ends[twins[bent]]
