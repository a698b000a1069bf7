"""Painted beams that swing in front of the virtual lab's camera, each under one difficulty that tracking must bear."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from zsdt.lab.beam_painter import BeamPainter, subframes
from zsdt.lab.stills import StillOptions, view_of
from zsdt.lab.styles import Pool, draw_style
from zsdt.perception.camera import ClampSide
from zsdt.perception.local_motion import lattice_edges

PITCH = 0.05  # m
FINE = 10  # integration steps of the beam's axis per pitch
OCCLUDED = (30, 60)  # frames in which something passes in front
SHUTTER = 0.5  # share of a frame that the shutter is open
LIGHT_PERIOD = 30  # frames


@dataclass(frozen=True)
class Difficulty:
    """What makes a scene hard: light (share by which exposure swings), noise (grey levels on top of the style's),
    shadow (a soft one passes), occluded (a bar passes in frames 30 to 60), blurred (motion blur), cycles (swings in
    100 frames), twin (a prediction is given whose displacements are wrong by this share)."""

    name: str
    light: float = 0.0
    noise: float = 0.0
    shadow: bool = False
    occluded: bool = False
    blurred: bool = False
    cycles: float = 2.5
    twin: float | None = None


DIFFICULTIES = (
    Difficulty("plain"),
    Difficulty("light", light=0.4),
    Difficulty("noise", noise=10.0),
    Difficulty("shadow", shadow=True),
    Difficulty("occlusion", occluded=True),
    Difficulty("blur", blurred=True, cycles=3.5),
    Difficulty("fast", cycles=4.0),
    Difficulty("faster, twin 20 % off", cycles=8.0, twin=0.2),
)


class SwingingBeam:
    """A beam of random size and look before a random camera, swinging in a sum of two bending shapes."""

    def __init__(self, seed: int):
        rng = np.random.default_rng([seed, 0x7ACC])
        self.seed = seed
        self.columns, self.rows = int(rng.integers(9, 18)), int(rng.integers(3, 7))
        self.beam_width = PITCH * int(rng.integers(2, 5))
        self.side = ClampSide.left if rng.random() < 0.5 else ClampSide.right
        self._sag, self._sway, self._ripple = rng.uniform(-0.1, 0.35), rng.uniform(0.25, 0.45), rng.uniform(0.05, 0.2)
        extremes = np.concatenate([self.faces(phase)[0] for phase in np.linspace(0, 2 * np.pi, 12, endpoint=False)])
        camera = view_of(rng, extremes, self.side, StillOptions())
        self.painter = BeamPainter(
            draw_style(rng, Pool.unseen),
            camera,
            columns=self.columns,
            rows=self.rows,
            pitch=PITCH,
            beam_width=self.beam_width,
            clamp_side=self.side,
        )
        self.edges: Int[np.ndarray, "edges 2"] = lattice_edges(self.columns, self.rows)

    def faces(self, phase: float) -> tuple[Float[np.ndarray, "columns rows 3"], Float[np.ndarray, "columns rows 3"]]:
        """Visible and far face [m] at a phase [rad] of the swing; plane sections, axis of constant length."""
        part = np.linspace(0.0, 1.0, FINE * (self.columns - 1) + 1)
        bend = (self._sag + self._sway * np.sin(phase)) * 2.0 * (1.0 - part)
        bend = bend + self._ripple * np.sin(2.0 * phase + 1.0) * np.pi * np.sin(2.0 * np.pi * part)
        step = PITCH / FINE
        turn = -np.concatenate([[0.0], np.cumsum(0.5 * (bend[1:] + bend[:-1])) / (len(part) - 1)])
        middle = 0.5 * (turn[1:] + turn[:-1])
        along = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * step])[::FINE]
        lift = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * step])[::FINE]
        turn = turn[::FINE]
        up = (np.arange(self.rows) - 0.5 * (self.rows - 1)) * PITCH
        x = along[:, None] - up * np.sin(turn)[:, None]
        z = 0.5 * (self.rows - 1) * PITCH + lift[:, None] + up * np.cos(turn)[:, None]
        low, high = (np.stack([x, np.full_like(x, y), z], axis=2) for y in (0.0, self.beam_width))
        return (low, high) if self.side is ClampSide.left else (high, low)

    def nodes(self, phase: float) -> Float[np.ndarray, "nodes 2"]:
        """Exact pixels of the crossings, columns from the clamp, rows from below."""
        return self.painter.node_pixels(self.faces(phase)[0]).reshape(-1, 2)

    def frames(
        self, difficulty: Difficulty, count: int
    ) -> Iterator[tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "nodes 2"]]]:
        """Pictures and the exact pixels of the crossings in each."""
        rng = np.random.default_rng([self.seed, 0xF4A])
        pace = 2.0 * np.pi * difficulty.cycles / max(count, 100)
        obstacle = _obstacle(rng, self.painter.camera.height)
        for frame in range(count):
            phase = pace * frame
            moments = [phase]
            if difficulty.blurred:
                motion = SHUTTER * np.linalg.norm(self.nodes(phase + pace) - self.nodes(phase), axis=1).max()
                moments = list(phase + pace * SHUTTER * (np.linspace(0, 1, subframes(float(motion))) - 0.5))
            exposure = 1.0 + difficulty.light * np.sin(2.0 * np.pi * frame / LIGHT_PERIOD)
            painted = self.painter.paint([self.faces(m) for m in moments], exposure=exposure, noise_seed=frame)
            truth = self.nodes(phase)
            yield _disturb(painted.image, truth, frame, difficulty, obstacle, rng), truth


def _disturb(
    image: UInt8[np.ndarray, "h w 3"],
    nodes: Float[np.ndarray, "nodes 2"],
    frame: int,
    difficulty: Difficulty,
    obstacle: UInt8[np.ndarray, "h a 3"],
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "h w 3"]:
    left, right = float(nodes[:, 0].min()), float(nodes[:, 0].max())
    if difficulty.shadow:
        middle = left - 60.0 + (right - left + 120.0) * (frame % 70) / 70.0
        apart = np.abs(np.arange(image.shape[1]) - middle)
        dim = 1.0 - 0.5 / (1.0 + np.exp((apart - 60.0) / 8.0))
        image = (image * dim[None, :, None]).astype(np.uint8)
    if difficulty.occluded and OCCLUDED[0] <= frame < OCCLUDED[1]:
        wide = obstacle.shape[1]
        travel = (frame - OCCLUDED[0]) / (OCCLUDED[1] - OCCLUDED[0] - 1)
        start = int(left + 0.15 * (right - left) + travel * 0.55 * (right - left))
        image = image.copy()
        stop = min(start + wide, image.shape[1])
        image[:, start:stop] = obstacle[:, : stop - start]
    if difficulty.noise:
        image = np.clip(image + rng.normal(0.0, difficulty.noise, image.shape), 0, 255).astype(np.uint8)
    return image


def _obstacle(rng: np.random.Generator, height: int) -> UInt8[np.ndarray, "h a 3"]:
    """A wide board with stains and a grid of its own, so that it is worth being followed by mistake."""
    wide = 150
    rough: Float32[np.ndarray, "h a"] = cv2.resize(
        rng.standard_normal((height // 6, wide // 6)).astype(np.float32), (wide, height), interpolation=cv2.INTER_CUBIC
    )
    board = np.repeat((120.0 + 25.0 * rough)[..., None], 3, axis=2) * rng.uniform(0.6, 1.2, 3)
    board[np.arange(height) % 40 < 4] *= 0.3
    board[:, np.arange(wide) % 40 < 4] *= 0.3
    return np.clip(board, 0, 255).astype(np.uint8)
