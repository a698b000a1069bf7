"""Edges of a glass and of its liquid in their masks, finer than a pixel.

An edge is where a mask of covers or probabilities crosses one half, linearly between two pixel centres; for a mask of
exact covers that is right to 0.09 px, for a sharp one to 0.5 px.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Shaped
from numba import njit

from zsdt.errors import DataError

LEAST_RUN = 3  # px of a container in a row or column; less is a speck
GAP = 2  # px inside the liquid that a flash may leave out


@dataclass(frozen=True)
class MaskEdges:
    """Edges in one picture [px], NaN where there is none.

    rows [rows]: row of each entry of left and right, the outermost edges of the container in it. columns [columns]:
    column of each entry of top and bottom (outermost edges of the container), surface (upper edge of the longest run
    of liquid, `GAP` missing pixels forgiven), depth (length of that run) and above (what of the container is over the
    surface, px). size (width, height) of the whole picture.
    """

    rows: Float[np.ndarray, " rows"]
    left: Float[np.ndarray, " rows"]
    right: Float[np.ndarray, " rows"]
    columns: Float[np.ndarray, " columns"]
    top: Float[np.ndarray, " columns"]
    bottom: Float[np.ndarray, " columns"]
    surface: Float[np.ndarray, " columns"]
    depth: Float[np.ndarray, " columns"]
    above: Float[np.ndarray, " columns"]
    size: tuple[int, int]

    @property
    def has_glass(self) -> bool:
        """Whether there is any container."""
        return bool(np.isfinite(self.left).any())

    @property
    def has_liquid(self) -> bool:
        """Whether there is any liquid."""
        return bool(np.isfinite(self.surface).any())

    def touches(self, side: str) -> bool:
        """Whether the container reaches the border of the picture: ``left``, ``right``, ``top`` or ``bottom``."""
        width, height = self.size
        with np.errstate(invalid="ignore"):
            return {
                "left": bool((self.left < 0.5).any()),
                "right": bool((self.right > width - 1.5).any()),
                "top": bool((self.top < 0.5).any()),
                "bottom": bool((self.bottom > height - 1.5).any()),
            }[side]

    def steadied(self, shift: Float[np.ndarray, "2"]) -> MaskEdges:
        """The edges as they would be had the picture not moved by `shift` (u, v) [px]; what its border cut is gone."""
        if not shift.any():
            return self
        u, v = shift
        width, height = self.size
        return replace(
            self, rows=self.rows - v, columns=self.columns - u, surface=self.surface - v,
            left=_within(self.left, width) - u, right=_within(self.right, width) - u,
            top=_within(self.top, height) - v, bottom=_within(self.bottom, height) - v,
        )  # fmt: skip


def _within(edges: Float[np.ndarray, " entries"], size: int) -> Float[np.ndarray, " entries"]:
    """Edges [px] that are not the border of a picture of `size` px; NaN for the others."""
    with np.errstate(invalid="ignore"):
        return np.where((edges > 0.5) & (edges < size - 1.5), edges, np.nan)


@njit(cache=True, error_model="numpy")
@no_type_check
def _crossing(outer, inner, half):
    """How far from the centre of the outer pixel towards the inner one the mask crosses one half."""
    return (half - outer) / (inner - outer) if inner > outer else 0.5


@njit(cache=True, error_model="numpy")
@no_type_check
def _row_edges(mask, half, left, right):
    height, width = mask.shape
    for v in range(height):
        left[v] = right[v] = np.nan
        first, last = -1, -1
        for u in range(width - LEAST_RUN + 1):
            if mask[v, u] >= half and mask[v, u + 1] >= half and mask[v, u + 2] >= half:
                first = u
                break
        if first < 0:
            continue
        for u in range(width - 1, first + LEAST_RUN - 2, -1):
            if mask[v, u] >= half and mask[v, u - 1] >= half and mask[v, u - 2] >= half:
                last = u
                break
        left[v] = first - 1.0 + _crossing(float(mask[v, first - 1]), float(mask[v, first]), half) if first else 0.0
        right[v] = (
            last + 1.0 - _crossing(float(mask[v, last + 1]), float(mask[v, last]), half)
            if last < width - 1
            else width - 1.0
        )


@njit(cache=True, error_model="numpy")
@no_type_check
def _column_edges(container, liquid, half, top, bottom, surface, depth, above):
    height, width = container.shape
    for u in range(width):
        top[u] = bottom[u] = surface[u] = np.nan
        depth[u] = above[u] = 0.0
        first, last = -1, -1
        start, best, best_start, missing = -1, 0, -1, 0
        for v in range(height):
            if container[v, u] >= half:
                first = v if first < 0 else first
                last = v
            if liquid[v, u] >= half:
                start = v if start < 0 else start
                missing = 0
                if v + 1 - start > best:
                    best, best_start = v + 1 - start, start
            elif start >= 0:
                missing += 1
                if missing > GAP:
                    start = -1
        if first < 0 or last - first + 1 < LEAST_RUN:
            continue
        top[u] = (
            first - 1.0 + _crossing(float(container[first - 1, u]), float(container[first, u]), half) if first else 0.0
        )
        bottom[u] = (
            last + 1.0 - _crossing(float(container[last + 1, u]), float(container[last, u]), half)
            if last < height - 1
            else height - 1.0
        )
        if best >= LEAST_RUN:
            v = best_start
            surface[u] = v - 1.0 + _crossing(float(liquid[v - 1, u]), float(liquid[v, u]), half) if v else 0.0
            depth[u] = best
            k = v - 1
            while k >= 0 and container[k, u] >= half:
                k -= 1
            above[u] = v - 1 - k


def read_edges(
    container: Shaped[np.ndarray, "h w"],
    liquid: Shaped[np.ndarray, "h w"],
    origin: tuple[int, int] = (0, 0),
    size: tuple[int, int] | None = None,
) -> MaskEdges:
    """Edges in the masks of one glass: probabilities 0..1 (floats) or covers 0..255 (uint8).

    origin (u, v): pixel of the whole picture at the masks' first one; size (width, height) of the whole picture, by
    default that of the masks. Raises: DataError where the masks differ in size or kind.
    """
    if container.shape != liquid.shape or container.dtype != liquid.dtype:
        raise DataError(f"The masks of glass {container.shape} and liquid {liquid.shape} must be of one size and kind.")
    half = 127.5 if container.dtype == np.uint8 else 0.5
    height, width = container.shape
    left, right = np.empty(height), np.empty(height)
    _row_edges(container, half, left, right)
    top, bottom, surface, depth, above = (np.empty(width) for _ in range(5))
    _column_edges(container, liquid, half, top, bottom, surface, depth, above)
    u, v = origin
    return MaskEdges(
        rows=np.arange(height) + float(v),
        left=left + u,
        right=right + u,
        columns=np.arange(width) + float(u),
        top=top + v,
        bottom=bottom + v,
        surface=surface + v,
        depth=depth,
        above=above,
        size=size or (width, height),
    )
