"""Whole clips with the hidden field on them: a video, and a figure of several moments and sides beside each other."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from zsdt.errors import DataError
from zsdt.files import atomic_path
from zsdt.twin.field_scale import FieldScale, scale_of
from zsdt.twin.legend import INK, Legend, Status, darken, text_size, text_width, write
from zsdt.twin.overlay import Overlay, OverlayOptions, draw_overlay
from zsdt.twin.twin_view import TwinView

Picture = UInt8[np.ndarray, "height width 3"]
Sheet = UInt8[np.ndarray, "tall wide 3"]

MISSING = "missing"  # the fault of a frame that never came
_MARGIN = 0.12  # of the larger side of what moves, left free around it in a figure
_GAP = 6  # px between the pictures of a figure
_PANEL = 620  # px: width of a picture of a figure, at most
_LEGEND = 760  # px: height of a picture that would have the legend and the text of a figure


def scale_of_run(view: TwinView, options: OverlayOptions, truth: TwinView | None = None) -> FieldScale:
    """One scale for all frames of a run: that of the visible face, wide enough for the truth where it is known."""
    sides = [view] if truth is None or not truth.shows(options.field) else [view, truth]
    scales = [scale_of(options.field, side.on_front(side.values(options.field)), options.top) for side in sides]
    return max(scales, key=lambda scale: scale.palette.high / scale.factor)


def overlay_pictures(
    view: TwinView,
    pictures: Iterable[tuple[int, Picture]],
    options: OverlayOptions | None = None,
    scale: FieldScale | None = None,
) -> Iterator[Picture]:
    """The pictures of `overlay_frames` without their numbers: the frames of a video."""
    return (drawn for _, drawn in overlay_frames(view, pictures, options, scale))


def overlay_frames(
    view: TwinView,
    pictures: Iterable[tuple[int, Picture]],
    options: OverlayOptions | None = None,
    scale: FieldScale | None = None,
) -> Iterator[tuple[int, Picture]]:
    """The pictures (number in the clip, BGR, in order) of a clip with the run drawn over them, and their numbers.

    A frame that the run names missing is drawn over the last picture that came; pictures that the run has no state
    for are passed over. scale: the one to use, that of the run if not given (`scale_of_run`).
    """
    options = options or OverlayOptions()
    artist = _Artist(view, options, scale or scale_of_run(view, options))
    return drawn_frames(artist, view.frames, view.faults, pictures)


@runtime_checkable
class Artist(Protocol):
    """Draws the row of a run over its picture."""

    def draw(self, image: Picture, k: int) -> Picture:
        """The picture with the state of row `k`."""


def drawn_frames(
    artist: Artist,
    frames: Int[np.ndarray, " frames"],
    faults: Sequence[str],
    pictures: Iterable[tuple[int, Picture]],
) -> Iterator[tuple[int, Picture]]:
    """Numbers and drawn pictures of a run whose rows are the `frames` of a clip (see `overlay_frames`)."""
    row = {int(frame): k for k, frame in enumerate(frames)}

    def missing(image: Picture, start: int, stop: int) -> Iterator[tuple[int, Picture]]:
        for k in range(start, stop):
            if faults[k] == MISSING:
                yield int(frames[k]), artist.draw(image, k)

    done, last = -1, None
    for number, image in pictures:
        k = row.get(number)
        if k is None:
            continue
        if last is not None:
            yield from missing(last, done + 1, k)
        yield number, artist.draw(image, k)
        done, last = k, image
    if last is not None:
        yield from missing(last, done + 1, len(frames))


class _Artist:
    """Draws the frames of one run; its overlay is made when the size of the pictures is known."""

    def __init__(self, view: TwinView, options: OverlayOptions, scale: FieldScale):
        self.view, self.options, self.scale = view, options, scale
        self.pixels, self.values = view.pixels(), view.on_front(view.values(options.field))
        self.tip, self.clock = view.tip(), view.milliseconds()
        self.overlay: Overlay | None = None

    def draw(self, image: Picture, k: int) -> Picture:
        """The picture with the state of row `k` of the run."""
        view = self.view
        assert view.seen is not None
        if self.overlay is None:
            size = (image.shape[0], image.shape[1])
            self.overlay = Overlay(self.scale, size, self.options, view.rest_pixels(), _dense(self.pixels))
        start = int(np.searchsorted(view.times, view.times[k] - self.options.trace))
        status = Status(
            frame=int(view.frames[k]),
            time=float(view.times[k]),
            closed=view.closed,
            seen=int(view.seen[k].sum()),
            nodes=view.seen[k].size,
            milliseconds=float(self.clock[k]),
            fault=view.faults[k],
            source=view.source,
        )
        trace = self.tip[start : k + 1]
        return self.overlay.draw(image, self.pixels[k], self.values[k], view.seen[k], trace, status)


def _dense(pixels: Float[np.ndarray, "frames columns rows 2"], most: int = 40) -> Float[np.ndarray, "points 2"]:
    """Nodes of the face in up to `most` frames: what a legend should not hide."""
    kept = np.unique(np.linspace(0, len(pixels) - 1, most).astype(int))
    points = pixels[kept].reshape(-1, 2)
    return points[np.isfinite(points).all(axis=1)]


def box_of(
    pixels: Sequence[Float[np.ndarray, "frames columns rows 2"]], size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """(left, top, right, bottom), half open, of the part of a picture (height, width) in which everything moves."""
    points = np.concatenate([_dense(p) for p in pixels])
    low, high = np.percentile(points, 0.5, axis=0), np.percentile(points, 99.5, axis=0)
    margin = _MARGIN * float((high - low).max())
    left, top = np.floor(np.clip(low - margin, 0, [size[1] - 2, size[0] - 2])).astype(int)
    right, bottom = np.ceil(np.clip(high + margin, [left + 2, top + 2], [size[1], size[0]])).astype(int)
    return int(left), int(top), int(right), int(bottom)


def comparison(
    pictures: Mapping[int, Picture], sides: Sequence[TwinView], options: OverlayOptions | None = None
) -> Sheet:
    """A figure: a column for each picture (number in the clip), the bare pictures above, a row for each side below.

    All sides share the scale of the last one (the truth, where there is one), whose legend stands underneath.

    Raises: DataError where there are no pictures or no sides.
    """
    if not pictures or not sides:
        raise DataError("A comparison needs at least one picture and one side to draw on it.")
    options = replace(options or OverlayOptions(), marks=False)
    scale = scale_of_run(sides[-1], options)
    first = next(iter(pictures.values()))
    left, top, right, bottom = box_of([side.pixels() for side in sides], first.shape[:2])
    rows = [[image[top:bottom, left:right] for image in pictures.values()]]
    for side in sides:
        pixels, values = side.pixels(), side.on_front(side.values(options.field))
        drawn = []
        for number, image in pictures.items():
            found = np.flatnonzero(side.frames == number)
            if len(found) == 0:
                raise DataError(f"The run {side.name} has no frame {number}; choose frames that all sides have.")
            k = int(found[0])
            shown = draw_overlay(image, pixels[k], values[k], scale, options)
            drawn.append(shown[top:bottom, left:right])
        rows.append(drawn)
    labels = ["picture", *[side.name for side in sides]]
    times = [f"{sides[0].times[np.flatnonzero(sides[0].frames == n)[0]]:.2f} s" for n in pictures]
    return sheet_of(rows, labels, times, scale)


def sheet_of(rows: list[list[Picture]], labels: list[str], heads: list[str], scale: FieldScale) -> Sheet:
    """Pictures in rows and columns, a label at the left top of each row, times in the first row, the legend below."""
    height, width = rows[0][0].shape[:2]
    shrink = min(1.0, _PANEL / width)
    height, width = round(shrink * height), round(shrink * width)
    across = len(heads) * (width + _GAP) - _GAP
    legend = Legend(scale, _LEGEND, outline=False, marks=False)
    down = len(rows) * (height + _GAP)
    sheet = np.full((down + legend.height, max(across, legend.width), 3), INK, np.uint8)
    size = text_size(_LEGEND)
    for j, (row, label) in enumerate(zip(rows, labels, strict=True)):
        for i, (image, head) in enumerate(zip(row, heads, strict=True)):
            y, x = j * (height + _GAP), i * (width + _GAP)
            sheet[y : y + height, x : x + width] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            text = f"{label}, {head}" if j == 0 else label
            darken(sheet, y, x, round(1.9 * size), text_width(text, size, bold=True) + 2 * size)
            write(sheet, text, (x + size, y + round(1.35 * size)), size, (245, 245, 245), bold=True)
    legend.lay(sheet, down, (sheet.shape[1] - legend.width) // 2)
    return sheet


def write_picture(path: str | os.PathLike[str], image: Picture) -> None:
    """Writes a PNG. Raises: DataError where the disk does not take it."""
    done, content = cv2.imencode(".png", image)
    assert done
    with atomic_path(path) as beside:
        beside.write_bytes(content.tobytes())
