"""Where is a patch of the first frame in this one? Inverse compositional Lucas-Kanade under changing light.

Frame-to-frame tracking drifts: every frame adds its own small error. Here a node is always held against its
appearance in the *first* frame, warped by the local affine motion of the grid, so that errors do not add up. This is
what digital image correlation does (Pan, Li and Tong 2013, inverse compositional Gauss-Newton).

Around a node the present image J, sampled on the warped window, is explained by the first image T as
``J(W d) = a T(d + s) + b + (c . d) T(d)``, W the warp of the window: a shift s, a gain a, an offset b and a gradient c
of the light (a soft shadow). Linearised in s all six unknowns are linear, so with an orthonormal basis of the six
patterns, made once, a step costs six dot products. What is left over, after light is explained away, is a normalised
cross-correlation: it tells an occluder from the node. Only pixels inside the silhouette of the body count, since those
behind it do not move along.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from numba import njit

LEAST_CONTRAST = 2.0  # grey levels (RMS) below which a patch shows nothing
LEAST_SLOPE = 0.4  # grey levels per pixel of the patch (RMS) in its flattest direction
LEAST_SHARE = 0.2  # of a window inside the silhouette; below, the silhouette is not believed
# What a patch leaves unexplained is alike in neighbouring pixels (blur, compression, a warp that is not quite right),
# so about nine of them tell as much as one: on painted clips errors are then one to two of their estimates.
CORRELATED = 3.0
ROOM = 0.5  # px between a window and the edge of the image
LEAST_GAIN = 0.02  # of the contrast; a patch that has turned grey or negative is not the node

# Sums of these two may be reordered (SIMD); they have one caller, so there is one copy of them and one result.
_reordering: Any = njit(cache=True, fastmath=True, error_model="numpy")
_jit: Any = njit(cache=True, error_model="numpy")


@dataclass(frozen=True)
class ReferencePatches:
    """Windows around nodes in the first frame and the bases that explain later images by them.

    level: pyramid level of the images that fit (pixels of 2**level). offsets [nodes, window**2, 2]: pixels of the
    window less the node, in pixels of the full image. weight [nodes, window**2]: 0 outside of the silhouette; free
    [nodes]: its sum. basis [nodes, 6, window**2]: orthonormal under the weight, multiplied with it. triangle
    [nodes, 3, 3]: patch and its two shifts in the last three of the basis. mean [nodes]: grey level. usable [nodes]:
    enough texture in two directions.
    """

    level: int
    window: int
    offsets: Float32[np.ndarray, "nodes pixels 2"]
    basis: Float32[np.ndarray, "nodes 6 pixels"]
    weight: Float32[np.ndarray, "nodes pixels"]
    free: Float64[np.ndarray, " nodes"]
    triangle: Float64[np.ndarray, "nodes 3 3"]
    mean: Float64[np.ndarray, " nodes"]
    usable: Bool[np.ndarray, " nodes"]


@dataclass
class Alignment:
    """Where nodes were found: pixels [nodes, 2], score [nodes] (correlation, -1 to 1; 0 where the search failed),
    error [nodes] px (standard deviation of the position from what the patch leaves unexplained, inf where failed)."""

    pixels: Float64[np.ndarray, "nodes 2"]
    score: Float64[np.ndarray, " nodes"]
    error: Float64[np.ndarray, " nodes"]


def reference_patches(
    image: UInt8[np.ndarray, "h w"],
    pixels: Float[np.ndarray, "nodes 2"],
    silhouette: Float32[np.ndarray, "h w"],
    level: int,
    window: int,
) -> ReferencePatches:
    """Takes the windows of `window` x `window` pixels from the first frame at a level of its pyramid.

    pixels: of the nodes, in the full image. silhouette: 1 inside the body, 0 outside, at the size of `image`. Windows
    at the silhouette are moved inwards; the node is then no longer their middle.
    """
    scale = float(2**level)
    at = pixels / scale
    cells = np.stack(np.meshgrid(np.arange(window), np.arange(window), indexing="xy"), axis=-1).reshape(-1, 2)
    cells = cells - window // 2
    inwards = _centroid(silhouette, at, cells)
    columns_rows = np.rint(at + inwards).astype(int)[:, None] + cells
    weight = _sampled(silhouette, columns_rows)
    there = _sampled(np.ones_like(silhouette), columns_rows)
    weight = np.where(weight.mean(axis=1, keepdims=True) < LEAST_SHARE, there, weight * there)
    slopes = np.gradient(image.astype(np.float32))
    patch = _sampled(image, columns_rows)
    total = np.maximum(weight.sum(axis=1), 1.0)
    mean = (weight * patch).sum(axis=1) / total
    offsets = (columns_rows - at[:, None]) * scale
    near = offsets / (0.5 * window * scale)
    patterns = np.stack(
        [
            np.ones_like(patch),
            near[..., 0] * patch,
            near[..., 1] * patch,
            patch - mean[:, None],
            _sampled(slopes[1], columns_rows) / scale,
            _sampled(slopes[0], columns_rows) / scale,
        ],
        axis=-1,
    )
    root = np.sqrt(weight)[..., None]
    basis, triangle = np.linalg.qr(root * patterns)
    sign = np.where(np.diagonal(triangle, axis1=1, axis2=2) < 0.0, -1.0, 1.0)
    basis, triangle = basis * sign[:, None], triangle * sign[..., None]
    strength = np.diagonal(triangle, axis1=1, axis2=2)[:, 3:] / np.sqrt(total)[:, None]
    usable = (strength[:, 0] > LEAST_CONTRAST) & (scale * strength[:, 1:] > LEAST_SLOPE).all(axis=1)
    return ReferencePatches(
        level=level,
        window=window,
        offsets=np.ascontiguousarray(offsets, np.float32),
        basis=np.ascontiguousarray(np.swapaxes(root * basis, 1, 2), np.float32),
        weight=np.ascontiguousarray(weight, np.float32),
        free=weight.sum(axis=1),
        triangle=np.ascontiguousarray(triangle[:, 3:, 3:]),
        mean=mean,
        usable=usable,
    )


def align(
    patches: ReferencePatches,
    image: UInt8[np.ndarray, "h w"],
    start: Float[np.ndarray, "nodes 2"],
    warp: Float[np.ndarray, "nodes 2 5"],
    chosen: Bool[np.ndarray, " nodes"],
    reach: float | Float[np.ndarray, " nodes"],
    steps: int = 8,
    tolerance: float = 0.01,
) -> Alignment:
    """Finds the chosen nodes in an image at the patches' level of its pyramid.

    start: where to begin, in full pixels from the image's corner. warp: how the window is deformed since the first
    frame, for u and v the factors of dx, dy, dx^2, dx dy, dy^2. A node fails that goes farther than `reach` [px] from
    its start, leaves the image, or does not settle to `tolerance` [px] within `steps`.
    """
    nodes = len(start)
    found = Alignment(np.array(start, dtype=np.float64), np.zeros(nodes), np.full(nodes, np.inf))
    _align(
        image,
        float(2**patches.level),
        patches.window,
        chosen & patches.usable,
        found.pixels,
        np.ascontiguousarray(warp, np.float64),
        patches.offsets,
        patches.basis,
        patches.weight,
        patches.free,
        patches.triangle,
        patches.mean,
        np.broadcast_to(np.asarray(reach, np.float64), (nodes,)).copy(),
        steps,
        tolerance,
        found.score,
        found.error,
    )
    return found


def _centroid(
    silhouette: Float32[np.ndarray, "h w"], at: Float[np.ndarray, "nodes 2"], cells: Any
) -> Float[np.ndarray, "nodes 2"]:
    """From each node to the centroid of what its window has of the body [pixels of the image]."""
    weight = _sampled(silhouette, np.rint(at).astype(int)[:, None] + cells)
    total = weight.sum(axis=1)
    centroid = np.einsum("nk,kd->nd", weight, cells) / np.maximum(total, 1.0)[:, None]
    return np.where((total < LEAST_SHARE * len(cells))[:, None], 0.0, centroid)


def _sampled(image: Any, columns_rows: Any) -> Float[np.ndarray, "nodes pixels"]:
    """Image at whole pixels (column, row); 0 outside of it."""
    height, width = image.shape
    column, row = columns_rows[..., 0], columns_rows[..., 1]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    value = image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float64)
    return np.where(inside, value, 0.0)


@_reordering
@no_type_check
def _sample(image, x, y, warp, offsets, mean, window, patch):
    """Bilinear samples of the warped window less the mean, into `patch`; False where it leaves the image."""
    height, width = image.shape
    last = offsets.shape[0] - 1
    middle = (last + 1) // 2
    for edge in (0, window // 2, window - 1, middle - window // 2, middle + window // 2, last - window + 1,
                 last - window // 2, last):  # fmt: skip
        dx, dy = offsets[edge, 0], offsets[edge, 1]
        u = x + (warp[0, 0] + warp[0, 2] * dx + warp[0, 3] * dy) * dx + (warp[0, 1] + warp[0, 4] * dy) * dy
        v = y + (warp[1, 0] + warp[1, 2] * dx + warp[1, 3] * dy) * dx + (warp[1, 1] + warp[1, 4] * dy) * dy
        if not (u >= ROOM and v >= ROOM and u < width - 1.0 - ROOM and v < height - 1.0 - ROOM):
            return False
    one, base = np.float32(1.0), np.float32(mean)
    u0, v0 = np.float32(x), np.float32(y)
    a0, a1, a2 = np.float32(warp[0, 0]), np.float32(warp[0, 1]), np.float32(warp[0, 2])
    a3, a4, b0 = np.float32(warp[0, 3]), np.float32(warp[0, 4]), np.float32(warp[1, 0])
    b1, b2, b3, b4 = np.float32(warp[1, 1]), np.float32(warp[1, 2]), np.float32(warp[1, 3]), np.float32(warp[1, 4])
    for k in range(last + 1):
        dx, dy = offsets[k, 0], offsets[k, 1]
        u = u0 + (a0 + a2 * dx + a3 * dy) * dx + (a1 + a4 * dy) * dy
        v = v0 + (b0 + b2 * dx + b3 * dy) * dx + (b1 + b4 * dy) * dy
        column, row = int(u), int(v)
        u -= np.float32(column)
        v -= np.float32(row)
        upper = np.float32(image[row, column]) * (one - u) + np.float32(image[row, column + 1]) * u
        lower = np.float32(image[row + 1, column]) * (one - u) + np.float32(image[row + 1, column + 1]) * u
        patch[k] = upper * (one - v) + lower * v - base
    return True


@_reordering
@no_type_check
def _coordinates(patch, basis, weight, part):
    """Coordinates of a patch in the basis, into `part`; its weighted square."""
    square = np.float32(0.0)
    for k in range(patch.shape[0]):
        square += weight[k] * patch[k] * patch[k]
    for m in range(part.shape[0]):
        total = np.float32(0.0)
        for k in range(patch.shape[0]):
            total += basis[m, k] * patch[k]
        part[m] = total
    return square


@_jit
@no_type_check
def _explain(part, square, triangle):
    """Shift (along x, along y), gain, correlation and standard deviation of the shift per unit of noise's square."""
    light = part[0] * part[0] + part[1] * part[1] + part[2] * part[2]
    like = part[3] * part[3]
    rest = max(square - light - like, 1e-9)
    correlation = part[3] / np.sqrt(like + rest)
    y = part[5] / triangle[2, 2]
    x = (part[4] - triangle[1, 2] * y) / triangle[1, 1]
    gain = (part[3] - triangle[0, 1] * x - triangle[0, 2] * y) / triangle[0, 0]
    noise = max(rest - part[4] * part[4] - part[5] * part[5], 0.0)
    lean = triangle[1, 2] / (triangle[1, 1] * triangle[2, 2])
    spread = noise * (1.0 / triangle[1, 1] ** 2 + 1.0 / triangle[2, 2] ** 2 + lean * lean)
    return x, y, gain, correlation, np.sqrt(spread)


@_jit
@no_type_check
def _align(
    image, scale, window, chosen, pixels, warps, offsets, basis, weight, free, triangle, mean, reach, steps, tolerance,
    score, error,
):  # fmt: skip
    """Gauss-Newton of every chosen node; `pixels` comes with the start and leaves with the end."""
    patch = np.empty(offsets.shape[1], np.float32)
    part = np.empty(basis.shape[1], np.float64)
    for node in range(chosen.shape[0]):
        if not chosen[node]:
            continue
        x, y = pixels[node, 0], pixels[node, 1]
        warp = warps[node]
        for _ in range(steps):
            if not _sample(image, x / scale, y / scale, warp / scale, offsets[node], mean[node], window, patch):
                break
            square = _coordinates(patch, basis[node], weight[node], part)
            along_x, along_y, gain, correlation, spread = _explain(part, square, triangle[node])
            if gain < LEAST_GAIN:
                break
            # J(W d) = T(d + s): what was the node (d = 0) is now found at d = -s.
            step_x = (warp[0, 0] * along_x + warp[0, 1] * along_y) / gain
            step_y = (warp[1, 0] * along_x + warp[1, 1] * along_y) / gain
            x, y = x - step_x, y - step_y
            if (x - pixels[node, 0]) ** 2 + (y - pixels[node, 1]) ** 2 > reach[node] ** 2:
                break
            if step_x * step_x + step_y * step_y < tolerance * tolerance:
                pixels[node, 0], pixels[node, 1] = x, y
                score[node] = correlation
                error[node] = CORRELATED * spread / (gain * np.sqrt(max(free[node] - basis.shape[1], 1.0)))
                break
