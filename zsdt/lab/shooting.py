"""How a clip is filmed: the camera and its faults of adjustment, its shaking, the exposure, and every frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from zsdt.lab.beam_lab import BeamLabOptions, ClipPlan, Side, node_grid, slow_noise
from zsdt.lab.beam_painter import BeamPainter, Painted, shaken, subframes
from zsdt.lab.stills import StillOptions, view_of
from zsdt.lab.styles import draw_style
from zsdt.perception.camera import Camera, ClampSide
from zsdt.trajectory import Trajectory


class Shooting:
    """One beam, filmed: everything that is drawn at random follows from the plan and the options.

    camera: the one that films, at rest; nominal_camera: what the twin is told of it; shake [frames, 3] rad and
    exposure [frames]: of each frame; shutter [s]: exposure time.
    """

    def __init__(self, plan: ClipPlan, options: BeamLabOptions, truth: Trajectory):
        self.truth = truth
        self._depth_noise = options.depth_noise
        rng = plan.rng(options, 2)
        sides = list(ClampSide)
        side = sides[int(rng.integers(2))]
        self.side = side if options.clamp_side is Side.random else ClampSide(options.clamp_side.value)
        grid = node_grid(truth.body, self.side)
        self._near, self._far = grid["near"], grid["far"]
        view = StillOptions(
            width=options.width,
            height=options.height,
            focal=options.focal,
            fill=options.fill,
            tilt_deg=options.tilt_deg,
            distortion=options.distortion,
        )
        positions = truth.fields["position"]
        places = positions[:, self._near].transpose(1, 0, 2, 3).reshape(len(self._near), -1, 3)
        self.camera = view_of(rng, places, self.side, view)
        self.nominal_camera = misjudged(rng, self.camera, options.calibration)
        self.style = draw_style(plan.rng(options, 3), options.pool)
        moves = plan.rng(options, 4)
        focal = self.camera.matrix[0, 0]
        # Rolling moves the corners of the picture about as far as yaw and pitch move all of it.
        self.shake = slow_noise(moves, options.frames, 3) * options.jitter_px / focal
        self.exposure = 1.0 + options.flicker * slow_noise(moves, options.frames, 1)[:, 0]
        self.shutter = float(moves.uniform(options.shutter[0], options.shutter[1])) / options.fps

    @cached_property
    def painter(self) -> BeamPainter:
        """The painter of this beam in this style."""
        columns, rows = self._near.shape
        return BeamPainter(
            self.style,
            self.camera,
            columns=columns,
            rows=rows,
            pitch=self.truth.body.pitch,
            beam_width=float(np.ptp(self.truth.body.points[:, 1])),
            clamp_side=self.side,
        )

    @property
    def nominal_depth(self) -> float:
        """Depth [m] of the undeformed visible face along the optical axis of the nominal camera."""
        return float(self.nominal_camera.depths(self.truth.body.points[self._near.ravel()]).mean())

    def paint(self, frame: int) -> Painted:
        """A frame of the clip. While the shutter is open the beam moves on with its velocity."""
        position, velocity = (self.truth.fields[name][frame] for name in ("position", "velocity"))
        speed = np.linalg.norm(velocity[self._near], axis=-1).max()
        depth = float(self.camera.depths(position[self._near].reshape(-1, 3)).min())
        count = subframes(self.shutter * speed * self.camera.matrix[0, 0] / depth)
        offsets = self.shutter * ((np.arange(count) + 0.5) / count - 0.5)
        moments = [(position + t * velocity)[ids] for t in offsets for ids in (self._near, self._far)]
        return self.painter.paint(
            list(zip(moments[::2], moments[1::2], strict=True)),
            exposure=float(self.exposure[frame]),
            shake=self.shake[frame],
            noise_seed=frame,
        )

    def depth_map(self, frame: int) -> Float[np.ndarray, "height width"]:
        """Depth [m] of every pixel at the middle of a frame's exposure, with the noise of the depth camera."""
        position = self.truth.fields["position"][frame]
        depth = self.painter.depth_map(position[self._near], position[self._far], self.shake[frame])
        noise = np.random.default_rng([self.style.seed, 4, frame]).standard_normal(depth.shape, dtype=np.float32)
        return depth + np.float32(self._depth_noise) * noise

    def pixels(self, frame: int) -> Float[np.ndarray, "columns rows 2"]:
        """Exact pixels of the visible nodes at the middle of a frame's exposure."""
        face = self.truth.fields["position"][frame][self._near]
        camera = shaken(self.camera, self.shake[frame])
        return camera.project(face.reshape(-1, 3)).reshape((*self._near.shape, 2))

    def describe(self) -> dict[str, Any]:
        """What the twin is not told, as plain values."""
        style = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self.style).items()}
        return {
            "clamp_side": self.side.value,
            "material": vars(self.truth.body.material),
            "factors": self.truth.meta["factors"],
            "mesh": self.truth.meta["mesh"],
            "style": style,
            "shutter_s": self.shutter,
            "shake_rad": self.shake.tolist(),
            "exposure": self.exposure.tolist(),
        }


def misjudged(rng: np.random.Generator, camera: Camera, error: float) -> Camera:
    """The camera as a calibration of finite accuracy finds it: focal length and angles off by about `error`."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + error * rng.standard_normal()
    turn = cv2.Rodrigues(error * rng.standard_normal(3))[0]
    return replace(camera, matrix=matrix, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
