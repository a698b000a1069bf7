"""Whole clips of a glass with the hidden field in the liquid: a video, and a figure of moments and sides."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.twin.field_scale import FieldScale, LiquidName, scale_of
from zsdt.twin.glass_outline import GlassLines, Pixels, glass_lines
from zsdt.twin.glass_overlay import GlassOverlay, GlassOverlayOptions, LiquidFrame, draw_liquid
from zsdt.twin.glass_view import GlassTwinView
from zsdt.twin.legend import Status
from zsdt.twin.overlay_video import MISSING, Sheet, drawn_frames, sheet_of

Picture = UInt8[np.ndarray, "height width 3"]

MOST = 98.0
MOMENTS = (0, 7, 14, 21, 28, 34, 41)  # frames after t0 in the strip: the seed's first and last, and its early rest
_MARGIN = 0.15  # of the larger side of the glass, left free around it in a figure


def scale_of_glass(view: GlassTwinView, options: GlassOverlayOptions, truth: GlassTwinView | None = None) -> FieldScale:
    """One scale for all frames of a run, wide enough for the truth where it is known: a velocity fades quickly, so that
    its scale holds `MOST` percent of all particles in all frames, not all of the first."""
    sides = [view] if truth is None or not truth.shows(options.field) else [view, truth]
    scales = []
    for side in sides:
        values, top = side.values(options.field), options.top
        if top is None and options.field != LiquidName.internal_energy:
            top = max(float(np.nanpercentile(np.abs(values), MOST)), 1e-6)
        scales.append(scale_of(options.field, values, top))
    return max(scales, key=lambda scale: scale.palette.high / scale.factor)


class GlassArtist:
    """Draws the rows of one run over its pictures."""

    def __init__(self, view: GlassTwinView, options: GlassOverlayOptions, scale: FieldScale):
        self.view, self.options, self.scale = view, options, scale
        self.values = view.values(options.field)
        self.clock = view.milliseconds()
        self.vessel = view.vessel
        self.overlay: GlassOverlay | None = None

    def lines(self, k: int) -> GlassLines:
        """Lines of the glass in frame row `k`, which has particles."""
        view, row = self.view, k - self.view.start
        return glass_lines(view.camera, self.vessel, view.wall, view.origin[k], view.places, view.level[row])

    def frame(self, k: int) -> LiquidFrame | None:
        """What is drawn in frame row `k`, None before t0."""
        view, row = self.view, self.view.row_of(k)
        if row is None:
            return None
        assert view.seen_px is not None
        depth = float(view.camera.depths(view.origin[k][None])[0])
        spacing = view.body.pitch * float(view.camera.matrix[0, 0]) / max(depth, 1e-6)
        return LiquidFrame(
            view.pixels(k), self.values[row], spacing, self.lines(k), view.seen_px[row], view.outlines[k],
            alone=view.closed and bool(view.faults[k]),
        )  # fmt: skip

    def draw(self, image: Picture, k: int) -> Sheet:
        """The picture, enlarged if it is small, with the state of row `k` of the run."""
        view = self.view
        factor = max(1, math.ceil(self.options.height / image.shape[0]))
        image = enlarged(image, factor)
        if self.overlay is None:
            size = (image.shape[0], image.shape[1])
            occupied = enlarged_points(np.concatenate(self.lines(view.count - 1).vessel), factor)
            self.overlay = GlassOverlay(self.scale, size, self.options, occupied[np.isfinite(occupied).all(axis=1)])
        row = view.row_of(k)
        seen = 0 if row is None else int(np.isfinite(view.seen_level[row]).sum())  # type: ignore[index]
        status = Status(
            frame=int(view.frames[k]),
            time=float(view.times[k]),
            closed=view.closed,
            seen=seen,
            nodes=len(view.places) if row is not None and view.closed else 0,
            milliseconds=float(self.clock[k]),
            fault=view.faults[k],
            source=view.source,
            places="columns of the level",
            phase=view.phases[k],
        )
        found = self.frame(k)
        return self.overlay.draw(image, None if found is None else enlarged_frame(found, factor), status)


def enlarged(image: Picture, factor: int) -> Sheet:
    """A picture with `factor` times as many rows and columns."""
    if factor == 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)


def enlarged_points(points: Float[np.ndarray, "points 2"], factor: int) -> Float[np.ndarray, "points 2"]:
    """Pixels of a picture in the enlarged one; centres of pixels are at integers in both."""
    return (np.asarray(points, np.float64) + 0.5) * factor - 0.5


def enlarged_frame(frame: LiquidFrame, factor: int) -> LiquidFrame:
    """A frame to be drawn over the enlarged picture."""

    def all_of(lines: Sequence[Pixels]) -> list[Pixels]:
        return [enlarged_points(line, factor) for line in lines]

    lines = GlassLines(
        all_of(frame.lines.region), enlarged_points(frame.lines.level, factor), all_of(frame.lines.vessel)
    )
    return replace(
        frame,
        pixels=enlarged_points(frame.pixels, factor),
        spacing=factor * frame.spacing,
        lines=lines,
        seen=enlarged_points(frame.seen, factor),
        contour=enlarged_points(frame.contour, factor),
    )


def glass_frames(
    view: GlassTwinView,
    pictures: Iterable[tuple[int, Picture]],
    options: GlassOverlayOptions | None = None,
    scale: FieldScale | None = None,
) -> Iterator[tuple[int, Picture]]:
    """Pictures (number in the clip, BGR, in order) of a clip with the run drawn over them, and their numbers.

    A frame that the run names missing is drawn over the last picture that came; pictures that the run has no row for
    are passed over.
    """
    options = options or GlassOverlayOptions()
    artist = GlassArtist(view, options, scale or scale_of_glass(view, options))
    return drawn_frames(artist, view.frames, view.faults, pictures)


def box_of_glass(views: Sequence[GlassTwinView], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """(left, top, right, bottom), half open, of the part of a picture (height, width) around the resting glass."""
    points = []
    for view in views:
        last = view.count - 1
        lines = glass_lines(view.camera, view.vessel, view.wall, view.origin[last], view.places, view.level[-1])
        points.append(np.concatenate(lines.vessel))
    corners = np.concatenate(points)
    corners = corners[np.isfinite(corners).all(axis=1)]
    if not len(corners):
        return 0, 0, size[1], size[0]
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = _MARGIN * float((high - low).max())
    left, top = np.floor(np.clip(low - margin, 0, [size[1] - 2, size[0] - 2])).astype(int)
    right, bottom = np.ceil(np.clip(high + margin, [left + 2, top + 2], [size[1], size[0]])).astype(int)
    return int(left), int(top), int(right), int(bottom)


def moments_of(view: GlassTwinView) -> list[int]:
    """Numbers in the clip of the frames of the strip: those of the seed's figure as far as there are pictures."""
    came = [int(number) for number, fault in zip(view.frames, view.faults, strict=True) if fault != MISSING]
    first = int(view.frames[view.start])
    wanted = [first + k for k in MOMENTS if first + k <= came[-1]]
    return sorted({min(came, key=lambda number: abs(number - want)) for want in wanted if want >= first})


def _seen_in(number: int, sides: Sequence[GlassTwinView]) -> Pixels:
    """The observed level [px] in a frame, from the side that looked."""
    for side in sides:
        row = side.row_of(int(np.flatnonzero(side.frames == number)[0]))
        if row is not None and side.seen_px is not None and np.isfinite(side.seen_px[row]).any():
            return side.seen_px[row]
    return np.full((1, 2), np.nan)


def glass_comparison(
    pictures: Mapping[int, Picture], sides: Sequence[GlassTwinView], options: GlassOverlayOptions | None = None
) -> Sheet:
    """A figure as the seed's Fig. 5: a column for each picture (number in the clip), the bare pictures above, a row for
    each side below, all with the level that was seen. Times count from t0; all sides share the scale of the last one
    (the truth, where there is one).

    Raises: DataError where there are no pictures or no sides, or a side lacks a frame.
    """
    if not pictures or not sides:
        raise DataError("A comparison needs at least one picture and one side to draw on it.")
    options = options or GlassOverlayOptions()
    scale = scale_of_glass(sides[-1], options)
    first = next(iter(pictures.values()))
    factor = max(1, math.ceil(options.height / first.shape[0]))
    left, top, right, bottom = (factor * edge for edge in box_of_glass(sides, first.shape[:2]))
    rows = [[enlarged(image, factor)[top:bottom, left:right] for image in pictures.values()]]
    for side in sides:
        artist = GlassArtist(side, replace(options, vessel=False), scale)
        drawn = []
        for number, image in pictures.items():
            found = np.flatnonzero(side.frames == number)
            frame = artist.frame(int(found[0])) if len(found) else None
            if frame is None:
                raise DataError(f"The run {side.name} has no liquid in frame {number}; choose frames from t0 on.")
            frame = replace(frame, seen=_seen_in(number, sides), alone=False)
            shown = draw_liquid(enlarged(image, factor), enlarged_frame(frame, factor), scale, artist.options)
            drawn.append(shown[top:bottom, left:right])
        rows.append(drawn)
    start = sides[0].start
    since = {int(n): s - sides[0].times[start] for n, s in zip(sides[0].frames, sides[0].times, strict=True)}
    heads = [f"t = {number - int(sides[0].frames[start])} ({since[number]:.2f} s)" for number in pictures]
    return sheet_of(rows, ["picture", *[side.name for side in sides]], heads, scale)
