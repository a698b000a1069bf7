"""How a clip of a glass is filmed: the camera and its faults of adjustment, its shaking, exposure and noise."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.fluid.families import draw_shape
from zsdt.lab.beam_lab import slow_noise
from zsdt.lab.beam_painter import subframes
from zsdt.lab.glass_lab import Contents, GlassCamera, GlassCase, GlassLabOptions, GlassPlan, between
from zsdt.lab.glass_painter import GlassPainter
from zsdt.lab.glass_styles import GlassStyle, draw_glass_style
from zsdt.lab.glass_surface import ParticleSurface
from zsdt.lab.glass_view import Glass, GlassPicture, GlassView, Shot, outer_profile
from zsdt.lab.shooting import misjudged
from zsdt.perception.camera import Camera
from zsdt.scene import VesselFamily
from zsdt.trajectory import Trajectory

SHIFT = 24  # px by which the noise of two frames may be shifted
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # rows: axes of a camera that looks along y


class GlassFrame(NamedTuple):
    """A frame of a clip: picture (BGR) and masks (see `Shot`)."""

    image: UInt8[np.ndarray, "height width 3"]
    container_mask: UInt8[np.ndarray, "height width"]
    liquid_mask: UInt8[np.ndarray, "height width"]


def glass_picture(options: GlassLabOptions) -> GlassPicture:
    """The camera of a lab. Raises: OptionError where the ray tracer is not installed."""
    if options.camera is GlassCamera.painter:
        return GlassPainter()
    from zsdt.lab.raytrace import RayTracer

    return RayTracer(options.raytrace)


def looking_at(
    target: Float[np.ndarray, "3"],
    *,
    distance: float,
    tilt: float,
    roll: float,
    focal: float,
    size: tuple[int, int],
    distortion: float = 0.0,
) -> Camera:
    """A camera that has `target` [m] in the middle of its picture, at `distance` [m], looking down by `tilt` and
    turned about its axis by `roll` [rad]; focal length [px], size (width, height), distortion k1."""
    down = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
    about = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    rotation = about @ down.T @ LEVEL
    width, height = size
    return Camera(
        matrix=np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]),
        distortion=np.array([distortion, -0.3 * distortion, 0.0, 0.0, 0.0]),
        rotation=rotation,
        translation=np.array([0.0, 0.0, distance]) - rotation @ target,
        width=width,
        height=height,
    )


def outline_points(glass: Glass) -> Float[np.ndarray, "points 3"]:
    """Points [m] of the room around a glass: circles around its foot, its rim and its widest place."""
    heights, radii = outer_profile(glass.vessel, glass.wall, glass.floor)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rows = [0, int(np.argmax(radii)), -1]
    return np.concatenate(
        [np.column_stack([radii[k] * ring, np.full(len(ring), heights[k])]) + glass.origin for k in rows]
    )


class GlassShooting:
    """One liquid, filmed: everything that is drawn at random follows from the plan and the options.

    camera: the one that films, at rest; nominal_camera: what the twin is told of it; shake [frames, 3] rad and
    exposure [frames]: of each frame; shutter [s]: exposure time. truth: None where only these are wanted.
    """

    def __init__(self, plan: GlassPlan, options: GlassLabOptions, case: GlassCase, truth: Trajectory | None = None):
        self.case, self._truth, self.options = case, truth, options
        rng = plan.rng(options, 2)
        self.neighbour = self._neighbour(plan) if options.contents is Contents.two_glasses else None
        self.camera = self._place_camera(rng)
        self.nominal_camera = misjudged(rng, self.camera, options.calibration)
        self.style: GlassStyle = draw_glass_style(plan.rng(options, 3), options.pool)
        moves = plan.rng(options, 4)
        self.shake = slow_noise(moves, case.frames, 3) * options.jitter_px / self.camera.matrix[0, 0]
        self.exposure = 1.0 + options.flicker * slow_noise(moves, case.frames, 1)[:, 0]
        self.shutter = float(moves.uniform(options.shutter[0], options.shutter[1])) / options.fps

    @cached_property
    def picture(self) -> GlassPicture:
        """The camera that takes the pictures."""
        return glass_picture(self.options)

    @property
    def truth(self) -> Trajectory:
        """What the liquid does. Raises: OptionError where it was not given."""
        if self._truth is None:
            raise OptionError("This shooting was made without a liquid; give it the trajectory to film.")
        return self._truth

    @property
    def volume(self) -> float:
        """Volume of the liquid at rest [m3]."""
        return float(self.truth.body.mass.sum()) / self.case.liquid.density

    @cached_property
    def surfaces(self) -> Float[np.ndarray, "frames rings angles"]:
        """The free surface of all frames over the polar grid [m] (see `Glass.height`)."""
        measured = ParticleSurface(self.case.shape, self.truth.body.pitch, self.volume)
        measured.calibrate(self.truth.fields["position"][0])  # carried evenly, the liquid is at rest
        return np.stack([measured.measure(position) for position in self.truth.fields["position"]])

    def glass(self, origin: Float[np.ndarray, "3"], height: np.ndarray | None) -> Glass:
        """The filmed glass at a place, with a surface or empty."""
        case, options = self.case, self.options
        return Glass(case.shape, case.wall, case.floor, origin, height, options.glass_index, options.liquid_index)

    def shoot(self, frame: int) -> GlassFrame:
        """A frame of the clip. While the shutter is open the vessel moves on."""
        height = self.surfaces[frame] if self.options.contents in (Contents.liquid, Contents.two_glasses) else None
        offsets = np.array([0.0])
        if self.options.contents is not Contents.no_glass:
            ends = self.case.places(self.case.times[frame] + self.shutter * np.array([-0.5, 0.5]))
            travel = np.ptp(self.camera.project(ends)[:, 0])
            count = subframes(0.5 * float(travel))  # the lens blurs as well
            offsets = self.shutter * ((np.arange(count) + 0.5) / count - 0.5)
        shots = [self.picture(self._view(frame, float(offset), height, len(offsets))) for offset in offsets]
        return developed(shots, self.style, float(self.exposure[frame]), frame)

    def _view(self, frame: int, offset: float, height: np.ndarray | None, moments: int) -> GlassView:
        glasses = [self.glass(self.case.places(self.case.times[frame : frame + 1] + offset)[0], height)]
        if self.options.contents is Contents.no_glass:
            glasses = []
        if self.neighbour is not None:
            glasses.append(self.neighbour)
        return GlassView(tuple(glasses), self.style, self.camera, self.shake[frame], moments)

    # ---- where things are -------------------------------------------------------------------------------------

    def _neighbour(self, plan: GlassPlan) -> Glass:
        """A second glass that stands on the side that the first one does not come from."""
        rng = plan.rng(self.options, 5)
        family = list(VesselFamily)[int(rng.integers(len(VesselFamily)))]
        level = rng.uniform(0.03, 0.06)
        shape = draw_shape(family, rng.uniform(0.025, 0.035), level, rng.uniform(0.03, 0.05), rng)
        side = -np.sign(self.case.path[0, 0]) or 1.0
        away = max(self.case.shape.radii) + max(shape.radii) + 2.0 * self.case.wall + rng.uniform(0.012, 0.03)
        floor = 0.005
        origin = np.array([side * away, rng.uniform(-0.01, 0.01), floor])
        return Glass(shape, 0.002, floor, origin, np.full((4, 16), level))

    def _place_camera(self, rng: np.random.Generator) -> Camera:
        """A camera that sees the glass wherever it is during the clip.

        Raises: OptionError where no camera of the given ranges does.
        """
        o = self.options
        glasses = [self.glass(place, None) for place in self.case.path]
        points = np.concatenate([outline_points(g) for g in glasses])
        if self.neighbour is not None:
            points = np.concatenate([points, outline_points(self.neighbour)])
        low, high = points.min(axis=0), points.max(axis=0)
        wide = 2.0 * (max(self.case.shape.radii) + self.case.wall)
        for attempt in range(100):
            distance = between(o.distance, rng)
            tilt, roll = np.radians(between(o.tilt_deg, rng)), np.radians(o.roll_deg) * rng.uniform(-1.0, 1.0)
            px = between(o.glass_px, rng) * (1.0 - 0.006 * attempt)  # later attempts step back
            fit = min(px / wide, 0.9 * o.width / (high[0] - low[0]), 0.82 * o.height / (high[2] - low[2]))
            target = np.array([0.5 * (low[0] + high[0]), 0.0, 0.5 * (low[2] + high[2])])
            target += rng.uniform(-0.02, 0.02, 3) * [1.0, 0.0, 1.0] * (high - low)
            camera = looking_at(
                target,
                distance=distance,
                tilt=tilt,
                roll=roll,
                focal=fit * distance,
                size=(o.width, o.height),
                distortion=o.distortion * rng.uniform(-1.0, 0.4),
            )
            pixels = camera.project(points)
            if (pixels > 4).all() and (pixels < np.array([o.width, o.height]) - 5).all():
                return camera
        raise OptionError("No camera of the given ranges sees the glass during the whole clip; lower glass_px.")

    def describe(self) -> dict[str, Any]:
        """What the twin is not told, as plain values."""
        style = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self.style).items()}
        meta = self.truth.meta
        return {
            **{name: meta[name] for name in ("family", "regime", "factors", "fill", "t0_frame", "t0_s", "particles")},
            "volume": self.volume,
            "contents": self.options.contents.value,
            "camera": self.options.camera.value,
            "style": style,
            "shutter_s": self.shutter,
            "shake_rad": self.shake.tolist(),
            "exposure": self.exposure.tolist(),
        }


@lru_cache(maxsize=2)
def _grain(seed: int, height: int, width: int) -> Float[np.ndarray, "rows columns 3"]:
    """Noise of a sensor, a little larger than a picture: every frame takes another part of it."""
    grain = np.random.default_rng([seed, 4]).standard_normal((height + SHIFT, width + SHIFT, 3), dtype=np.float32)
    return cv2.GaussianBlur(grain, (0, 0), 0.5)


def developed(shots: list[Shot], style: GlassStyle, exposure: float, noise_seed: int) -> GlassFrame:
    """The mean of shots, with exposure, shot and reading noise, and the eight bits of a camera."""
    image, container, liquid = (
        np.mean([getattr(shot, name) for shot in shots], axis=0, dtype=np.float32)
        if len(shots) > 1
        else np.asarray(getattr(shots[0], name), np.float32)
        for name in ("image", "container_mask", "liquid_mask")
    )
    rng = np.random.default_rng([style.seed, 3, noise_seed])
    picture = image * np.float32(style.exposure * exposure)
    # Shot noise grows with the root of brightness; its straight line through mid grey does as well here.
    field = _grain(style.seed, picture.shape[0], picture.shape[1])
    y, x = rng.integers(0, SHIFT, 2)
    noise = field[y : y + picture.shape[0], x : x + picture.shape[1]]
    picture += np.float32(1.4 * style.noise) * noise * (0.5 + picture * np.float32(0.5 / 128.0))
    return GlassFrame(
        np.clip(np.rint(picture), 0, 255).astype(np.uint8),
        np.rint(container).astype(np.uint8),
        np.rint(liquid).astype(np.uint8),
    )
