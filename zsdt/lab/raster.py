"""Where every pixel of a picture lies on a curved surface: triangles of a projected lattice, filled by scan."""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

OUTSIDE = -1e4  # coordinate that no texture has; cv2.remap then takes its border value


@numba.njit(cache=True, nogil=True)
@no_type_check
def _fill(pixels, attributes, left, top, out):
    """Interpolates `attributes` over both triangles of every cell that faces the camera; see `surface_map`."""
    rows, columns = out.shape[0], out.shape[1]
    count = attributes.shape[2]
    filled = 0
    corner = np.empty((3, 2), np.int64)
    for i in range(pixels.shape[0] - 1):
        for j in range(pixels.shape[1] - 1):
            for half in range(2):
                corner[0, 0], corner[0, 1] = i, j
                corner[1, 0], corner[1, 1] = i + 1, j + half
                corner[2, 0], corner[2, 1] = i + 1 - half, j + 1
                x0 = pixels[i, j, 0] - left
                y0 = pixels[i, j, 1] - top
                x1 = pixels[corner[1, 0], corner[1, 1], 0] - left
                y1 = pixels[corner[1, 0], corner[1, 1], 1] - top
                x2 = pixels[corner[2, 0], corner[2, 1], 0] - left
                y2 = pixels[corner[2, 0], corner[2, 1], 1] - top
                area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
                if not area < -1e-6:  # seen from behind, edge-on, or not a number
                    continue
                low = max(int(np.floor(min(y0, y1, y2))), 0)
                high = min(int(np.ceil(max(y0, y1, y2))), rows - 1)
                first = max(int(np.floor(min(x0, x1, x2))), 0)
                last = min(int(np.ceil(max(x0, x1, x2))), columns - 1)
                for y in range(low, high + 1):
                    for x in range(first, last + 1):
                        b1 = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
                        b2 = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
                        b0 = 1.0 - b1 - b2
                        if b0 < -1e-6 or b1 < -1e-6 or b2 < -1e-6:
                            continue
                        filled += 1
                        for k in range(count):
                            out[y, x, k] = (
                                b0 * attributes[i, j, k]
                                + b1 * attributes[corner[1, 0], corner[1, 1], k]
                                + b2 * attributes[corner[2, 0], corner[2, 1], k]
                            )
    return filled


def surface_map(
    pixels: Float[np.ndarray, "a b 2"],
    attributes: Float[np.ndarray, "a b attributes"],
    box: tuple[int, int, int, int],
) -> Float[np.ndarray, "height width attributes"] | None:
    """Attributes of a lattice surface, linear over its triangles, at every pixel of a part of the picture.

    pixels: of the lattice points, whose outward normal is (along a) x (along b): parts that are seen from behind are
    left out. box: (left, top, right, bottom) of the part, half open. Float32; `OUTSIDE` where the surface
    is not. None where the camera sees nothing of it.
    """
    left, top, right, bottom = box
    out = np.full((bottom - top, right - left, attributes.shape[2]), OUTSIDE, np.float32)
    filled = _fill(np.ascontiguousarray(pixels), np.ascontiguousarray(attributes), float(left), float(top), out)
    return out if filled else None


def bounding_box(
    pixels: Float[np.ndarray, "*points 2"], size: tuple[int, int], margin: int
) -> tuple[int, int, int, int]:
    """(left, top, right, bottom), half open, of the part of a picture of `size` (width, height) around pixels."""
    flat = pixels.reshape(-1, 2)
    flat = flat[np.isfinite(flat).all(axis=1)]
    if not len(flat):
        return 0, 0, 0, 0
    # Points far outside are cut before they become integers.
    low = np.clip(np.floor(flat.min(axis=0)) - margin, 0, size).astype(int)
    high = np.clip(np.ceil(flat.max(axis=0)) + margin + 1, 0, size).astype(int)
    return int(low[0]), int(low[1]), int(max(high[0], low[0])), int(max(high[1], low[1]))
