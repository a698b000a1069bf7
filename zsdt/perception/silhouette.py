"""Which pixels of the first frame belong to the body: the union of the cells of its grid."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

RAMP = 2.0  # px over which a pixel inside the outline comes to count in full
SUBPIXEL = 4  # binary digits behind the point of OpenCV's polygon corners


def grid_cells(edges: Int[np.ndarray, "edges 2"], nodes: int) -> Int[np.ndarray, "cells 4"]:
    """Four-sided cells of a grid given by its edges: corners in cyclic order, each cell once."""
    near: list[set[int]] = [set() for _ in range(nodes)]
    for left, right in edges.tolist():
        near[left].add(right)
        near[right].add(left)
    cells: dict[frozenset[int], tuple[int, int, int, int]] = {}
    for node in range(nodes):
        around = sorted(near[node])
        for place, one in enumerate(around):
            for other in around[place + 1 :]:
                for opposite in near[one] & near[other] - {node}:
                    cells.setdefault(frozenset((node, one, opposite, other)), (node, one, opposite, other))
    return np.array(sorted(cells.values()), dtype=np.int64).reshape(-1, 4)


def silhouette(
    shape: tuple[int, int],
    pixels: Float[np.ndarray, "nodes 2"],
    cells: Int[np.ndarray, "cells 4"],
    inset: int,
) -> Float32[np.ndarray, "h w"]:
    """How much a pixel counts: 1 inside the grid's cells, 0 outside; 1 everywhere where the grid has no cell.

    shape: height and width of the image. inset: pixels by which the outline is drawn in, because those at the very
    edge mix the body with what is behind it; over the next two pixels the weight grows to 1.
    """
    if not len(cells):
        return np.ones(shape, np.float32)
    inside = np.zeros(shape, np.uint8)
    corners = np.rint(pixels * 2**SUBPIXEL).astype(np.int32)
    for cell in cells:
        cv2.fillConvexPoly(inside, corners[cell], 1, shift=SUBPIXEL)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    return np.clip((depth - inset) / RAMP, 0.0, 1.0).astype(np.float32)
