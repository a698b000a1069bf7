"""A painted strip that bends in an arc in front of clutter: pictures with a motion known in closed form.

A point (X along, Y across) of the strip goes to ``(1/k - Y) (sin kX, -cos kX)`` about the centre of curvature, which
is inverted by polar coordinates: where each pixel comes from is exact, and so is where each crossing goes.
"""

import cv2
import numpy as np

from zsdt.perception.local_motion import lattice_edges

TEXELS = 2  # of the texture per pixel
ROOM = 4  # px of texture beyond the strip


class BendingGrid:
    """Strip of `columns` x `rows` cells of `pitch` px, clamped at (`left`, `middle`) of a `size` (width, height)."""

    def __init__(self, seed=0, columns=14, rows=3, pitch=32.0, size=(640, 360), left=80.0, middle=150.0, line=5.0):
        self.rng = np.random.default_rng(seed)
        self.columns, self.rows, self.pitch, self.size = columns, rows, pitch, size
        self.left, self.middle = left, middle
        self.texture = self._texture(line)
        self.background = self._background()
        along = np.repeat(np.arange(columns + 1), rows + 1) * pitch
        across = (np.tile(np.arange(rows + 1), columns + 1) - rows / 2) * pitch
        self.material = np.stack([along, across], axis=1)
        self.edges = lattice_edges(columns + 1, rows + 1)

    def nodes(self, curvature):
        """Exact pixels of the crossings [nodes, 2] at a curvature [1/px]; positive bends down."""
        radius = 1.0 / curvature - self.material[:, 1]
        turn = curvature * self.material[:, 0]
        return np.stack(
            [self.left + radius * np.sin(turn), self.middle + 1.0 / curvature - radius * np.cos(turn)], axis=1
        )

    def picture(self, curvature, noise=2.0):
        """Grey picture as float32, without the camera's noise where `noise` is 0."""
        width, height = self.size
        column, row = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        side = np.sign(curvature)
        dx, dy = side * (column - self.left), side * (self.middle + 1.0 / curvature - row)
        along = np.arctan2(dx, dy) / curvature
        across = 1.0 / curvature - side * np.hypot(dx, dy)
        half = 0.5 * self.rows * self.pitch
        u = ((along + ROOM) * TEXELS).astype(np.float32)
        v = ((across + half + ROOM) * TEXELS).astype(np.float32)
        strip = cv2.remap(self.texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = np.clip(half - np.abs(across) + 0.5, 0, 1) * np.clip(along + 0.5, 0, 1)
        inside *= np.clip(self.columns * self.pitch - along + 0.5, 0, 1)
        image = self.background + inside.astype(np.float32) * (strip - self.background)
        return image + self.rng.normal(0.0, noise, image.shape).astype(np.float32) if noise else image

    def _texture(self, line):
        length, depth = self.columns * self.pitch, self.rows * self.pitch
        shape = (int((depth + 2 * ROOM) * TEXELS), int((length + 2 * ROOM) * TEXELS))
        foam = 175.0 + 12.0 * self._speckle(shape, 3) + 8.0 * self._speckle(shape, 12)
        across, along = np.mgrid[: shape[0], : shape[1]] / TEXELS - ROOM
        apart = np.full(shape, np.inf)
        for x, limit in ((along, length), (across, depth)):
            nearest = np.clip(np.rint(x / self.pitch) * self.pitch, 0, limit)
            apart = np.minimum(apart, np.abs(x - nearest))
        paint = np.clip(0.5 * line - apart + 0.5, 0, 1)
        return (foam * (1 - paint) + (40.0 + 5.0 * self._speckle(shape, 6)) * paint).astype(np.float32)

    def _background(self):
        width, height = self.size
        image = 110.0 + 25.0 * self._speckle((height, width), 8) + 20.0 * self._speckle((height, width), 40)
        for _ in range(25):
            corner = self.rng.uniform([0, 0], [width, height]).astype(int)
            cv2.rectangle(image, corner, corner + self.rng.integers(8, 60, 2), float(self.rng.uniform(20, 230)), 2)
        return cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float32)

    def _speckle(self, shape, grain):
        rough = self.rng.standard_normal((shape[0] // grain + 2, shape[1] // grain + 2)).astype(np.float32)
        return cv2.resize(rough, shape[::-1], interpolation=cv2.INTER_CUBIC)


def swing(frames, amplitude=8e-4, cycles=2.5):
    """Curvatures [1/px] of a strip that is let go and swings about a sagging rest; never exactly straight."""
    phase = np.linspace(0, 2 * np.pi * cycles, frames) - 0.5 * np.pi
    curvature = 2e-4 + amplitude * np.sin(phase)
    return np.where(np.abs(curvature) < 1e-7, 1e-7, curvature)


def grey(image):
    """Eight bits, as a camera gives them."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
