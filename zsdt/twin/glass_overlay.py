"""A hidden field of a liquid over the picture: colour inside the outline in which the liquid appears, and its level.

Particles are points inside a volume, and the picture shows its front. The colour of a pixel is the kernel-weighted mean
of the particles that lie in front of one another there: the mean over the depth, smooth from edge to edge.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.twin.face_raster import blend
from zsdt.twin.field_scale import FieldScale, LiquidName
from zsdt.twin.glass_outline import GlassLines, Pixels
from zsdt.twin.legend import SHIFT, Key, Legend, Status, draw_status, free_corner, status_height
from zsdt.twin.overlay import dashes_of

Picture = UInt8[np.ndarray, "height width 3"]

SEEN, PREDICTED, VESSEL = (80, 220, 255), (250, 250, 250), (200, 180, 150)  # BGR of the lines
_SMOOTH = 0.8  # of a particle spacing: standard deviation of the splat
_WIDE = 3.5  # times that, for the rim of the region, where particles are rare because the glass magnifies
_CALM = 0.3  # share of the opacity at the middle of a signed scale, so that the picture is seen there
_TRUST = 3e-3  # weight of the wide splat
_DASH, _GAP = 7.0, 5.0  # px in a picture 540 px high
_DIM = 128.0  # brightness that a pixel of the picture is compared with


@dataclass
class GlassOverlayOptions:
    """What is drawn over the picture, and how.

    field: which one. opacity: share of the colour, less where a signed field is near zero; lost_opacity where the twin
    predicts alone. texture: how much of the picture's light and dark stays in the colour. level: lines of the observed
    and the predicted level. vessel: its outline as the twin found it. contour: of the liquid as it was seen. legend,
    status: whether these are drawn. top: upper limit of the scale in SI instead of the one from the clip. height:
    pictures lower than this many pixels are enlarged, so that lines and words stay fine.
    """

    field: LiquidName = LiquidName.vertical_velocity
    opacity: float = 0.75
    lost_opacity: float = 0.45
    texture: float = 0.35
    level: bool = True
    vessel: bool = True
    contour: bool = False
    legend: bool = True
    status: bool = True
    top: float | None = None
    height: int = 720

    def __post_init__(self) -> None:
        shares = {"opacity": self.opacity, "lost_opacity": self.lost_opacity, "texture": self.texture}
        for name, value in shares.items():
            if not 0.0 <= value <= 1.0:
                raise OptionError(f"{name} = {value} of the overlay must lie between 0 and 1.")
        if (self.top is not None and self.top <= 0.0) or self.height < 1:
            raise OptionError("top and height of the overlay must be positive.")


@dataclass(frozen=True)
class LiquidFrame:
    """What is drawn in one frame, in pixels of the picture: particles [nodes, 2] with values [nodes] in SI and their
    spacing, the lines of the glass, the observed level [columns, 2] (NaN where not seen), the contour of the seen
    liquid; alone: whether the twin predicted without a picture."""

    pixels: Float[np.ndarray, "nodes 2"]
    values: Float[np.ndarray, " nodes"]
    spacing: float
    lines: GlassLines
    seen: Float[np.ndarray, "columns 2"]
    contour: Pixels
    alone: bool = False


def splat(
    pixels: Float[np.ndarray, "nodes 2"],
    values: Float[np.ndarray, " nodes"],
    spacing: float,
    size: tuple[int, int],
) -> Float[np.ndarray, "height width"]:
    """Kernel-weighted mean of particle values at every pixel of a window of `size` (height, width).

    pixels [px]: relative to the window; spacing [px]: of the particles. Far from all particles the value is that of the
    nearest ones. A constant stays that constant.
    """
    height, width = size
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(values)
    u, v = pixels[known].T
    # The kernel reaches over the border of the window, so particles there are kept on its rim.
    u, v = np.clip(u, 0.0, width - 1.001), np.clip(v, 0.0, height - 1.001)
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    parts = np.zeros((2, height * width))
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - du - (u - left)) * np.abs(1 - dv - (v - top))
        at = (np.minimum(top + dv, height - 1)) * width + np.minimum(left + du, width - 1)
        parts[0] += np.bincount(at, share * values[known], height * width)
        parts[1] += np.bincount(at, share, height * width)
    blurred = np.zeros((2, height, width))
    for reach, weight in ((_SMOOTH, 1.0), (_WIDE * _SMOOTH, _TRUST)):
        for part in range(2):
            blurred[part] += weight * cv2.GaussianBlur(
                parts[part].reshape(height, width), (0, 0), max(reach * spacing, 0.5), borderType=cv2.BORDER_CONSTANT
            )
    nearest = float(np.mean(values[known])) if known.any() else float("nan")
    enough = blurred[1] > 1e-12
    return np.where(enough, blurred[0] / np.where(enough, blurred[1], 1.0), nearest).astype(np.float32)


def draw_liquid(image: Picture, frame: LiquidFrame, scale: FieldScale, options: GlassOverlayOptions) -> Picture:
    """A copy of `image` (BGR) with the field inside the outline of the liquid, and the lines on it."""
    drawn = image.copy()
    polygons = [part[np.isfinite(part).all(axis=1)] for part in frame.lines.region]
    corners = np.concatenate(polygons) if polygons else np.zeros((0, 2))
    height, width = image.shape[:2]
    if len(corners):
        low = np.clip(np.floor(corners.min(axis=0)) - 2, 0, [width, height]).astype(int)
        high = np.clip(np.ceil(corners.max(axis=0)) + 3, 0, [width, height]).astype(int)
        if (high - low > 2).all():
            window = drawn[low[1] : high[1], low[0] : high[0]]
            _colour(window, polygons, low.astype(np.float64), frame, scale, options)
    _draw_lines(drawn, frame, options)
    return drawn


def _colour(
    window: UInt8[np.ndarray, "rows columns 3"],
    polygons: list[Pixels],
    corner: Float[np.ndarray, "2"],
    frame: LiquidFrame,
    scale: FieldScale,
    options: GlassOverlayOptions,
) -> None:
    """Puts the colours of the field over the liquid, in place; corner [px] of the window in the picture."""
    size = (window.shape[0], window.shape[1])
    cover = np.zeros(size, np.uint8)
    for polygon in polygons:
        part = np.zeros(size, np.uint8)
        cv2.fillPoly(part, [_fixed(polygon - corner)], 255, cv2.LINE_AA, SHIFT)
        np.maximum(cover, part, out=cover)
    value = splat(frame.pixels - corner, scale.factor * frame.values, frame.spacing, size)
    weight = np.full(size, options.lost_opacity if frame.alone else options.opacity, np.float32)
    if scale.palette.low < 0.0 < scale.palette.high:  # what does not move is hardly coloured
        weight *= _CALM + (1.0 - _CALM) * np.sqrt(np.minimum(np.abs(value) / scale.palette.high, 1.0))
    bright = cv2.cvtColor(window, cv2.COLOR_BGR2GRAY)
    around = cv2.GaussianBlur(bright.astype(np.float32), (0, 0), max(frame.spacing, 1.0))
    middle = np.clip(around, 0.3 * _DIM, None)
    table = scale.palette.table[:, 2::-1].astype(np.float32)
    limits = (scale.palette.low, scale.palette.high)
    blend(window, value, weight, (cover / np.float32(255)), table, *limits, options.texture, bright, middle)


def _draw_lines(image: Picture, frame: LiquidFrame, options: GlassOverlayOptions) -> None:
    """Vessel (dashed), contour of the seen liquid, predicted and observed level, in place."""
    unit = image.shape[0] / 540
    thick = max(1, round(1.4 * unit))
    if options.vessel:
        for line in frame.lines.vessel:
            known = line[np.isfinite(line).all(axis=1)]
            if len(known) > 1:
                dashes = [_fixed(dash) for dash in dashes_of(known, _DASH * unit, _GAP * unit)]
                cv2.polylines(image, dashes, False, VESSEL, max(1, round(unit)), cv2.LINE_AA, SHIFT)
    if options.contour and len(frame.contour) > 2:
        cv2.polylines(image, [_fixed(frame.contour)], True, SEEN, 1, cv2.LINE_AA, SHIFT)
    if options.level:
        _line(image, frame.lines.level, PREDICTED, thick)
        for run in _runs(frame.seen):
            _line(image, run, SEEN, thick)


def _line(image: Picture, line: Pixels, colour: tuple[int, int, int], thick: int) -> None:
    """A line with a dark rim, which shows it on any picture."""
    known = line[np.isfinite(line).all(axis=1)]
    if len(known) > 1:
        cv2.polylines(image, [_fixed(known)], False, (25, 20, 15), thick + 2, cv2.LINE_AA, SHIFT)
        cv2.polylines(image, [_fixed(known)], False, colour, thick, cv2.LINE_AA, SHIFT)


def _runs(points: Float[np.ndarray, "columns 2"]) -> list[Pixels]:
    """Stretches of the observed level from left to right without a gap in them."""
    known = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return [points[start:stop] for start, stop in edges.reshape(-1, 2)]


def _fixed(line: Pixels) -> np.ndarray:
    return np.rint(line * 2**SHIFT).astype(np.int32)


@dataclass
class GlassOverlay:
    """The overlay of a clip.

    scale: of the field over the whole clip. size (height, width) px of the pictures that are drawn on. occupied
    [points, 2] px: what the legend should not hide.
    """

    scale: FieldScale
    size: tuple[int, int]
    options: GlassOverlayOptions = field(default_factory=GlassOverlayOptions)
    occupied: Float[np.ndarray, "points 2"] = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        height = self.size[0]
        keys = []
        if self.options.level:
            keys += [Key("level, observed", SEEN), Key("level, predicted", PREDICTED)]
        if self.options.vessel:
            keys.append(Key("glass as the twin found it", VESSEL, dashed=True))
        self.legend = Legend(self.scale, height, outline=False, marks=False, keys=keys)
        foot = status_height(height) if self.options.status else 0
        margin = round(14 * height / 540)
        self.corner = free_corner((self.legend.height, self.legend.width), self.size, self.occupied, margin, foot)

    def draw(self, image: Picture, frame: LiquidFrame | None, status: Status | None = None) -> Picture:
        """One frame; None before the twin has a liquid."""
        drawn = image.copy() if frame is None else draw_liquid(image, frame, self.scale, self.options)
        if self.options.legend:
            self.legend.lay(drawn, *self.corner)
        if self.options.status and status is not None:
            draw_status(drawn, status)
        return drawn
