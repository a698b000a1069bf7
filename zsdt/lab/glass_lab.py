"""The hidden physics of the virtual laboratory for liquids: glasses that are carried and stopped before a camera.

The same solver as the twin's training data, but with more particles, another viscosity (off by up to a fifth), vessels
that were never trained on, and followed through the whole clip: the even motion before, the excitation, and what
comes after t0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError, RunRejected
from zsdt.fluid.excitations import check_excitation
from zsdt.fluid.families import draw_shape
from zsdt.fluid.motion import Excitation, VelocityChange
from zsdt.fluid.sampler import LiquidSynthesisOptions, least_particles
from zsdt.fluid.sampling import fill
from zsdt.fluid.solver import LiquidFrame, SphOptions, SphSolver
from zsdt.fluid.vessel import Vessel
from zsdt.lab.clip_files import Storage
from zsdt.lab.raytrace_options import RaytraceOptions
from zsdt.lab.styles import Pool
from zsdt.scene import Liquid, VesselFamily, VesselShape
from zsdt.trajectory import Body, Trajectory
from zsdt.workers import first_accepted, plain

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
    camera, with the options of the ray tracer; pool, storage; mask_every: frames between two stored masks.
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
    raytrace: RaytraceOptions = field(default_factory=RaytraceOptions)
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


@dataclass(frozen=True)
class GlassPlan:
    """One clip to make: its number and the family of its vessel."""

    number: int
    family: VesselFamily

    @property
    def name(self) -> str:
        """Name, unique in the set."""
        return f"clip_{self.number:03d}"

    def seed(self, base: int, attempt: int) -> list[int]:
        """Entropy of one attempt; it depends on nothing else that is made beside it."""
        return [base, 0x61A, self.number, attempt]

    def rng(self, options: GlassLabOptions, topic: int) -> np.random.Generator:
        """Random numbers of one topic of this clip."""
        return np.random.default_rng([options.seed, 0x61B, self.number, topic])


@dataclass(frozen=True)
class GlassCase:
    """What is filmed: vessel, thickness of its glass [m], fill level [m], about how many particles, how it moves.

    liquid: the lab's own, factors: what makes it differ from the nominal one; lead [s]: from the first frame to the
    begin of the excitation; frames; seed of the particles.
    """

    shape: VesselShape
    wall: float
    floor: float
    fill: float
    particles: int
    liquid: Liquid
    factors: dict[str, float]
    excitation: Excitation
    lead: float
    frames: int
    fps: float
    seed: int

    @property
    def times(self) -> Float[np.ndarray, " frames"]:
        """Times [s] of the frames, 0 at the begin of the excitation."""
        return np.arange(self.frames) / self.fps - self.lead

    @property
    def t0_frame(self) -> int:
        """First frame at or after the end of the excitation."""
        return int(np.argmax(self.times >= self.excitation.duration - 1e-9))

    @cached_property
    def path(self) -> Float[np.ndarray, "frames 3"]:
        """Place [m] of the centre of the cavity's floor in the room at the frames; after t0 it is (0, 0, floor)."""
        return self.places(self.times)

    def places(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 3"]:
        """The same at any `times` [s], 0 at the begin of the excitation."""
        end = self.excitation.duration
        count = math.ceil((end - min(float(np.min(times)), 0.0)) / SAMPLE) + 1
        fine = np.linspace(min(float(np.min(times)), 0.0), end, count)
        speed = np.array([self.excitation.velocity(t) for t in fine])
        steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(fine)[:, None]
        travelled = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        place = travelled - travelled[-1]
        result = np.stack([np.interp(times, fine, place[:, k]) for k in range(3)], axis=1)
        return result + np.array([0.0, 0.0, self.floor])


def plan_glass_clips(options: GlassLabOptions) -> list[GlassPlan]:
    """All clips, in the order of their index; families take turns."""
    return [GlassPlan(k, options.families[k % len(options.families)]) for k in range(options.clips)]


def between(limits: list[float], rng: np.random.Generator) -> float:
    """A random number from the range [lowest, highest]."""
    return float(rng.uniform(limits[0], limits[1]))


def draw_glass_motion(options: GlassLabOptions, rng: np.random.Generator) -> Excitation:
    """An even motion along x, or a pulse from rest, and a ramped stop.

    Raises: OptionError where the ranges reach beyond what the solver is tested for.
    """
    speed, ramp = between(options.speed, rng), between(options.ramp, rng)
    heading = math.radians(options.heading_deg) * rng.uniform(-1.0, 1.0)
    final = speed * rng.choice([-1.0, 1.0]) * np.array([math.cos(heading), math.sin(heading), 0.0])
    changes, before, now = [], final, 0.0
    if rng.random() < options.pulse_fraction:
        pulse = VelocityChange(0.0, between(options.pulse, rng), (float(final[0]), float(final[1]), 0.0))
        changes, before, now = [pulse], np.zeros(3), pulse.end + between(options.pause, rng)
    changes.append(VelocityChange(now, ramp, (-float(final[0]), -float(final[1]), 0.0)))
    excitation = Excitation((float(before[0]), float(before[1]), 0.0), tuple(changes), g=options.gravity)
    check_excitation(excitation, options.nominal)
    return excitation


def draw_glass_case(plan: GlassPlan, options: GlassLabOptions, attempt: int) -> GlassCase:
    """Vessel, liquid, motion and resolution of one attempt.

    Raises: OptionError where the range of particles resolves no vessel that is drawn.
    """
    rng = np.random.default_rng(plan.seed(options.seed, attempt))
    beyond = plan.family in options.families_beyond
    error = float(rng.uniform(-options.mismatch, options.mismatch))
    factor = 1.0 + (options.sign * options.mismatch if options.sign else error)
    liquid = replace(options.nominal, viscosity=options.nominal.viscosity * factor)
    layers = LiquidSynthesisOptions().layers
    for _ in range(1000):
        shares = rng.uniform(0.0, 1.0, 2) if beyond else rng.uniform(options.held_out[0], options.held_out[1], 2)
        radius, level = (
            round(float(low + share * (high - low)), 6)
            for (low, high), share in zip((options.radius, options.fill), shares, strict=True)
        )
        shape = draw_shape(plan.family, radius, level, between(options.freeboard, rng), rng)
        particles = max(
            int(rng.integers(options.particles[0], options.particles[1] + 1)), least_particles(shape, level, layers)
        )
        if particles > options.particles[1]:
            continue
        excitation = draw_glass_motion(options, rng)
        interval = 1.0 / options.fps
        lead = interval * (int(rng.integers(options.lead[0], options.lead[1] + 1)) + rng.random())
        first = math.ceil((lead + excitation.duration) / interval - 1e-9)
        return GlassCase(
            shape=shape,
            wall=between(options.wall, rng),
            floor=between(options.floor, rng),
            fill=level,
            particles=particles,
            liquid=liquid,
            factors={"viscosity": factor},
            excitation=excitation,
            lead=lead,
            frames=first + options.after,
            fps=options.fps,
            seed=int(rng.integers(2**31)),
        )
    raise OptionError(
        f"{options.particles[1]} particles are too few for {layers:g} layers in any {plan.family.value} of the given "
        "range; raise particles."
    )


def _at_rest(case: GlassCase, options: GlassLabOptions) -> SphSolver:
    """The solver with packed and settled particles, before the excitation.

    Raises: RunRejected ("packing", "layers", "unsettled").
    """
    vessel, choice = Vessel(case.shape), options.solver
    rng = np.random.default_rng(case.seed)
    filling = fill(vessel, case.fill, case.particles, rng, choice.smoothing, choice.fineness)
    solver = SphSolver(
        vessel,
        case.liquid,
        filling.points,
        filling.spacing,
        choice,
        motion=case.excitation,
        tables=filling.tables,
    )
    left = solver.settle(options.settle)
    if left > LIVELY:
        raise RunRejected("unsettled", f"A particle still moves at {left:.3f} m/s after settling; raise settle.")
    return solver


def _film(case: GlassCase, solver: SphSolver) -> list[LiquidFrame]:
    """States at the frames; before the excitation the liquid rests in a vessel that moves evenly.

    Raises: RunRejected where the run leaves its range or liquid is spilled.
    """
    kept = []
    for time in case.times:
        if time > solver.time + 1e-12:
            solver.advance(float(time) - solver.time)
        if solver.spilled:
            raise RunRejected("spill", f"{solver.spilled} particles went over the rim; use more freeboard.")
        kept.append(solver.frame())
    return kept


def simulate_glass(plan: GlassPlan, case: GlassCase, options: GlassLabOptions) -> Trajectory:
    """What the liquid of a case does, in the axes of the vessel, at the times of all frames of the clip.

    Raises: RunRejected.
    """
    solver = _at_rest(case, options)
    kept = _film(case, solver)
    n, first = solver.particles, case.t0_frame
    mass = np.full(n, case.liquid.density * solver.spacing**3)
    body = Body(
        points=kept[0].position,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(n, bool),
        mass=mass,
        frame_dt=1.0 / case.fps,
        pitch=solver.spacing,
        gravity=np.array([0.0, 0.0, -options.gravity]),
        liquid=case.liquid,
        vessel=case.shape,
        motion=case.excitation.history(case.lead),
    )
    accounts = [frame.account.joules() for frame in kept]
    push = np.stack([case.excitation.acceleration(float(t)) for t in case.times])
    return Trajectory(
        body=body,
        times=np.arange(case.frames) / case.fps,
        fields={name: np.stack([getattr(frame, name) for frame in kept]) for name in FIELDS},
        load=-push[:, None, :] * mass[None, :, None],
        ledger={name: np.array([a[name] for a in accounts]) for name in accounts[0]},
        meta={
            "name": plan.name,
            "regime": "pulses" if len(case.excitation.changes) > 1 else "stop",
            "family": plan.family.value,
            "fill": case.fill,
            "factors": case.factors,
            "spacing": solver.spacing,
            "particles": n,
            "t0_frame": first,
            "t0_s": case.lead + case.excitation.duration,
            "stop": plain(case.excitation.describe()),
            "virtual_lab": True,
        },
    )


def hidden_glass(plan: GlassPlan, options: GlassLabOptions) -> tuple[GlassCase, Trajectory]:
    """The first case of a clip that is not rejected, and what happens in it.

    Raises: OptionError, RunRejected where no case is borne.
    """
    cases: list[GlassCase] = []

    def draw(plan: GlassPlan, options: GlassLabOptions, attempt: int) -> GlassCase:
        cases.append(draw_glass_case(plan, options, attempt))
        return cases[-1]

    truth = first_accepted(plan, options, draw, simulate_glass, "use gentler motions or more freeboard")
    return cases[-1], truth
