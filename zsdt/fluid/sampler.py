"""What a data set of liquids is made of: splits, families, and everything that is drawn for one trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from zsdt.errors import OptionError
from zsdt.fluid.excitations import MotionOptions, draw_motion
from zsdt.fluid.families import draw_shape
from zsdt.fluid.motion import Excitation
from zsdt.fluid.solver import SphOptions
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselFamily, VesselShape

SPLITS = ("train", "val", "test", "beyond")


@dataclass
class LiquidSynthesisOptions:
    """A data set of simulated liquids in vessels that were moved and stopped (DESIGN 3.2).

    Numbers of trajectories per split. `families` are those of train, val and test; `families_beyond`, never trained
    on, make the split beyond. Ranges are [lowest, highest]: radius (half-width), fill level and freeboard (wall above
    the level) in m. held_out: the part of the ranges of radius, fill and speed, as shares between 0 and 1, that only
    the split test draws from, and all of whose draws lie in it. particles: range of their number, from which the
    spacing follows; layers: spacings that the liquid is at least deep and wide. frame_dt, duration in s.
    settle: seconds of rest before the excitation. max_attempts: draws per trajectory.
    """

    train: int = 20
    val: int = 3
    test: int = 4
    beyond: int = 4
    families: list[VesselFamily] = field(
        default_factory=lambda: [VesselFamily.cylinder, VesselFamily.tumbler, VesselFamily.flask, VesselFamily.jar]
    )
    families_beyond: list[VesselFamily] = field(default_factory=lambda: [VesselFamily.bowl])
    radius: list[float] = field(default_factory=lambda: [0.025, 0.05])
    fill: list[float] = field(default_factory=lambda: [0.03, 0.08])
    freeboard: list[float] = field(default_factory=lambda: [0.05, 0.08])
    held_out: list[float] = field(default_factory=lambda: [0.6, 0.75])
    particles: list[int] = field(default_factory=lambda: [400, 900])
    layers: float = 4.5
    liquid: Liquid = field(default_factory=Liquid)
    motion: MotionOptions = field(default_factory=MotionOptions)
    solver: SphOptions = field(default_factory=SphOptions)
    frame_dt: float = 0.004
    duration: float = 0.6
    settle: float = 0.2
    max_attempts: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("radius", "fill", "freeboard", "particles"):
            limits = getattr(self, name)
            if len(limits) != 2 or not 0 < limits[0] <= limits[1]:
                raise OptionError(f"The range {list(limits)} of {name} must be [lowest, highest], both positive.")
        if len(self.held_out) != 2 or not 0.0 <= self.held_out[0] <= self.held_out[1] <= 1.0:
            raise OptionError(f"held_out {list(self.held_out)} must be two rising shares between 0 and 1.")
        if set(self.families) & set(self.families_beyond):
            raise OptionError("A family cannot be both in families and in families_beyond, which is never trained on.")
        if min(self.frame_dt, self.duration, self.settle) <= 0 or self.duration < self.frame_dt:
            raise OptionError("frame_dt, duration and settle must be positive, and a duration is one frame at least.")
        self.motion.check(self.liquid)


@dataclass(frozen=True)
class Job:
    """One trajectory to make: split, number within it, and family of its vessel."""

    split: str
    number: int
    family: VesselFamily

    @property
    def name(self) -> str:
        """Name, unique in the data set."""
        return f"{self.split}_{self.number:03d}"

    def seed(self, base: int, attempt: int) -> list[int]:
        """Entropy of one attempt; it depends on nothing else that is made beside it."""
        return [base, 0x11D, SPLITS.index(self.split), self.number, attempt]


@dataclass(frozen=True)
class Case:
    """What is simulated: vessel, fill level [m], about how many particles, how the vessel moves, and a seed."""

    shape: VesselShape
    fill: float
    particles: int
    excitation: Excitation
    seed: int


def plan(options: LiquidSynthesisOptions) -> list[Job]:
    """All trajectories of a data set, in the order of its index; families take turns.

    Raises: OptionError where a split has no family to draw from.
    """
    jobs = []
    for split in SPLITS:
        families = options.families_beyond if split == "beyond" else options.families
        count = getattr(options, split)
        if count and not families:
            name = "families_beyond" if split == "beyond" else "families"
            raise OptionError(f"There is no family for the split '{split}'; name one in {name} or ask for none.")
        jobs += [Job(split, k, families[k % len(families)]) for k in range(count)]
    return jobs


def _share(split: str, options: LiquidSynthesisOptions, rng: np.random.Generator) -> float:
    """A place in a range: test in the held-out part, train and val outside of it, beyond anywhere."""
    low, high = options.held_out
    if split == "test":
        return float(rng.uniform(low, high))
    if split == "beyond":
        return float(rng.random())
    share = float(rng.random()) * (1.0 - (high - low))
    return share if share < low else share + (high - low)


def _at(limits: list[float], share: float) -> float:
    return limits[0] + share * (limits[1] - limits[0])


def least_particles(shape: VesselShape, fill: float, layers: float) -> int:
    """Particles with which the liquid is `layers` spacings deep, and as wide at its mean cross-section."""
    volume = Vessel(shape).volume(fill)
    width = math.sqrt(volume / fill / math.pi) * 2.0
    return math.ceil(volume * (layers / min(fill, width)) ** 3)


def draw_case(job: Job, options: LiquidSynthesisOptions, attempt: int) -> Case:
    """Vessel, level, motion and resolution of one attempt.

    Raises: OptionError where the range of particles resolves no vessel that is drawn; RunRejected ("range").
    """
    rng = np.random.default_rng(job.seed(options.seed, attempt))
    for _ in range(1000):
        radius, fill, speed = (
            round(_at(limits, _share(job.split, options, rng)), 6)
            for limits in (options.radius, options.fill, options.motion.speed)
        )
        shape = draw_shape(job.family, radius, fill, _at(options.freeboard, float(rng.random())), rng)
        excitation = draw_motion(speed, options.motion, options.liquid, rng)
        particles = int(rng.integers(options.particles[0], options.particles[1] + 1))
        particles = max(particles, least_particles(shape, fill, options.layers))
        if particles <= options.particles[1]:
            return Case(shape, fill, particles, excitation, int(rng.integers(2**31)))
    raise OptionError(
        f"{options.particles[1]} particles are too few for {options.layers:g} layers in any {job.family.value} of the "
        "given range; raise particles or lower layers."
    )
