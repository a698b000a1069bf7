"""Squares of a picture that segmentation looks at: cutting one out at a working size, and putting the answer back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsdt.errors import DataError

OUTSIDE = 128  # grey level of what lies beyond the border of the picture; near zero once it is normalised


@dataclass(frozen=True)
class Window:
    """A square of a picture, in px; it may reach beyond the border. left, top: its first column and row."""

    left: int
    top: int
    side: int

    def __post_init__(self) -> None:
        if self.side < 1:
            raise DataError(f"A window of {self.side} px shows nothing; give a side of at least 1 px.")

    @classmethod
    def whole(cls, height: int, width: int) -> Window:
        """The smallest square that holds a whole picture, centred on it."""
        side = max(height, width)
        return cls((width - side) // 2, (height - side) // 2, side)

    @classmethod
    def around(cls, middle: tuple[float, float], side: float) -> Window:
        """The square of a side about a middle (u, v), on whole pixels."""
        whole = max(1, round(side))
        return cls(round(middle[0] - (whole - 1) / 2), round(middle[1] - (whole - 1) / 2), whole)

    @property
    def middle(self) -> tuple[float, float]:
        """Its middle (u, v)."""
        half = (self.side - 1) / 2
        return self.left + half, self.top + half

    def inside(self, height: int, width: int) -> tuple[slice, slice]:
        """Rows and columns of a picture that lie in the window."""
        rows = slice(min(max(self.top, 0), height), min(max(self.top + self.side, 0), height))
        columns = slice(min(max(self.left, 0), width), min(max(self.left + self.side, 0), width))
        return rows, columns


@dataclass(frozen=True)
class Box:
    """The smallest upright rectangle around something, in px: first column and row, and one beyond the last."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def middle(self) -> tuple[float, float]:
        """Its middle (u, v)."""
        return (self.left + self.right - 1) / 2, (self.top + self.bottom - 1) / 2

    @property
    def extent(self) -> int:
        """The longer of its sides."""
        return max(self.right - self.left, self.bottom - self.top)

    def moved(self, right: int, down: int) -> Box:
        """The same so many px to the right and down."""
        return Box(self.left + right, self.top + down, self.right + right, self.bottom + down)

    def joined(self, other: Box) -> Box:
        """The smallest that holds both."""
        return Box(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )


def box_of(shown: Bool[np.ndarray, "h w"] | UInt8[np.ndarray, "h w"]) -> Box | None:
    """The box around what is not zero; None where nothing is."""
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(shown).view(np.uint8))
    return Box(left, top, left + width, top + height) if width else None


def boxes_of(shown: Bool[np.ndarray, "h w"] | UInt8[np.ndarray, "h w"], smallest: float = 0.002) -> list[Box]:
    """The boxes around what hangs together, largest area first; smallest: share of the picture that counts."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(shown).view(np.uint8), connectivity=4)
    parts = [stats[k] for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= smallest * shown.size]
    parts.sort(key=lambda part: -int(part[cv2.CC_STAT_AREA]))
    return [Box(int(u), int(v), int(u + w), int(v + h)) for u, v, w, h, _ in parts]


def cut(image: UInt8[np.ndarray, "h w 3"], window: Window, size: int) -> UInt8[np.ndarray, "size size 3"]:
    """The window of a picture at the working size; grey beyond the border."""
    rows, columns = window.inside(*image.shape[:2])
    part = image[rows, columns]
    if part.shape[:2] != (window.side, window.side):
        square = np.full((window.side, window.side, 3), OUTSIDE, np.uint8)
        top, left = rows.start - window.top, columns.start - window.left
        square[top : top + part.shape[0], left : left + part.shape[1]] = part
        part = square
    if window.side == size:
        return np.ascontiguousarray(part)
    how = cv2.INTER_AREA if window.side > size else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(part, (size, size), interpolation=how), np.uint8)


def put_back(
    answer: Float[np.ndarray, "size size"], window: Window, height: int, width: int
) -> Float[np.ndarray, "height width"]:
    """What was computed of a window, at the size of the picture; zero outside the window."""
    whole = np.zeros((height, width), np.float32)
    rows, columns = window.inside(height, width)
    if rows.start < rows.stop and columns.start < columns.stop:
        if window.side != answer.shape[0]:
            # Enlarged pixel centres stay where they were; shrinking (rare) averages as `cut` does.
            how = cv2.INTER_LINEAR if window.side > answer.shape[0] else cv2.INTER_AREA
            answer = np.asarray(cv2.resize(answer, (window.side, window.side), interpolation=how), np.float32)
        top, left = rows.start - window.top, columns.start - window.left
        whole[rows, columns] = answer[top : top + rows.stop - rows.start, left : left + columns.stop - columns.start]
    return whole
