"""The hidden physics of the virtual laboratory for liquids: glasses that are carried and stopped before a camera.

The same solver as the twin's training data, but with more particles, another viscosity (off by up to a fifth), vessels
that were never trained on, and followed through the whole clip: the even motion before, the excitation, and what
comes after t0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from zsdt.errors import OptionError
from zsdt.fluid.solver import SphOptions
from zsdt.lab.beam_lab import Storage
from zsdt.lab.styles import Pool
from zsdt.scene import Liquid, VesselFamily

FIELDS = ("position", "velocity", "internal_energy")
LIVELY = 0.02  # m/s: a particle that is still faster after settling is not at rest
SAMPLE = 1e-3  # s between samples of the path of a vessel


class GlassCamera(Enum):
    """Who makes the pictures: the painter (numpy and numba, fast) or the ray tracer (Mitsuba, an optional extra)."""

    painter = "painter"
    raytrace = "raytrace"


class Contents(Enum):
    """What is filmed: a glass with liquid; the same without; with a second glass that stands beside it; no glass."""

    liquid = "liquid"
    empty = "empty"
    two_glasses = "two_glasses"
    no_glass = "no_glass"


@dataclass
class GlassLabOptions:
    """Clips of liquids in glasses in front of a camera. Ranges are [lowest, highest].

    clips: how many; families take turns. radius (half-width), fill, freeboard [m]: of the vessels; those of a family
    that is not in `families_beyond` (never trained on) have their radius and fill in the part `held_out` of the ranges,
    from which no training data are drawn (as `LiquidSynthesisOptions`). wall, floor [m]: thickness of the glass;
    glass_index, liquid_index: of refraction. contents: see `Contents`.
    nominal: the liquid that the twin is told; mismatch: largest relative error of its viscosity; sign: 0 for a random
    factor within the mismatch, -1 or 1 for one at its full size. particles: range of the lab's own resolution;
    settle [s]: of rest before the excitation.
    speed [m/s] and ramp [s] of the stop; pulse_fraction: share of clips that begin at rest with a pulse of `pulse` [s]
    and a pause of `pause` [s]; heading_deg: largest angle between the motion and the plane y = 0.
    fps; lead: range of the number of frames before the excitation begins; after: frames from t0 on; width, height
    [px]; glass_px: range of the width of the glass in the picture; distance [m]: of the camera; tilt_deg: range of its
    looking down; roll_deg: largest; distortion: largest |k1|. calibration: relative error of the focal length and, in
    rad, of the angles that the twin is told. jitter_px: shaking of the camera, flicker: of its exposure (both standard
    deviations). shutter: range of the exposure over the time between frames.
    camera, pool, storage; mask_every: frames between two stored masks.
    """

    clips: int = 4
    families: list[VesselFamily] = field(default_factory=lambda: list(VesselFamily))
    families_beyond: list[VesselFamily] = field(default_factory=lambda: [VesselFamily.bowl])
    radius: list[float] = field(default_factory=lambda: [0.025, 0.05])
    fill: list[float] = field(default_factory=lambda: [0.03, 0.08])
    freeboard: list[float] = field(default_factory=lambda: [0.045, 0.06])
    held_out: list[float] = field(default_factory=lambda: [0.6, 0.75])
    wall: list[float] = field(default_factory=lambda: [0.0015, 0.003])
    floor: list[float] = field(default_factory=lambda: [0.004, 0.009])
    glass_index: float = 1.5
    liquid_index: float = 1.473
    contents: Contents = Contents.liquid
    nominal: Liquid = field(default_factory=Liquid)
    gravity: float = 9.81
    mismatch: float = 0.2
    sign: int = 0
    particles: list[int] = field(default_factory=lambda: [1200, 1800])
    settle: float = 0.2
    solver: SphOptions = field(default_factory=SphOptions)
    speed: list[float] = field(default_factory=lambda: [0.35, 0.6])
    ramp: list[float] = field(default_factory=lambda: [0.02, 0.08])
    pulse_fraction: float = 0.25
    pulse: list[float] = field(default_factory=lambda: [0.06, 0.12])
    pause: list[float] = field(default_factory=lambda: [0.0, 0.08])
    heading_deg: float = 2.0
    fps: float = 60.0
    lead: list[int] = field(default_factory=lambda: [12, 15])
    after: int = 48
    width: int = 640
    height: int = 400
    glass_px: list[float] = field(default_factory=lambda: [150.0, 200.0])
    distance: list[float] = field(default_factory=lambda: [0.45, 0.8])
    tilt_deg: list[float] = field(default_factory=lambda: [4.0, 12.0])
    roll_deg: float = 0.5
    distortion: float = 0.05
    calibration: float = 0.001
    jitter_px: float = 0.2
    flicker: float = 0.01
    shutter: list[float] = field(default_factory=lambda: [0.1, 0.4])
    camera: GlassCamera = GlassCamera.painter
    pool: Pool = Pool.unseen
    storage: Storage = Storage.video
    mask_every: int = 1
    max_attempts: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        if self.clips < 1 or self.after < 1 or self.fps <= 0 or self.mask_every < 1 or not self.families:
            raise OptionError("A virtual lab needs a clip, a family, a frame after t0, a positive fps and mask_every.")
        positive = ("radius", "fill", "freeboard", "wall", "floor", "particles", "speed", "ramp", "pulse", "lead")
        for name in (*positive, "pause", "glass_px", "distance", "tilt_deg", "shutter", "held_out"):
            limits = getattr(self, name)
            if len(limits) != 2 or not (limits[0] > 0 if name in positive else limits[0] >= 0) or limits[0] > limits[1]:
                raise OptionError(f"{name} must be [lowest, highest], rising and not negative, not {list(limits)}.")
        if not 0.0 <= self.mismatch < 0.6 or self.sign not in (-1, 0, 1):
            raise OptionError("mismatch must be from 0 to below 0.6 and sign one of -1, 0, 1.")
        if self.shutter[1] > 1.0 or self.held_out[1] > 1.0 or not 0.0 <= self.pulse_fraction <= 1.0:
            raise OptionError("shutter, held_out and pulse_fraction are shares between 0 and 1.")
        if min(self.calibration, self.jitter_px, self.flicker, self.roll_deg, self.heading_deg) < 0:
            raise OptionError("calibration, jitter_px, flicker, roll_deg and heading_deg cannot be negative.")
        if self.width < 64 or self.height < 64:
            raise OptionError("A clip needs at least 64 x 64 px.")
