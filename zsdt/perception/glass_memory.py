"""What earlier pictures of a video say about a glass: it is rigid, and only the surface of its liquid changes.

Masks of one picture flicker where the glass looks like what is behind it, and where a thick base is of the colour of
the liquid. So probabilities of the container, and those of the liquid below its surface (the inner bottom and the
sides), are averaged in the vessel's own place over the last pictures (a running mean of votes; DESIGN section 5: masks
in every frame). The surface itself is of the last picture alone: it comes without delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float
from numba import njit

from zsdt.errors import OptionError
from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_window import Box, box_of
from zsdt.perception.mask_edges import MaskEdges, read_edges

LEAST = 12  # edges without which the vessel's place is not known
STILL = 0.05  # px: a vessel that moved less is not resampled, as that would blur
REACH = 0.06  # of the container's extent: what may differ from its box in another picture
ALIKE = 4.0  # px within which rows agree on how far the glass has moved
NODS = 2.0  # px within which rim and foot agree on how far a camera moved up or down
FADES = 80.0  # px of the glass's way over which what is remembered fades
BESIDE = 2  # px: columns beside one with liquid that have the same surface


@dataclass
class MemoryOptions:
    """frames: over how many of the last pictures is averaged (1: no memory). guard: how far below the surface memory
    begins, share of the container's extent. alike: overlap (IoU) of a picture's container with the remembered one below
    which the two are not mixed; patience: pictures in a row of that kind after which memory begins anew.
    """

    frames: int = 16
    guard: float = 0.03
    alike: float = 0.6
    patience: int = 3

    def __post_init__(self) -> None:
        if min(self.frames, self.patience) < 1:
            raise OptionError("frames and patience of the memory of a glass must be at least 1.")
        if not 0 <= self.guard < 0.5 or not 0 <= self.alike < 1:
            raise OptionError("guard must lie within 0 to 0.5 and alike within 0 to 1.")


class GlassMemory:
    """Steadies the masks of one glass of a video, frame by frame; see the module.

    `seen`: pictures that are remembered. One object for each video and glass; `forget` when the glass is lost.
    """

    def __init__(self, options: MemoryOptions | None = None):
        self.options = options or MemoryOptions()
        self.forget()

    def forget(self) -> None:
        """Begins anew."""
        self.seen, self._strange, self._worth = 0, 0, 0.0
        self._known = self._next = np.zeros((3, 0, 0), np.float32)  # container; liquid below its surface; its weight
        self._place = slice(0, 0), slice(0, 0)  # what of the picture is known
        self._edges: MaskEdges | None = None  # of the container that was told last
        self._box: Box | None = None

    def steadied(self, masks: GlassMasks, box: Box) -> GlassMasks:
        """The masks of the next picture, in which the glass has the given box, with what was seen before.

        Away from the glass they are zero. A picture that shows something else (a hand in front) neither changes what is
        remembered nor is changed by it. Masks of another size begin anew.
        """
        if self.options.frames == 1:
            return masks
        if self._known.shape[1:] != masks.container.shape:
            self.forget()
            self._known, self._next = (np.zeros((3, *masks.container.shape), np.float32) for _ in range(2))
        place = _around(box if self._box is None else box.joined(self._box), masks)
        container, liquid = masks.container[place], masks.liquid[place]
        edges = read_edges(np.ascontiguousarray(container), np.ascontiguousarray(liquid))
        aside, down = self._moved(place, edges)
        last = _bounds(self._place)
        if self.seen and _overlap(container, self._known[0], _bounds(place), last, aside, down) < self.options.alike:
            self._strange += 1
            if self._strange >= self.options.patience:
                self.forget()
            return masks
        self.seen, self._strange = self.seen + 1, 0
        # Seen from elsewhere a glass looks a little different: what was remembered there counts less.
        self._worth = min(self._worth * math.exp(-abs(aside) / FADES) + 1.0, float(self.options.frames))
        newest = np.float32(1.0 / self._worth)
        told = GlassMasks(np.zeros_like(masks.container), np.zeros_like(masks.liquid), masks.window)
        _mix(
            container, liquid, self._known, self._next, _bounds(place), last, aside, down, newest,
            self._memory_begins(edges, box), told.container[place], told.liquid[place],
        )  # fmt: skip
        self._known, self._next, self._place = self._next, self._known, place
        known = np.ascontiguousarray(told.container[place])
        self._edges, found = read_edges(known, known), box_of(known > 0.5)
        self._box = None if found is None else found.moved(place[1].start, place[0].start)
        return told

    def _memory_begins(self, edges: MaskEdges, box: Box) -> Float[np.ndarray, " columns"]:
        """Row in every column below which liquid was well below the surface of its own picture; beyond all rows where
        there is no liquid."""
        surface = np.nan_to_num(edges.surface, nan=np.inf).astype(np.float32)[None]
        nearby = cv2.erode(surface, np.ones((1, 2 * BESIDE + 1), np.uint8))[0]  # the highest of the nearest columns
        return np.asarray(nearby + max(3.0, self.options.guard * box.extent), np.float64)

    def _moved(self, place: tuple[slice, slice], edges: MaskEdges) -> tuple[float, int]:
        """How far the glass has moved to the right and down in the picture [px]; down on whole px, as it stands on a
        table before a camera that at most shakes."""
        before = self._edges
        if not self.seen or before is None:
            return 0.0, 0
        aside = _shift(
            *(_differences(now, place[0], then, self._place[0], 0) + (place[1].start - self._place[1].start)
              for now, then in ((edges.left, before.left), (edges.right, before.right)))
        )  # fmt: skip
        up = [
            _differences(now, place[1], then, self._place[1], round(aside)) + (place[0].start - self._place[0].start)
            for now, then in ((edges.top, before.top), (edges.bottom, before.bottom))
        ]
        top, bottom = (_shift(side, side) for side in up)
        down = 0.5 * (top + bottom) if abs(top - bottom) < NODS else 0.0  # else one of them is not seen well
        return aside if abs(aside) >= STILL else 0.0, round(down)


@njit(cache=True, error_model="numpy")
@no_type_check
def _mix(container, liquid, known, new, place, last, aside, down, newest, begins, steady_container, steady_liquid):
    """Running means over the pictures so far, brought to where the glass is now, and the masks that they give."""
    top, left = place[0], place[2]
    whole = math.floor(aside)
    share = np.float32(aside - whole)
    kept = np.float32(1.0) - newest
    for row in range(container.shape[0]):
        v = top + row
        old = v - down
        old_row = last[0] <= old < last[1]
        for column in range(container.shape[1]):
            near = left + column - whole  # what is known there and one pixel before it came to lie here
            c = w = n = np.float32(0.0)
            if old_row:
                if last[2] <= near < last[3]:
                    one = np.float32(1.0) - share
                    c, w, n = one * known[0, old, near], one * known[1, old, near], one * known[2, old, near]
                if share > 0 and last[2] <= near - 1 < last[3]:
                    c += share * known[0, old, near - 1]
                    w += share * known[1, old, near - 1]
                    n += share * known[2, old, near - 1]
            c += newest * (container[row, column] - c)
            w, n = kept * w, kept * n
            wet = liquid[row, column]
            if row > begins[column]:
                w += wet
                n += np.float32(1.0)
                wet = w / n
            new[0, v, left + column], new[1, v, left + column], new[2, v, left + column] = c, w, n
            steady_container[row, column] = c
            steady_liquid[row, column] = min(wet, c)


@njit(cache=True, error_model="numpy")
@no_type_check
def _overlap(container, known, place, last, aside, down):
    """IoU of the container with the remembered one, by every other row."""
    shift = round(aside)
    both = either = 0
    for row in range(0, container.shape[0], 2):
        v = place[0] + row - down
        for column in range(container.shape[1]):
            u = place[2] + column - shift
            here = container[row, column] > 0.5
            there = last[0] <= v < last[1] and last[2] <= u < last[3] and known[v, u] > 0.5
            both += here and there
            either += here or there
    return both / max(either, 1)


def _bounds(place: tuple[slice, slice]) -> tuple[int, int, int, int]:
    """First row, one beyond the last, and the same of columns."""
    return place[0].start, place[0].stop, place[1].start, place[1].stop


def _around(box: Box, masks: GlassMasks) -> tuple[slice, slice]:
    """Rows and columns of the box and a little more, inside window and picture."""
    rows, columns = masks.window.inside(*masks.container.shape)
    reach = max(4, round(REACH * box.extent))
    return (
        slice(max(box.top - reach, rows.start), min(box.bottom + reach, rows.stop)),
        slice(max(box.left - reach, columns.start), min(box.right + reach, columns.stop)),
    )


def _differences(
    now: Float[np.ndarray, " _"], here: slice, then: Float[np.ndarray, " _"], there: slice, moved: int
) -> Float[np.ndarray, " _"]:
    """Edges now less those then, for the rows (columns) that both parts of the picture have, the old ones moved on."""
    first, end = max(here.start, there.start + moved), min(here.stop, there.stop + moved)
    count = max(end - first, 0)
    old = max(first - there.start - moved, 0)
    new = max(first - here.start, 0)
    return now[new : new + count] - then[old : old + count]


def _shift(left: Float[np.ndarray, " _"], right: Float[np.ndarray, " _"]) -> float:
    """How far [px] two edges moved by most rows (columns); a hand over one of them tells something else. Zero where too
    few tell."""
    sides = [side[np.isfinite(side)] for side in (left, right)]
    told = np.sort(np.concatenate(sides))
    if len(told) < LEAST:
        return 0.0
    within = np.searchsorted(told, told + ALIKE, side="right") - np.arange(len(told))
    first = told[within.argmax()]
    agreeing = [side[(side >= first) & (side <= first + ALIKE)] for side in sides]
    return float(np.mean([np.median(side) for side in agreeing if len(side)]))
