"""Pictures of a painted grid with nodes known in closed form: a cantilever bent to an arc of a circle."""

from dataclasses import dataclass

import cv2
import numpy as np

FINE = 4  # times the resolution at which lines are drawn before they are averaged down


@dataclass(frozen=True)
class Face:
    """A face of `cells` squares of `pitch` px, clamped at `clamp` (u, v), bent down to a tip angle `bend` [rad]."""

    cells: tuple[int, int] = (12, 4)
    pitch: float = 40.0
    clamp: tuple[float, float] = (150.0, 200.0)
    bend: float = 0.5
    mirrored: bool = False  # clamp at the right
    size: tuple[int, int] = (960, 540)

    def pixel(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Where the material point x along and z up [pitches] is seen."""
        length = self.cells[0]
        radius = length / self.bend
        angle = x / radius
        mid = self.cells[1] / 2
        u = (radius + (z - mid)) * np.sin(angle)
        v = radius - (radius + (z - mid)) * np.cos(angle)
        place = np.stack([self.clamp[0] + self.pitch * u, self.clamp[1] + self.pitch * v], axis=-1)
        if self.mirrored:
            place[..., 0] = self.size[0] - 1 - place[..., 0]
        return place

    @property
    def nodes(self) -> np.ndarray:
        """[columns, rows, 2] px, column 0 at the clamp, row 0 at the bottom."""
        x, z = np.meshgrid(np.arange(self.cells[0] + 1.0), np.arange(self.cells[1] + 1.0), indexing="ij")
        return self.pixel(x, z)

    def outline(self) -> np.ndarray:
        """Border of the face [n, 2] px."""
        a, b = np.linspace(0, self.cells[0], 200), np.linspace(0, self.cells[1], 50)
        sides = [(a, 0 * a), (0 * b + self.cells[0], b), (a[::-1], 0 * a + self.cells[1]), (0 * b, b[::-1])]
        return np.concatenate([self.pixel(x, z) for x, z in sides])

    def coverage(self, width: float = 5.0, cut: bool = False) -> np.ndarray:
        """Share of each pixel that is painted, [h, w] in 0..1; `cut`: no paint beyond the border of the face."""
        w, h = self.size
        fine = np.zeros((h * FINE, w * FINE), np.uint8)
        a, b = np.linspace(0, self.cells[0], 200), np.linspace(0, self.cells[1], 100)
        lines = [self.pixel(a, 0 * a + k) for k in range(self.cells[1] + 1)]
        lines += [self.pixel(0 * b + k, b) for k in range(self.cells[0] + 1)]
        for line in lines:
            cv2.polylines(fine, [_fine(line)], False, 255, round(width * FINE), cv2.LINE_8, 4)
        if cut:
            inside = np.zeros_like(fine)
            cv2.fillPoly(inside, [_fine(self.outline())], 255, cv2.LINE_8, 4)
            fine = cv2.bitwise_and(fine, inside)
        return cv2.resize(fine, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32) / 255

    def picture(self, paint: np.ndarray, clamp_block: bool = True) -> np.ndarray:
        """Light face with dark lines before a mid-grey wall, and the dark block of the clamp, [h, w, 3] uint8."""
        w, h = self.size
        image = np.full((h, w, 3), 120, np.uint8)
        cv2.fillPoly(image, [np.rint(self.outline()).astype(np.int32)], (200, 205, 210))
        if clamp_block:
            foot = self.nodes[0]
            low, high = foot.min(axis=0), foot.max(axis=0)
            left = high[0] + 2 if self.mirrored else low[0] - 2 - 1.6 * self.pitch
            corner = np.array([left, low[1] - 30])
            far = np.array([left + 1.6 * self.pitch, high[1] + 30])
            cv2.rectangle(image, *(tuple(int(c) for c in np.rint(p)) for p in (corner, far)), (35, 35, 40), -1)
        return (image * (1 - paint[..., None]) + np.array([40, 30, 30]) * paint[..., None]).astype(np.uint8)


def _fine(line: np.ndarray) -> np.ndarray:
    """Pixels to sixteenths of a pixel of the fine picture."""
    return np.rint(((line + 0.5) * FINE - 0.5) * 16).astype(np.int32)


def with_holes(paint: np.ndarray, share: float, radius: int, seed: int = 0) -> np.ndarray:
    """Rubs out discs until `share` of the paint is gone."""
    rng = np.random.default_rng(seed)
    rubbed = paint.copy()
    places = np.argwhere(paint > 0.5)
    while rubbed.sum() > (1 - share) * paint.sum():
        v, u = places[rng.integers(len(places))]
        cv2.circle(rubbed, (int(u), int(v)), radius, 0.0, -1)
    return rubbed
