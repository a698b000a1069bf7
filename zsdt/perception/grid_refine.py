"""Nodes to a fraction of a pixel: where the centre lines of the paint along a column and along a row cross.

Across every edge of the lattice the probability is weighed at several places; the centroids near a node are fitted by
a line that may change its direction there, because rows of a bent beam are curved and hands draw no straight lines.
Bare Shi-Tomasi corners lie 1-3 px off (DESIGN, 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from zsdt.perception.grid_lattice import Lattice, drop_outliers, fill_holes

SAMPLES = 13  # along an edge
NEAR = 0.17  # of a pitch: how far the paint counts towards a node, as a Gaussian
ACROSS = 0.22  # of a pitch to both sides
FAINT = 0.15  # probability that counts as none
ENOUGH = 3  # centroids for a line
SCATTER = 0.02  # of a pitch: of a centroid about its line
SURE = 0.08  # of a pitch: standard deviation of a node up to which it counts as found
FARTHEST = 0.35  # of a pitch between the expected node and the crossing
CUT = 0.75  # width of an outline against the inner lines below which its outer half is missing
OUTLIER = 0.12  # of a pitch: how far a node may lie from what its neighbours say
ROUNDS = 3


@dataclass(frozen=True)
class Centroids:
    """Middle of the paint across the edges along one axis of the lattice.

    points [columns, rows, samples, 2] px, seen: where there was paint; width: of that paint [px]. Edges lead from
    (c, r) to the next column or row.
    """

    points: Float[np.ndarray, "a b samples 2"]
    seen: Bool[np.ndarray, "a b samples"]
    width: Float[np.ndarray, "a b samples"]

    @property
    def support(self) -> Float[np.ndarray, "a b"]:
        """Share of each edge that is painted."""
        return self.seen.mean(axis=-1)


@dataclass(frozen=True)
class Refined:
    """pixels [columns, rows, 2]; found: where two lines were seen to cross; support along columns' and rows' steps."""

    pixels: Lattice
    found: Bool[np.ndarray, "columns rows"]
    right: Float[np.ndarray, "a b"]
    up: Float[np.ndarray, "c d"]


def centroids(grid: Lattice, axis: int, probability: Float[np.ndarray, "h w"], pitch: float, width: float) -> Centroids:
    """Weighs the paint across every edge along `axis` (0: to the next column, 1: to the next row).

    width [px]: of a line; where much less paint is met, or it is spread like no line is, nothing was seen.
    """
    start, end = (grid[:-1], grid[1:]) if axis == 0 else (grid[:, :-1], grid[:, 1:])
    chord = end - start
    normal = np.stack([-chord[..., 1], chord[..., 0]], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    clear = float(np.clip((0.5 * width + 2.0) / pitch, 0.08, 0.3))  # of the line that crosses at the node
    base = start[..., None, :] + np.linspace(clear, 1 - clear, SAMPLES)[:, None] * chord[..., None, :]
    half = max(2.0, ACROSS * pitch)
    offset = np.linspace(-half, half, 2 * int(np.ceil(half)) + 1)
    place = base[..., None, :] + offset[:, None] * normal[..., None, None, :]
    flat = place.reshape(-1, len(offset), 2).astype(np.float32)
    paint = cv2.remap(
        np.asarray(probability, np.float32),
        flat[..., 0],
        flat[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
    )
    paint = np.where(paint > FAINT, paint, 0).astype(np.float64).reshape(place.shape[:-1])
    total = paint.sum(axis=-1)
    safe = np.maximum(total, 1e-9)
    middle = (paint @ offset) / safe
    spread = np.sqrt((paint * (offset - middle[..., None]) ** 2).sum(axis=-1) / safe)
    measured = total * (offset[1] - offset[0])
    seen = (measured > _least(measured, axis, width)) & (spread < 0.29 * max(2.0 * width, 0.3 * pitch))
    return Centroids(base + middle[..., None] * normal[..., None, :], seen, measured)


def _least(measured: Float[np.ndarray, "a b samples"], axis: int, width: float) -> Float[np.ndarray, "a b samples"]:
    """Width [px] below which paint is only the rest of a line that is partly missing: its middle would be wrong.

    The usual width of the line counts; outlines may vary more, since the edge of the face cuts them.
    """
    across = 1 - axis
    painted = measured > 0.3 * width
    number = painted.sum(axis=(axis, 2), keepdims=True)
    total = np.where(painted, measured, 0.0).sum(axis=(axis, 2), keepdims=True)
    usual = np.where(number > 0, total / np.maximum(number, 1), width)
    share = np.full(measured.shape[across], 0.6)
    share[[0, -1]] = 0.35
    shape = (-1, 1, 1) if across == 0 else (1, -1, 1)
    return np.broadcast_to(np.maximum(usual * share.reshape(shape), 0.3 * width), measured.shape)


def refine(grid: Lattice, probability: Float[np.ndarray, "h w"], pitch: float, width: float) -> Refined:
    """Moves every node of a lattice [px] to the crossing of its lines; nodes without one are filled in smoothly."""
    place = fill_holes(grid)
    for _ in range(ROUNDS):
        along_rows = centroids(place, 0, probability, pitch, width)
        along_columns = centroids(place, 1, probability, pitch, width)
        crossing, found = _cross(place, _outlines(along_rows, 0), _outlines(along_columns, 1), pitch)
        crossing = drop_outliers(np.where(found[..., None], crossing, np.nan), OUTLIER * pitch)
        found = np.isfinite(crossing[..., 0])
        if found.sum() < 4:
            break
        place = fill_holes(crossing)
    return Refined(place, found, along_rows.support, along_columns.support)


def _outlines(lines: Centroids, axis: int) -> Centroids:
    """Centroids with the outlines moved out by the half of their width that was cut off, where it was.

    A line that is centred on the edge of the face shows its inner half only. The widths of the outermost lines
    against those of the inner ones say whether that is so.
    """
    across = 1 - axis
    count = lines.points.shape[across]
    if count < 3:
        return lines
    points = lines.points.copy()
    width = np.where(lines.seen, lines.width, np.nan)
    inner = np.take(width, range(1, count - 1), axis=across)
    for end, inward in ((0, 1), (count - 1, -1)):
        outline = np.take(width, end, axis=across)
        if not (np.isfinite(outline).any() and np.isfinite(inner).any()):
            continue
        missing = float(np.nanmedian(inner) - np.nanmedian(outline))
        if missing < (1 - CUT) * np.nanmedian(inner):
            continue
        outward = np.take(points, end, axis=across) - np.take(points, end + inward, axis=across)
        outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
        if across == 0:
            points[end] += missing / 2 * outward
        else:
            points[:, end] += missing / 2 * outward
    return Centroids(points, lines.seen, lines.width)


def _around(lines: Centroids, axis: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids of the two edges next to each node [columns, rows, 2 samples, 2], which were seen, and if both were.

    A node at an end takes the two edges nearest to it on its one side.
    """
    edges = count - 1
    before = np.clip(np.arange(count) - 1, 0, max(0, edges - 2))
    after = np.minimum(before + 1, edges - 1)
    points = np.concatenate([np.take(lines.points, before, axis), np.take(lines.points, after, axis)], axis=2)
    first, second = np.take(lines.seen, before, axis), np.take(lines.seen, after, axis)
    if edges == 1:
        second = np.zeros_like(second)
    both = (first.sum(axis=-1) >= ENOUGH) & (second.sum(axis=-1) >= ENOUGH)
    return points, np.concatenate([first, second], axis=2), both


def _curves(
    place: Lattice, tangent: Lattice, lines: Centroids, axis: int, pitch: float
) -> tuple[Float[np.ndarray, "columns rows 3"], Bool[np.ndarray, "columns rows"]]:
    """Bent line o(s) = a + b s + c |s| (pitches, along `tangent` and across it) through each node's centroids.

    Least squares, twice reweighted against strangers (Huber at 0.05 pitch). False where there is too little paint.
    """
    points, seen, both = _around(lines, axis, place.shape[axis])
    relative = (points - place[:, :, None]) / pitch
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    s = np.einsum("crsk,crk->crs", relative, tangent)
    o = np.einsum("crsk,crk->crs", relative, normal)
    basis = np.stack([np.ones_like(s), s, np.abs(s)], axis=-1)
    stiff = np.zeros((*both.shape, 3))
    stiff[..., 1] = 0.01  # slopes of 0.2 and bends of 0.1 against centroids that scatter by 0.02 are to be expected
    stiff[..., 2] = np.where(both, 0.04, 1e6)  # one edge alone tells no bend
    nearness = seen * np.exp(-0.5 * (s / NEAR) ** 2) + 1e-4 * seen
    weight = nearness
    coefficients = np.zeros((*both.shape, 3))
    for _ in range(3):
        normal_matrix = np.einsum("crs,crsi,crsj->crij", weight, basis, basis)
        normal_matrix[..., range(3), range(3)] += stiff + 1e-9
        right = np.einsum("crs,crsi,crs->cri", weight, basis, o)
        coefficients = np.linalg.solve(normal_matrix, right[..., None])[..., 0]
        off = np.abs(o - np.einsum("crsi,cri->crs", basis, coefficients))
        weight = nearness * np.minimum(1.0, 0.05 / np.maximum(off, 1e-9))
    doubt = SCATTER * np.sqrt(np.linalg.inv(normal_matrix)[..., 0, 0])  # standard deviation of a
    return coefficients, (doubt < SURE) & (seen.sum(axis=-1) >= ENOUGH)


def _cross(place: Lattice, rows: Centroids, columns: Centroids, pitch: float) -> tuple[Lattice, np.ndarray]:
    """Crossing of the two lines at each node [px], by Newton's method, and where it can be trusted."""
    tangents = [_unit(np.gradient(place, axis=axis)) for axis in (0, 1)]
    fits = [
        _curves(place, tangent, lines, axis, pitch)
        for axis, (tangent, lines) in enumerate(zip(tangents, (rows, columns), strict=True))
    ]
    moved = np.zeros_like(place)
    for _ in range(4):
        residuals, slopes = [], []
        for tangent, (curve, _) in zip(tangents, fits, strict=True):
            normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
            s = (moved * tangent).sum(axis=-1)
            residuals.append(
                (moved * normal).sum(axis=-1) - (curve[..., 0] + curve[..., 1] * s + curve[..., 2] * np.abs(s))
            )
            slopes.append(normal - (curve[..., 1] + curve[..., 2] * np.sign(s))[..., None] * tangent)
        matrix = np.stack(slopes, axis=-2)
        crossing = np.abs(np.linalg.det(matrix)) > 0.3  # otherwise the lines run side by side
        matrix[~crossing] = np.eye(2)
        moved = moved - np.linalg.solve(matrix, np.stack(residuals, axis=-1)[..., None])[..., 0]
        moved = np.clip(moved, -1.0, 1.0)
    found = fits[0][1] & fits[1][1] & crossing & (np.linalg.norm(moved, axis=-1) < FARTHEST)
    return place + pitch * moved, found


def _unit(vectors: Lattice) -> Lattice:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
