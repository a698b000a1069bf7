"""The front face of a body in the picture, as a smooth surface: what a field is worth at every pixel of it.

Each cell of the face is a quadrilateral in the picture. Inside it the field is interpolated bilinearly in the cell's
own coordinates (s, t), the shape functions of the elements, so for each pixel the bilinear map
`p(s, t) = p00 + s a + t b + s t c` is inverted in closed form: a quadratic in t whose root is the one where the
Jacobian has the sign of the cell's orientation. The rim is antialiased by its distance to the pixel's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError

_jit: Any = numba.njit(error_model="numpy", cache=True, nogil=True)

_RIM = 1.0  # px beyond the rim that still get a value, for antialiasing
_SLACK = 1e-7  # of a cell, so that no pixel falls between two cells
_TINY = 1e-9  # px^2
_GREY = 150.0  # brightness of the body under the colour, so that a dark body does not darken the field


@dataclass(frozen=True)
class FaceMap:
    """The part of the picture that the face covers: rows `top`..., columns `left`... of the image.

    value [height, width]: the field. weight [height, width]: a second nodal value, interpolated in the same way (how
    far a node is trusted). cover [height, width]: share of the pixel that lies on the face, 0 outside.
    """

    top: int
    left: int
    value: Float[np.ndarray, "height width"]
    weight: Float[np.ndarray, "height width"]
    cover: Float[np.ndarray, "height width"]

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image that the map lies on."""
        height, width = self.cover.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


def face_map(
    pixels: Float[np.ndarray, "columns rows 2"],
    values: Float[np.ndarray, "columns rows"],
    weights: Float[np.ndarray, "columns rows"] | None,
    height: int,
    width: int,
) -> FaceMap:
    """Values of a field over the face, at the pixels of an image of `height` x `width`.

    pixels [px]: where the nodes of the face are (u right, v down, centres of pixels at integers). weights: a second
    nodal value, 1 if not given. A cell with a corner that is not finite, or that has no area, is left out.

    Raises: DataError where there is no cell.
    """
    if min(pixels.shape[:2]) < 2:
        raise DataError(
            f"A face of {pixels.shape[0]} x {pixels.shape[1]} nodes has no cells to draw; it needs at least 2 x 2."
        )
    known = pixels[np.isfinite(pixels).all(axis=2)]
    if len(known) == 0:
        return FaceMap(0, 0, *(np.zeros((0, 0), np.float32) for _ in range(3)))
    low = np.clip(np.floor(known.min(axis=0) - _RIM), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(known.max(axis=0) + _RIM) + 1, 0, [width, height]).astype(int)
    size = (max(int(high[1] - low[1]), 0), max(int(high[0] - low[0]), 0))
    value, weight, cover = (np.zeros(size, np.float32) for _ in range(3))
    nodal = np.ones(values.shape) if weights is None else weights
    _fill(
        np.ascontiguousarray(pixels, np.float64) - low,
        np.ascontiguousarray(values, np.float64),
        np.ascontiguousarray(nodal, np.float64),
        value,
        weight,
        cover,
    )
    return FaceMap(int(low[1]), int(low[0]), value, weight, cover)


@_jit
@no_type_check
def _fill(pixels, values, weights, value, weight, cover):
    """Fills the maps cell by cell; pixels are relative to the maps' first pixel."""
    columns, rows = pixels.shape[:2]
    for i in range(columns - 1):
        for j in range(rows - 1):
            x0, y0 = pixels[i, j, 0], pixels[i, j, 1]
            ax, ay = pixels[i + 1, j, 0] - x0, pixels[i + 1, j, 1] - y0
            bx, by = pixels[i, j + 1, 0] - x0, pixels[i, j + 1, 1] - y0
            cx, cy = pixels[i + 1, j + 1, 0] - x0 - ax - bx, pixels[i + 1, j + 1, 1] - y0 - ay - by
            area = ax * by - ay * bx + 0.5 * (ax * cy - ay * cx + cx * by - cy * bx)
            if not abs(area) > _TINY:  # also where a corner is not finite
                continue
            # How far outside of the cell a pixel still belongs to it: only across the rim of the face.
            out = (_RIM if i == 0 else 0.0, _RIM if i == columns - 2 else 0.0)
            over = (_RIM if j == 0 else 0.0, _RIM if j == rows - 2 else 0.0)
            f00, f10, f01, f11 = _shape(values, i, j)
            w00, w10, w01, w11 = _shape(weights, i, j)
            near = _near(ax, ay, bx, by, cx, cy)
            corners = ((x0, y0), (x0 + ax, y0 + ay), (x0 + ax + bx + cx, y0 + ay + by + cy), (x0 + bx, y0 + by))
            top = min(corners[0][1], corners[1][1], corners[2][1], corners[3][1])
            bottom = max(corners[0][1], corners[1][1], corners[2][1], corners[3][1])
            for v in range(max(0, int(np.floor(top - _RIM))), min(cover.shape[0], int(np.ceil(bottom + _RIM)) + 1)):
                first, last = _span(corners, v)
                for u in range(max(0, first), min(cover.shape[1], last + 1)):
                    s, t = _place(u - x0, v - y0, ax, ay, bx, by, cx, cy, area)
                    inside = _share(s, t, ax, ay, bx, by, cx, cy, out, over, near)
                    if inside <= cover[v, u]:
                        continue
                    s, t = min(max(s, 0.0), 1.0), min(max(t, 0.0), 1.0)
                    value[v, u] = f00 + s * (f10 + t * f11) + t * f01
                    weight[v, u] = w00 + s * (w10 + t * w11) + t * w01
                    cover[v, u] = inside


@_jit
@no_type_check
def _shape(values, i, j):
    """The coefficients of 1, s, t and s t of what is bilinear in a cell."""
    first = values[i, j]
    along, up = values[i + 1, j] - first, values[i, j + 1] - first
    return first, along, up, values[i + 1, j + 1] - first - along - up


@_jit
@no_type_check
def _near(ax, ay, bx, by, cx, cy):
    """How far from its sides (s, t), in cells, a cell is wider than half a pixel for certain."""
    least = np.inf  # the Jacobian is linear in s and t, so it is smallest at a corner
    for s in (0.0, 1.0):
        for t in (0.0, 1.0):
            least = min(least, abs((ax + t * cx) * (by + s * cy) - (ay + t * cy) * (bx + s * cx)))
    longest_s = np.sqrt(max(ax * ax + ay * ay, (ax + cx) ** 2 + (ay + cy) ** 2))
    longest_t = np.sqrt(max(bx * bx + by * by, (bx + cx) ** 2 + (by + cy) ** 2))
    return longest_t / max(least, 1e-12), longest_s / max(least, 1e-12)


@_jit
@no_type_check
def _span(corners, v):
    """First and last column that a cell can reach in the row v, the rim included."""
    left, right = np.inf, -np.inf
    for k in range(4):
        (xa, ya), (xb, yb) = corners[k], corners[(k + 1) % 4]
        if ya > yb:
            xa, ya, xb, yb = xb, yb, xa, ya
        low, high = v - _RIM, v + _RIM
        if yb < low or ya > high:
            continue
        slope = (xb - xa) / max(yb - ya, 1e-12)
        one = xa + slope * (low - ya) if ya < low else xa
        other = xb - slope * (yb - high) if yb > high else xb
        left, right = min(left, one, other), max(right, one, other)
    if left > right:
        return 0, -1
    return int(np.floor(left - _RIM)), int(np.ceil(right + _RIM))


@_jit
@no_type_check
def _place(hx, hy, ax, ay, bx, by, cx, cy, area):
    """Coordinates (s, t) in the cell of the point h, seen from its first corner; NaN where there are none."""
    # cross(h - t b, a + t c) = 0
    k0 = hx * ay - hy * ax
    k1 = hx * cy - hy * cx - (bx * ay - by * ax)
    k2 = -(bx * cy - by * cx)
    below = k1 * k1 - 4.0 * k2 * k0
    if below < 0.0:
        return np.nan, np.nan
    root = np.sqrt(below) if area > 0.0 else -np.sqrt(below)
    # The form without cancellation, which also holds where k2 is 0 (a parallelogram).
    t = -2.0 * k0 / (k1 + root) if k1 * root > 0.0 else (root - k1) / (2.0 * k2)
    dx, dy = ax + t * cx, ay + t * cy
    s = (hx - t * bx) / dx if abs(dx) > abs(dy) else (hy - t * by) / dy
    return s, t


@_jit
@no_type_check
def _share(s, t, ax, ay, bx, by, cx, cy, out, over, near):
    """Share of the pixel at (s, t) that lies on the face, as far as this cell can tell: 0 outside of the cell.

    Across an inner side the cell ends exactly, across the rim the share falls from 1 to 0 within a pixel. near: how
    close to the rim, in cells, a pixel must be to be cut by it.
    """
    if not (s > -1.0 and s < 2.0 and t > -1.0 and t < 2.0):
        return 0.0
    if (out[0] == 0.0 and s < -_SLACK) or (out[1] == 0.0 and s > 1.0 + _SLACK):
        return 0.0
    if (over[0] == 0.0 and t < -_SLACK) or (over[1] == 0.0 and t > 1.0 + _SLACK):
        return 0.0
    share = 1.0
    if (out[0] > 0.0 and s < near[0]) or (out[1] > 0.0 and 1.0 - s < near[0]):
        vx, vy = bx + s * cx, by + s * cy
        reach = abs((ax + t * cx) * vy - (ay + t * cy) * vx) / np.sqrt(vx * vx + vy * vy)
        if out[0] > 0.0:
            share = min(share, 0.5 + s * reach)
        if out[1] > 0.0:
            share = min(share, 0.5 + (1.0 - s) * reach)
    if (over[0] > 0.0 and t < near[1]) or (over[1] > 0.0 and 1.0 - t < near[1]):
        ux, uy = ax + t * cx, ay + t * cy
        reach = abs(ux * (by + s * cy) - uy * (bx + s * cx)) / np.sqrt(ux * ux + uy * uy)
        if over[0] > 0.0:
            share = min(share, 0.5 + t * reach)
        if over[1] > 0.0:
            share = min(share, 0.5 + (1.0 - t) * reach)
    return max(share, 0.0)


@_jit
@no_type_check
def blend(window, value, weight, cover, table, low, high, texture, bright, middle):
    """Puts colours over `window` [height, width, 3] in place.

    table [colours, 3]: colours in the order of the picture's channels, from `low` to `high`. weight times cover is
    the share of the colour. What remains of the picture is, in the same share, its light and dark alone, so that the
    body does not tint or darken the field: brightness `bright` [height, width] relative to that around it, `middle`.
    texture: how much that shades the colour.
    """
    top = table.shape[0] - 1
    span = max(high - low, 1e-30)
    for v in range(cover.shape[0]):
        for u in range(cover.shape[1]):
            share = cover[v, u] * weight[v, u]
            if share <= 0.0:
                continue
            place = min(max((value[v, u] - low) / span, 0.0), 1.0)
            row = int(top * place + 0.5) if place == place else -1
            light = min(max(float(bright[v, u]) / max(middle[v, u], 8.0), 0.2), 1.5)
            shade = 1.0 + texture * (light - 1.0)
            for k in range(3):
                colour = min((table[row, k] if row >= 0 else 128.0) * shade, 255.0)
                under = share * _GREY * light + (1.0 - share) * window[v, u, k]
                window[v, u, k] = np.uint8(under + share * (colour - under) + 0.5)
