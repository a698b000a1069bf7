"""Clips of glasses: a video, what the twin is told about it, and the truth that it is not told."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.lab.clips import VIDEO, _read_array, _read_json
from zsdt.perception.camera import Camera, load_camera
from zsdt.perception.video import FrameSource, open_video
from zsdt.scene import Liquid
from zsdt.trajectory import Trajectory, read_trajectory


@dataclass(frozen=True)
class GlassClipScene:
    """What the twin is told about a clip.

    liquid: its nominal card. wall, floor [m]: thickness of the wall of the glass, square to it, and below the cavity.
    glass_index, liquid_index: of refraction. section: (aspect, exponent) of the cross-section of a prism, half-width
    along y over the one along x and exponent of the superellipse; None: round. fps, gravity [m/s2]. The camera, slightly misjudged, is told beside it
    (`GlassClip.camera`): its x origin means nothing, its depth does (the axis of the vessel is at y = 0).
    """

    liquid: Liquid
    wall: float
    floor: float
    glass_index: float
    liquid_index: float
    section: tuple[float, float] | None
    fps: float
    gravity: float


@dataclass(frozen=True)
class GlassClip:
    """A clip on the disk. What the twin may use: `source`, `camera`, `scene`; all else is the truth."""

    folder: Path
    scene: GlassClipScene
    camera: Camera

    @property
    def name(self) -> str:
        """Name of the clip."""
        return self.folder.name

    def source(self) -> FrameSource:
        """Its frames."""
        frames = self.folder / "frames"
        return open_video(frames if frames.is_dir() else self.folder / VIDEO, self.scene.fps)

    @cached_property
    def truth(self) -> Trajectory:
        """What the liquid really did, in the axes of the vessel, at the times of all frames of the video.

        `body.vessel`, `body.liquid`: the lab's own; `body.motion`: history until t0, its times relative to t0. Empty
        glasses have the truth of a liquid that nobody sees.
        """
        return read_trajectory(self.folder / "truth.h5")

    @cached_property
    def hidden(self) -> dict[str, Any]:
        """The rest of the truth: t0_frame, t0_s, family, factors, style, shutter, shake and flicker of frames."""
        return _read_json(self.folder / "truth.json")

    @property
    def t0_frame(self) -> int:
        """First frame at or after the end of the excitation."""
        return int(self.hidden["t0_frame"])

    @cached_property
    def true_camera(self) -> Camera:
        """The camera that took the clip, at rest."""
        return load_camera(self.folder / "true_camera.json")

    @cached_property
    def pose(self) -> Float[np.ndarray, "frames 3"]:
        """Place [m] of the centre of the cavity's floor in the room in every frame."""
        return _read_array(self.folder / "pose.npy")

    def masks(self, frame: int) -> tuple[UInt8[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]]:
        """Cover of the container (with the liquid) and of the apparent liquid in a frame, 0 to 255.

        Raises: DataError where the frame's masks were not stored.
        """
        names = [self.folder / "masks" / f"{frame:05d}_{part}.png" for part in ("container", "liquid")]
        found = [cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names]
        if found[0] is None or found[1] is None:
            raise DataError(f"{self.folder} holds no masks of frame {frame}; make clips with a smaller mask_every.")
        return found[0], found[1]
