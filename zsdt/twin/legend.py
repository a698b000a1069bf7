"""What is written on the picture: panels behind text, the colour bar with its unit, the status line.

Text is set in OpenCV's own TrueType font, antialiased, in sizes that follow the height of the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.twin.field_scale import FieldScale

Picture = UInt8[np.ndarray, "height width 3"]

INK = (20, 17, 14)  # of panels
_WHITE, _SOFT = (245, 245, 245), (195, 195, 195)
_DEPTH = 0.72  # how much a panel hides
_REGULAR, _BOLD = 400, 600
_FONT = cv2.FontFace("sans")
SHIFT = 4  # bits behind the point in OpenCV's coordinates
CLOSED, OPEN, LOST = (110, 205, 90), (70, 160, 255), (70, 70, 240)


def text_size(picture_height: int) -> int:
    """Height of text [px] in a picture of `picture_height` pixels."""
    return max(10, round(picture_height / 36))


def write(
    image: Picture, text: str, place: tuple[int, int], size: int, colour: tuple[int, int, int], bold: bool = False
) -> int:
    """Writes in place; `place` is the lower left corner [px]. Returns the column where the text ends."""
    end, _ = cv2.putText(image, text, place, colour, _FONT, size, _BOLD if bold else _REGULAR)
    return int(end[0])


def text_width(text: str, size: int, bold: bool = False) -> int:
    """Width of a text [px]."""
    (x, _, width, _) = cv2.getTextSize((4096, 256), text, (0, 128), _FONT, size, _BOLD if bold else _REGULAR)
    return int(x + width)


def darken(image: Picture, top: int, left: int, height: int, width: int) -> None:
    """A panel behind text, in place; what lies outside of the picture is left out."""
    part = image[max(top, 0) : top + height, max(left, 0) : left + width]
    if part.size:
        cv2.addWeighted(part, 1.0 - _DEPTH, np.full_like(part, INK), _DEPTH, 0.0, dst=part)


def draw_ring(image: Picture, place: tuple[float, float], picture_height: int) -> None:
    """The mark of a node that the camera does not see, in place."""
    radius = round(picture_height / 120 * 2**SHIFT)
    centre = (round(place[0] * 2**SHIFT), round(place[1] * 2**SHIFT))
    cv2.circle(image, centre, radius, _WHITE, 3, cv2.LINE_AA, SHIFT)
    cv2.circle(image, centre, radius, LOST, 1, cv2.LINE_AA, SHIFT)


@dataclass(frozen=True)
class Key:
    """What a line on the picture means: words, colour (BGR), and whether the line is dashed."""

    words: str
    colour: tuple[int, int, int]
    dashed: bool = False


class Legend:
    """A colour bar with title, unit and ticks, drawn once and laid on every frame.

    outline, marks: whether the unloaded shape and lost nodes are explained; keys: further lines, one below the other.
    ticks [px from the left of the panel, value]: where the values of the scale are, for whoever reads the picture back.
    """

    def __init__(
        self,
        scale: FieldScale,
        picture_height: int,
        outline: bool = True,
        marks: bool = True,
        keys: Sequence[Key] = (),
    ):
        self.scale = scale
        size = text_size(picture_height)
        small = round(0.86 * size)
        bar_width = max(round(0.42 * picture_height), text_width(scale.label, size, bold=True))
        widest = max(text_width(scale.words(scale.ticks[k]), small) for k in (0, -1))
        side = max(round(0.8 * size), round(0.4 * size) + widest // 2)
        left, top, bar_height = side, round(1.95 * size), round(0.85 * size)
        key_base = top + bar_height + round(2.9 * size)
        self.width = bar_width + 2 * side
        self.height = key_base + round(0.65 * size) if outline or marks else top + bar_height + round(1.75 * size)
        first_key, row = self.height + round(0.9 * size), round(1.35 * size)
        self.height += row * len(keys) + (round(0.4 * size) if keys else 0)
        panel = np.full((self.height, self.width, 3), INK, np.uint8)
        write(panel, scale.label, (left, round(1.35 * size)), size, _WHITE, bold=True)
        self.bar = (slice(top, top + bar_height), slice(left, left + bar_width))
        columns = np.rint(255 * (np.arange(bar_width) / (bar_width - 1))).astype(int)
        panel[self.bar] = scale.palette.table[columns, 2::-1]
        self.ticks = []
        for value in scale.ticks:
            share = (value - scale.palette.low) / (scale.palette.high - scale.palette.low)
            column = left + round(share * (bar_width - 1))
            self.ticks.append((column, value))
            panel[top + bar_height : top + bar_height + round(0.3 * size), column] = _SOFT
            words = scale.words(value)
            where = column - text_width(words, small) // 2
            write(panel, words, (where, top + bar_height + round(1.3 * size)), small, _SOFT)
        if outline:
            for start in (0.0, 0.75, 1.5):
                begin = left + round(start * size)
                cv2.line(
                    panel, (begin, key_base - small // 3), (begin + round(0.45 * size), key_base - small // 3), _WHITE
                )
            write(panel, "unloaded shape", (left + round(2.4 * size), key_base), small, _SOFT)
        if marks:
            words = "not seen"
            where = left + bar_width - text_width(words, small)
            write(panel, words, (where, key_base), small, _SOFT)
            draw_ring(panel, (where - 0.75 * size, key_base - small / 3), picture_height)
        for number, key in enumerate(keys):
            base = first_key + number * row
            level = base - small // 3
            for start, stop in ((0.0, 0.45), (0.75, 1.2), (1.5, 1.95)) if key.dashed else ((0.0, 1.95),):
                begin, end = left + round(start * size), left + round(stop * size)
                cv2.line(panel, (begin, level), (end, level), key.colour, 2)
            write(panel, key.words, (left + round(2.4 * size), base), small, _SOFT)
        self._panel = panel
        self._solid = (255 * (panel != np.array(INK)).any(axis=2)).astype(np.uint8)

    def lay(self, image: Picture, top: int, left: int) -> None:
        """Puts the legend on the picture, in place; it must fit."""
        part = image[top : top + self.height, left : left + self.width]
        darken(image, top, left, self.height, self.width)
        cv2.copyTo(self._panel, self._solid, part)


@dataclass(frozen=True)
class Status:
    """What the line below a picture says.

    fault: why this frame was not used, empty where it was. source: what the pictures are, such as ``virtual lab``.
    places: what `seen` and `nodes` count. phase: what the twin is doing instead of predicting, such as waiting.
    """

    frame: int
    time: float
    closed: bool
    seen: int
    nodes: int
    milliseconds: float = float("nan")
    fault: str = ""
    source: str = ""
    places: str = "nodes"
    phase: str = ""


def status_height(picture_height: int) -> int:
    """Height of the status line [px]."""
    return round(1.75 * text_size(picture_height))


def draw_status(image: Picture, status: Status) -> None:
    """The line at the foot of the picture: mode, frame, time, seen nodes, milliseconds; in place."""
    height, width = image.shape[:2]
    size = round(0.9 * text_size(height))
    band = status_height(height)
    darken(image, height - band, 0, band, width)
    base = height - round(0.33 * band)
    if status.phase:
        mode, colour = status.phase, _SOFT
    elif status.fault:
        mode, colour = f"predicting: {status.fault}", LOST
    else:
        mode, colour = ("closed loop", CLOSED) if status.closed else ("open loop", OPEN)
    radius = round(0.34 * size)
    cv2.circle(image, (size, height - band // 2), radius, colour, -1, cv2.LINE_AA)
    write(image, mode, (round(1.8 * size), base), size, colour, bold=True)
    words = [f"frame {status.frame:4d}", f"{status.time:6.2f} s"]
    if status.nodes:
        words.append(f"seen {status.seen}/{status.nodes} {status.places}")
    if np.isfinite(status.milliseconds):
        words.append(f"{status.milliseconds:.1f} ms")
    gap = 1.4 * size
    place = max(round(13.5 * size), round(1.8 * size) + text_width(mode, size, bold=True) + round(gap))
    for text in words:
        partly = text.startswith("seen") and status.seen < status.nodes
        write(image, text, (place, base), size, OPEN if partly else _WHITE)
        place += round(max(text_width(text, size), 4.4 * size) + gap)
    if status.source:
        write(image, status.source, (width - text_width(status.source, size) - size, base), size, _SOFT)


def free_corner(
    panel: tuple[int, int], picture: tuple[int, int], occupied: Float[np.ndarray, "points 2"], margin: int, foot: int
) -> tuple[int, int]:
    """Top and left [px] of a panel (height, width) in that corner of the picture where it hides fewest points.

    occupied [points, 2] (u, v): what should stay in sight. foot: height [px] of the status line, which stays free.
    """
    height, width = picture
    tops, lefts = (margin, height - foot - margin - panel[0]), (width - margin - panel[1], margin)
    best, fewest = (tops[0], lefts[0]), len(occupied) + 1
    for top in tops:
        for left in lefts:
            u, v = occupied[:, 0], occupied[:, 1]
            inside = (u > left - margin) & (u < left + panel[1] + margin) & (v > top - margin)
            hidden = int(np.count_nonzero(inside & (v < top + panel[0] + margin)))
            if hidden < fewest:
                best, fewest = (top, left), hidden
    return best
