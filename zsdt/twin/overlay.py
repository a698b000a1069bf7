"""A hidden field over the picture: the coloured face, what is lost, where the body would be at rest, how its tip moved.

`draw_overlay` colours one picture. `Overlay` keeps what is the same in all frames of a clip (scale, legend, outline)
and adds it, so that a frame costs a few milliseconds.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsdt.errors import OptionError
from zsdt.twin.face_raster import FaceMap, blend, face_map
from zsdt.twin.field_scale import FieldScale, ShownName
from zsdt.twin.legend import SHIFT, Legend, Status, draw_ring, draw_status, free_corner, status_height

Picture = UInt8[np.ndarray, "height width 3"]
FacePixels = Float[np.ndarray, "columns rows 2"]
FaceValues = Float[np.ndarray, "columns rows"]
FaceFlags = Bool[np.ndarray, "columns rows"]

_DARK, _WHITE = np.array([25.0, 20.0, 15.0]), np.array([250.0, 250.0, 250.0])
_DASH, _GAP = 7.0, 6.0  # px of a dash and of the gap behind it, in a picture 540 px high
_COARSE = 8  # px: light is looked at on a grid this coarse
_TRACE_PARTS = 6  # steps in which the trace of the tip fades


@dataclass
class OverlayOptions:
    """What is drawn over the picture, and how.

    field: which one. opacity: share of the colour where a node is seen, lost_opacity where it is not (a hand in front
    stays visible). texture: how much of the picture's light and dark stays in the colour. outline: the body without
    load, dashed. trace: seconds that the trace of the tip goes back, 0 for none. legend, status, marks: whether these
    are drawn. top: upper limit of the scale in SI instead of the one from the clip.
    """

    field: ShownName = ShownName.von_mises
    opacity: float = 0.8
    lost_opacity: float = 0.4
    texture: float = 0.6
    outline: bool = True
    trace: float = 0.6
    legend: bool = True
    status: bool = True
    marks: bool = True
    top: float | None = None

    def __post_init__(self) -> None:
        shares = {"opacity": self.opacity, "lost_opacity": self.lost_opacity, "texture": self.texture}
        for name, value in shares.items():
            if not 0.0 <= value <= 1.0:
                raise OptionError(f"{name} = {value} of the overlay must lie between 0 and 1.")
        if self.trace < 0.0 or (self.top is not None and self.top <= 0.0):
            raise OptionError("trace of the overlay must not be negative, and top must be positive.")


def draw_overlay(
    image: Picture,
    pixels: FacePixels,
    values: FaceValues,
    scale: FieldScale,
    options: OverlayOptions | None = None,
    seen: FaceFlags | None = None,
) -> Picture:
    """A copy of `image` (BGR) with the field over the face, bilinear inside each cell, and the lost nodes marked.

    pixels [px]: the face's nodes in the picture. values: of the field in SI, grey where not finite. seen: nodes that
    the camera found in this frame, all if not given.
    """
    options = options or OverlayOptions()
    drawn = image.copy()
    height, width = image.shape[:2]
    flags = np.ones(values.shape, bool) if seen is None else seen
    shares = np.where(flags, options.opacity, options.lost_opacity)
    face = face_map(pixels, scale.factor * values, shares, height, width)
    window = drawn[face.window]
    table = scale.palette.table[:, 2::-1].astype(np.float32)
    bright = cv2.cvtColor(window, cv2.COLOR_BGR2GRAY) if window.size else np.zeros(face.cover.shape, np.uint8)
    middle = _light(bright, face)
    limits = (scale.palette.low, scale.palette.high)
    blend(window, face.value, face.weight, face.cover, table, *limits, options.texture, bright, middle)
    if options.marks:
        mark_lost(drawn, pixels, flags)
    return drawn


def _light(bright: UInt8[np.ndarray, "height width"], face: FaceMap) -> Float[np.ndarray, "height width"]:
    """Usual brightness of the face around each pixel [0-255]: a shadow is part of it, a pore or a painted line is not.

    Dividing by it keeps a shadow from being read as another value of the field. It is the local mean, scaled to the
    median of the face: most of the body is foam and not paint.
    """
    height, width = bright.shape
    if height < _COARSE or width < _COARSE:
        return np.full(bright.shape, 128.0, np.float32)
    small = (width // _COARSE, height // _COARSE)
    cover = cv2.resize(face.cover, small, interpolation=cv2.INTER_AREA)
    inside = cv2.resize(bright, small, interpolation=cv2.INTER_AREA) * cover
    reach = max(3, small[1] // 3 | 1)
    near, light = (cv2.blur(part, (reach, reach), borderType=cv2.BORDER_CONSTANT) for part in (cover, inside))
    mean = cv2.resize(light / np.maximum(near, 1e-3), (width, height), interpolation=cv2.INTER_LINEAR)
    sample = (slice(None, None, 4),) * 2
    on = face.cover[sample] > 0.5
    if not on.any():
        return mean
    return mean * np.float32(np.median(bright[sample][on] / np.maximum(mean[sample][on], 1.0)))


def mark_lost(image: Picture, pixels: FacePixels, seen: FaceFlags) -> None:
    """A ring at every node that the camera does not see, in place."""
    for place in pixels[~seen & np.isfinite(pixels).all(axis=2)]:
        draw_ring(image, (float(place[0]), float(place[1])), image.shape[0])


def rim_of(pixels: FacePixels) -> Float[np.ndarray, "points 2"]:
    """The closed line around a face, through its outer nodes."""
    return np.concatenate([pixels[:, 0], pixels[-1, 1:], pixels[-2::-1, -1], pixels[0, -2::-1]])


def dashes_of(line: Float[np.ndarray, "points 2"], dash: float, gap: float) -> list[Float[np.ndarray, "corners 2"]]:
    """A line cut into dashes of `dash` px with gaps of `gap` px; corners of the line stay corners."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    parts = []
    for start in np.arange(0.0, along[-1], dash + gap):
        stop = min(start + dash, along[-1])
        inner = along[(along > start) & (along < stop)]
        at = np.concatenate([[start], inner, [stop]])
        parts.append(np.stack([np.interp(at, along, line[:, k]) for k in range(2)], axis=1))
    return parts


def _fixed(line: Float[np.ndarray, "points 2"]) -> np.ndarray:
    return np.rint(line * 2**SHIFT).astype(np.int32)


@dataclass(frozen=True)
class Stamp:
    """Lines that are the same in every frame: where they are [pixels], and what to multiply and add there."""

    where: np.ndarray
    keep: np.ndarray
    add: np.ndarray

    @classmethod
    def dashed(cls, line: Float[np.ndarray, "points 2"], size: tuple[int, int]) -> Stamp:
        """Thin white dashes with a faint dark rim, which shows them on a bright wall."""
        unit = size[0] / 540
        dashes = [_fixed(d) for d in dashes_of(line, _DASH * unit, _GAP * unit)]
        dark, light = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
        cv2.polylines(dark, dashes, False, 255, 3, cv2.LINE_AA, SHIFT)
        cv2.polylines(light, dashes, False, 255, 1, cv2.LINE_AA, SHIFT)
        where = np.flatnonzero(dark)
        shade, shine = 0.4 * dark.ravel()[where, None] / 255, 0.9 * light.ravel()[where, None] / 255
        keep = (1.0 - shade) * (1.0 - shine)
        return cls(where, keep, (1.0 - shine) * shade * _DARK + shine * _WHITE)

    def press(self, image: Picture) -> None:
        """Draws in place."""
        flat = image.reshape(-1, 3)
        flat[self.where] = flat[self.where] * self.keep + self.add + 0.5


@dataclass
class Overlay:
    """The overlay of a clip.

    scale: of the field over the whole clip. size (height, width) px of the pictures. reference [px]: the face without
    load, None if unknown. occupied [points, 2] px: what the legend should not hide.
    """

    scale: FieldScale
    size: tuple[int, int]
    options: OverlayOptions = field(default_factory=OverlayOptions)
    reference: FacePixels | None = None
    occupied: Float[np.ndarray, "points 2"] = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        height = self.size[0]
        self.legend = Legend(
            self.scale, height, self.options.outline and self.reference is not None, self.options.marks
        )
        foot = status_height(height) if self.options.status else 0
        margin = round(14 * height / 540)
        self.corner = free_corner((self.legend.height, self.legend.width), self.size, self.occupied, margin, foot)
        self._outline = None if self.reference is None else Stamp.dashed(rim_of(self.reference), self.size)

    def draw(
        self,
        image: Picture,
        pixels: FacePixels,
        values: FaceValues,
        seen: FaceFlags,
        trace: Float[np.ndarray, "points 2"] | None = None,
        status: Status | None = None,
    ) -> Picture:
        """One frame: the field (SI) over the face, outline, trace of the tip (oldest first, px), legend and status."""
        drawn = draw_overlay(image, pixels, values, self.scale, self.options, seen)
        if self.options.outline and self._outline is not None:
            self._outline.press(drawn)
        if trace is not None and self.options.trace > 0.0:
            draw_trace(drawn, trace)
        if self.options.legend:
            self.legend.lay(drawn, *self.corner)
        if self.options.status and status is not None:
            draw_status(drawn, status)
        return drawn


def draw_trace(image: Picture, trace: Float[np.ndarray, "points 2"]) -> None:
    """The way of the tip, oldest point first, fading into the past, with a dot where it is now; in place."""
    known = trace[np.isfinite(trace).all(axis=1)]
    if len(known) == 0:
        return
    line = _fixed(known)
    cuts = np.unique(np.linspace(0, len(line) - 1, _TRACE_PARTS + 1).astype(int))
    for number, (start, stop) in enumerate(itertools.pairwise(cuts.tolist())):
        share = 0.25 + 0.75 * (number + 1) / (len(cuts) - 1)
        colour = tuple((share * _WHITE).tolist())
        cv2.polylines(image, [line[start : stop + 1]], False, colour, 2, cv2.LINE_AA, SHIFT)
    centre = (int(line[-1, 0]), int(line[-1, 1]))
    radius = round(image.shape[0] / 135 * 2**SHIFT)
    cv2.circle(image, centre, radius, _DARK.tolist(), -1, cv2.LINE_AA, SHIFT)
    cv2.circle(image, centre, round(0.65 * radius), _WHITE.tolist(), -1, cv2.LINE_AA, SHIFT)
