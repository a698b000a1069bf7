"""What a data set is made of: sizes of the splits, regimes, and the seed of every trajectory."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from zsdt.errors import OptionError
from zsdt.scene import BeamShape, Foam
from zsdt.solid.loads import LoadCase, LoadOptions, Regime, bending_demand, buckling_demand, draw_load
from zsdt.solid.solver import SolverOptions

SPLITS = ("train", "val", "test", "beyond")
STEP_CM = 5
Size = tuple[int, int, int]


@dataclass
class SizeRange:
    """Smallest and largest length, width and depth of beams, in cm; sizes come in steps of 5 cm."""

    length_cm: list[int] = field(default_factory=lambda: [40, 65])
    width_cm: list[int] = field(default_factory=lambda: [10, 30])
    depth_cm: list[int] = field(default_factory=lambda: [10, 30])

    def sizes(self) -> list[Size]:
        """All sizes of the range [cm], shortest first. Raises: OptionError where a range is empty or off the steps."""
        axes: list[range] = []
        for name, limits in (("length", self.length_cm), ("width", self.width_cm), ("depth", self.depth_cm)):
            if len(limits) != 2 or limits[0] > limits[1] or limits[0] <= 0 or any(x % STEP_CM for x in limits):
                raise OptionError(
                    f"The range {list(limits)} of {name}_cm must be [smallest, largest] in multiples of {STEP_CM} cm."
                )
            axes.append(range(limits[0], limits[1] + 1, STEP_CM))
        return [(a, b, c) for a, b, c in itertools.product(*axes)]


@dataclass
class SynthesisOptions:
    """A data set of simulated foam beams.

    Numbers of trajectories per split; `sizes` for train, val and test (test takes sizes that are held out of the
    others), `beyond_sizes` minus `sizes` for beyond. Durations and frame times in s; mesh and pitch in m.
    hand_fraction: share of the hand regime in every split. ledger_limit: residual of the energy account, relative
    to the energy that is stored, above which a run is rejected. max_attempts: draws per trajectory.
    """

    train: int = 24
    val: int = 4
    test: int = 4
    beyond: int = 2
    sizes: SizeRange = field(default_factory=SizeRange)
    beyond_sizes: SizeRange = field(default_factory=lambda: SizeRange([35, 80], [10, 40], [10, 40]))
    held_out: float = 0.15
    hand_fraction: float = 0.5
    hand_duration: float = 1.7
    dynamic_duration: float = 0.6
    hand_frame_dt: float = 1.0 / 60.0
    dynamic_frame_dt: float = 0.005
    mesh: float = 0.025
    pitch: float = 0.05
    gravity: float = 9.81
    material: Foam = field(default_factory=Foam)
    solver: SolverOptions = field(default_factory=SolverOptions)
    loads: LoadOptions = field(default_factory=LoadOptions)
    ledger_limit: float = 1e-3
    max_attempts: int = 20
    seed: int = 0


@dataclass(frozen=True)
class Job:
    """One trajectory to make: split, number within it, size in cm, and regime."""

    split: str
    number: int
    size_cm: Size
    regime: Regime

    @property
    def name(self) -> str:
        """Name, unique in the data set."""
        return f"{self.split}_{self.number:03d}"

    @property
    def shape(self) -> BeamShape:
        """Length, width and depth in m."""
        return BeamShape(*(round(cm / 100.0, 6) for cm in self.size_cm))

    def seed(self, base: int, attempt: int) -> list[int]:
        """Entropy of one attempt; it depends on nothing else that is made beside it."""
        return [base, SPLITS.index(self.split), self.number, attempt]


def plan(options: SynthesisOptions) -> list[Job]:
    """All trajectories of a data set, in the order of its index.

    Raises: OptionError where a split has no sizes to draw from.
    """
    rng = np.random.default_rng([options.seed, 0x512E])
    inside = options.sizes.sizes()
    order = [inside[k] for k in rng.permutation(len(inside))]
    held = min(max(1, round(options.held_out * len(inside))), len(inside) - 1) if options.test else 0
    outside = sorted(set(options.beyond_sizes.sizes()) - set(inside))
    pools = {"train": order[held:], "val": order[held:][::-1], "test": order[:held]}
    pools["beyond"] = [outside[k] for k in rng.permutation(len(outside))]
    jobs = []
    for split in SPLITS:
        count = getattr(options, split)
        if count and not pools[split]:
            raise OptionError(
                f"There are no sizes for the split '{split}'; widen "
                f"{'beyond_sizes' if split == 'beyond' else 'sizes'} or set its number of trajectories to 0."
            )
        for k in range(count):
            # Hand and dynamic take turns in the wanted proportion.
            hand = int((k + 1) * options.hand_fraction + 1e-9) > int(k * options.hand_fraction + 1e-9)
            regime = Regime.hand if hand else Regime.dynamic
            jobs.append(Job(split, k, pools[split][k % len(pools[split])], regime))
    return jobs


def duration(options: SynthesisOptions, regime: Regime) -> float:
    """Duration of a trajectory [s]."""
    return options.hand_duration if regime is Regime.hand else options.dynamic_duration


def frame_dt(options: SynthesisOptions, regime: Regime) -> float:
    """Time between frames [s]."""
    return options.hand_frame_dt if regime is Regime.hand else options.dynamic_frame_dt


def draw_case(
    job: Job, options: SynthesisOptions, attempt: int, accept: Callable[[LoadCase], bool] | None = None
) -> LoadCase:
    """A load case for a job that neither collapses nor buckles, by the estimates of beam theory.

    accept: what else is asked of it. Raises: OptionError where no such load turns up.
    """
    rng = np.random.default_rng(job.seed(options.seed, attempt))
    for _ in range(1000):
        case = draw_load(
            rng, job.shape, options.material, job.regime, duration(options, job.regime), options.mesh, options.loads
        )
        bending = bending_demand(job.shape, options.material, options.gravity, case)
        buckling = buckling_demand(job.shape, options.material, case)
        bearable = bending <= options.loads.demand_limit and buckling <= options.loads.buckling_limit
        if bearable and (accept is None or accept(case)):
            return case
    raise OptionError(
        f"No load in the given range is bearable for a beam of {' x '.join(map(str, job.size_cm))} cm; "
        "lower loads.force or loads.force_scale, or raise loads.demand_limit."
    )
