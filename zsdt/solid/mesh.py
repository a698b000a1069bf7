"""The brick mesh of the solid solver: nodes, faces, lumped volumes, and the way to another grid of the same brick."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from zsdt.errors import OptionError
from zsdt.graph import BrickGrid, brick_grid
from zsdt.scene import BeamShape


class Face(Enum):
    """A side of the brick; the clamp is at the sixth."""

    top = "top"
    bottom = "bottom"
    front = "front"
    back = "back"
    tip = "tip"


# Face -> (axis of its normal, at the far end, the two axes along it, such that their cross product points outward).
FACE_AXES = {
    Face.top: (2, True, 0, 1),
    Face.bottom: (2, False, 1, 0),
    Face.front: (1, False, 0, 2),
    Face.back: (1, True, 2, 0),
    Face.tip: (0, True, 1, 2),
}


@dataclass(frozen=True)
class BrickMesh:
    """`counts` cubes of edge `edge` [m] along x, y, z; nodes run x fastest, then y, then z."""

    counts: tuple[int, int, int]
    edge: float

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and depth [m]."""
        nx, ny, nz = self.counts
        return nx * self.edge, ny * self.edge, nz * self.edge

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        nx, ny, nz = self.counts
        return (nx + 1) * (ny + 1) * (nz + 1)

    @cached_property
    def grid(self) -> BrickGrid:
        """Points [m], cells and pairs of the mesh."""
        return brick_grid(self.counts, self.edge)

    @cached_property
    def volume(self) -> Float[np.ndarray, " nodes"]:
        """Lumped reference volume of each node [m3]."""
        ends = [np.where((np.arange(n + 1) == 0) | (np.arange(n + 1) == n), 0.5, 1.0) for n in self.counts]
        return (ends[2][:, None, None] * ends[1][:, None] * ends[0]).ravel() * self.edge**3

    def face_cells(self, face: Face) -> tuple[int, int]:
        """Number of element faces along the two axes of a face (x before y before z)."""
        first, second = sorted(FACE_AXES[face][2:])
        return self.counts[first], self.counts[second]

    def patch(self, face: Face, first: tuple[int, int], second: tuple[int, int]) -> Int[np.ndarray, "faces 4"]:
        """Element faces of a patch, corners counter-clockwise as seen from outside.

        `first` and `second` are half-open ranges of element faces along the two axes of the face (x before y
        before z). Raises: OptionError where a range leaves the face or is empty.
        """
        for (low, high), count in zip((first, second), self.face_cells(face), strict=True):
            if not 0 <= low < high <= count:
                raise OptionError(
                    f"A patch over elements {low} to {high} does not fit on the {face.value} face with {count} "
                    "elements that way; choose a range inside it."
                )
        normal, far, a, b = FACE_AXES[face]
        ranges = (first, second) if a < b else (second, first)
        index = np.arange(self.nodes).reshape([n + 1 for n in self.counts[::-1]]).transpose(2, 1, 0)
        plane = np.take(index, -1 if far else 0, axis=normal)
        if a > b:
            plane = plane.T  # rows along a, columns along b
        i, j = np.meshgrid(np.arange(*ranges[0]), np.arange(*ranges[1]), indexing="ij")
        corners = [plane[i, j], plane[i + 1, j], plane[i + 1, j + 1], plane[i, j + 1]]
        return np.stack([c.ravel() for c in corners], axis=1).astype(np.int64)

    def interpolation(self, points: Float[np.ndarray, "points 3"]) -> scipy.sparse.csr_matrix:
        """Matrix [points, nodes] that interpolates nodal values trilinearly at `points` [m] of the brick.

        Its transpose spreads forces from the points to the nodes and keeps total force and first moment.
        Raises: OptionError where a point lies outside the brick.
        """
        place = points / self.edge
        if (place < -1e-6).any() or (place > np.array(self.counts) + 1e-6).any():
            raise OptionError("Some points lie outside the brick; interpolate only inside it.")
        cell = np.clip(np.floor(place + 1e-9).astype(np.int64), 0, np.array(self.counts) - 1)
        part = np.clip(place - cell, 0.0, 1.0)
        nx1, ny1 = self.counts[0] + 1, self.counts[1] + 1
        rows, columns, values = [], [], []
        for corner in range(8):
            offset = np.array([corner & 1, (corner >> 1) & 1, corner >> 2])
            weight = np.where(offset == 1, part, 1.0 - part).prod(axis=1)
            node = cell + offset
            rows.append(np.arange(len(points)))
            columns.append(node[:, 0] + nx1 * (node[:, 1] + ny1 * node[:, 2]))
            values.append(weight)
        shape = (len(points), self.nodes)
        matrix = scipy.sparse.csr_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape
        )
        matrix.eliminate_zeros()
        return matrix


def mesh_of(shape: BeamShape, edge: float) -> BrickMesh:
    """Mesh of a beam with elements of `edge` [m].

    Raises: OptionError where the edge does not divide the beam's length, width and depth.
    """
    sizes = (shape.length, shape.width, shape.depth)
    counts = tuple(round(s / edge) for s in sizes)
    if min(counts) < 1 or any(abs(n * edge - s) > 1e-6 * edge for n, s in zip(counts, sizes, strict=True)):
        raise OptionError(
            f"Elements of {100 * edge:g} cm do not fill a beam of "
            f"{' x '.join(f'{100 * s:g}' for s in sizes)} cm; choose an edge that divides all three."
        )
    return BrickMesh((counts[0], counts[1], counts[2]), edge)


@dataclass(frozen=True)
class CoarseView:
    """How a fine mesh is written on a coarser grid of the same brick whose nodes are also nodes of the fine mesh."""

    fine: BrickMesh
    coarse: BrickMesh

    @cached_property
    def picked(self) -> Int[np.ndarray, " coarse"]:
        """Fine node at each coarse node."""
        ratio = round(self.coarse.edge / self.fine.edge)
        if abs(ratio * self.fine.edge - self.coarse.edge) > 1e-9 or ratio < 1:
            raise OptionError(
                f"Output at {100 * self.coarse.edge:g} cm needs a mesh that divides it, not "
                f"{100 * self.fine.edge:g} cm; choose another mesh or pitch."
            )
        i, j, k = (np.arange(n + 1) * ratio for n in self.coarse.counts)
        nx1, ny1 = self.fine.counts[0] + 1, self.fine.counts[1] + 1
        return (i + nx1 * (j[:, None] + ny1 * k[:, None, None])).ravel()

    @cached_property
    def spread(self) -> scipy.sparse.csr_matrix:
        """Matrix [coarse, fine]: transposed interpolation, for forces, masses and energies."""
        return self.coarse.interpolation(self.fine.grid.points).T.tocsr()
