"""The hidden physics of the virtual laboratory: beams that are not quite what the twin believes them to be.

The same solver as the twin's training data, but another mesh where the sizes allow it, another material (E, g1, tau
and density off by up to a fifth), and a load that nobody tells the twin.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError, RunRejected
from zsdt.lab.clip_files import Storage
from zsdt.lab.styles import Pool
from zsdt.perception.camera import ClampSide
from zsdt.scene import BeamShape, Foam
from zsdt.solid.dataset import simulate
from zsdt.solid.loads import LoadCase, LoadOptions, Regime, bending_frequency, relaxed_young
from zsdt.solid.mesh import Face
from zsdt.solid.sampler import Job, Size, SizeRange, SynthesisOptions, draw_case, plan
from zsdt.solid.solver import SolverOptions
from zsdt.trajectory import Body, Trajectory
from zsdt.workers import first_accepted

# How far the damped foam swings over its static deflection, about: a sine near resonance, an impulse of half a period.
SWING = {"sine": 2.5, "impulse": 0.6}
MATERIAL_FACTORS = ("young", "g1", "tau", "density")


class Side(Enum):
    """On which side of the pictures the beams are clamped."""

    left = "left"
    right = "right"
    random = "random"


@dataclass
class BeamLabOptions:
    """Clips of foam beams in front of a camera.

    clips: how many; frames of each, at `fps` per second; width, height [px]. sizes: of the beams, without
    `exclude_cm` (those that a network was trained on, see `trained_sizes`). hand_fraction: share of the hand regime.
    nominal: the material that the twin is told. mismatch: largest relative error of it in E, g1, tau and density.
    signs: empty for random factors within the mismatch, or four of -1, 0, 1: factors fixed at its full size. mesh_cm:
    meshes to choose from, the first that divides the beam into at most max_cells; pitch [m] of the painted grid.
    motion [m]: smallest movement of the tip within the picture, by beam theory; loads that nobody would see are not
    taken, nor are beams too stout for any load of `loads` to be seen. planar: only loads on top or bottom; otherwise
    also loads that bend the beam out of the picture's plane, of which one camera sees little. at_rest: the first frame
    shows the beam under its weight alone (a load that is held already cannot be told from a softer foam). max_step
    [m]: largest movement from frame to frame; what is faster needs another camera.
    pool: of the styles. tilt_deg, focal, fill, distortion: of the camera (see `StillOptions`). calibration: relative
    error of the focal length and, in rad, of the angles that the twin is told. jitter_px: shaking of the camera,
    flicker: of its exposure (both standard deviations). shutter: range of the exposure over the time between frames.
    storage; mask_every: frames between two stored masks. depth_maps: whether a depth camera films as well; its noise
    [m] (standard deviation).
    """

    clips: int = 4
    frames: int = 120
    fps: float = 60.0
    width: int = 960
    height: int = 540
    sizes: SizeRange = field(default_factory=SizeRange)
    exclude_cm: list[list[int]] = field(default_factory=list)
    hand_fraction: float = 0.5
    nominal: Foam = field(default_factory=Foam)
    gravity: float = 9.81
    mismatch: float = 0.2
    signs: list[int] = field(default_factory=list)
    mesh_cm: list[float] = field(default_factory=lambda: [5.0 / 3.0, 2.5])
    max_cells: int = 2500
    pitch: float = 0.05
    motion: float = 0.025
    planar: bool = True
    at_rest: bool = True
    max_step: float = 0.02
    loads: LoadOptions = field(default_factory=LoadOptions)
    solver: SolverOptions = field(default_factory=SolverOptions)
    pool: Pool = Pool.unseen
    clamp_side: Side = Side.random
    tilt_deg: float = 2.0
    focal: list[float] = field(default_factory=lambda: [0.9, 1.4])
    fill: list[float] = field(default_factory=lambda: [0.6, 0.85])
    distortion: float = 0.08
    calibration: float = 0.001
    jitter_px: float = 0.25
    flicker: float = 0.01
    shutter: list[float] = field(default_factory=lambda: [0.1, 0.5])
    storage: Storage = Storage.video
    mask_every: int = 60
    depth_maps: bool = False
    depth_noise: float = 0.001
    max_attempts: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        if self.clips < 1 or self.frames < 2 or self.fps <= 0 or self.mask_every < 1:
            raise OptionError("A virtual lab needs at least one clip of two frames, a positive fps and mask_every.")
        if not 0.0 <= self.mismatch < 0.6:
            raise OptionError(f"mismatch is {self.mismatch}; choose a relative error from 0 to below 0.6.")
        if self.signs and (len(self.signs) != 4 or any(sign not in (-1, 0, 1) for sign in self.signs)):
            raise OptionError("signs must be empty or four of -1, 0, 1: for E, g1, tau and density.")
        if len(self.shutter) != 2 or not 0.0 <= self.shutter[0] <= self.shutter[1] <= 1.0:
            raise OptionError("shutter must be [shortest, longest] within 0 to 1 of the time between frames.")
        if not self.mesh_cm or min(self.mesh_cm) <= 0 or self.pitch <= 0:
            raise OptionError("mesh_cm and pitch must be positive.")
        if min(self.calibration, self.jitter_px, self.flicker, self.depth_noise) < 0:
            raise OptionError(
                "calibration, jitter_px, flicker and depth_noise are sizes of errors; they cannot be negative."
            )


@dataclass(frozen=True)
class ClipPlan:
    """One clip to make: its number and the size [cm] and regime of its beam."""

    number: int
    size_cm: Size
    regime: Regime

    @property
    def name(self) -> str:
        """Name, unique in the set."""
        return f"clip_{self.number:03d}"

    def rng(self, options: BeamLabOptions, topic: int) -> np.random.Generator:
        """Random numbers of one topic of this clip; they depend on nothing else that is made beside it."""
        return np.random.default_rng([options.seed, 0x1AB, self.number, topic])


def plan_clips(options: BeamLabOptions) -> list[ClipPlan]:
    """All clips, in the order of their index. Raises: OptionError where no size is left."""
    excluded = {tuple(size) for size in options.exclude_cm}
    fresh = [size for size in options.sizes.sizes() if size not in excluded]
    order = np.random.default_rng([options.seed, 0x1AB]).permutation(len(fresh))
    seen = [fresh[k] for k in order if largest_motion(fresh[k], options) >= 1.5 * options.motion]  # not only at the tip
    slow = [
        s for s in seen if swing_step(options.motion, _shape(s), options.nominal, options.fps) < 0.8 * options.max_step
    ]
    plans = []
    taken: set[Size] = set()
    for k in range(options.clips):
        hand = int((k + 1) * options.hand_fraction + 1e-9) > int(k * options.hand_fraction + 1e-9)
        pool = seen if hand else slow
        if not pool:
            raise OptionError(
                f"Of {len(fresh)} sizes that exclude_cm leaves, none moves visibly and slowly enough for the camera; "
                "widen sizes, lower motion or raise fps."
            )
        taken = taken if set(pool) - taken else set()
        size = next(s for s in pool if s not in taken)
        taken.add(size)
        plans.append(ClipPlan(k, size, Regime.hand if hand else Regime.dynamic))
    return plans


def _shape(size_cm: Size) -> BeamShape:
    length, width, depth = (round(cm / 100.0, 6) for cm in size_cm)
    return BeamShape(length, width, depth)


def trained_sizes(options: SynthesisOptions) -> list[list[int]]:
    """Sizes [cm] that a data set trains and validates on, for `exclude_cm`."""
    return [list(size) for size in sorted({job.size_cm for job in plan(options) if job.split in ("train", "val")})]


def hidden_material(plan: ClipPlan, options: BeamLabOptions) -> tuple[Foam, dict[str, float]]:
    """The material of the lab's beam, and the factors by which it differs from the nominal one."""
    rng = plan.rng(options, 1)
    errors = rng.uniform(-options.mismatch, options.mismatch, len(MATERIAL_FACTORS))
    if options.signs:
        errors = options.mismatch * np.asarray(options.signs, float)
    factors = {name: 1.0 + float(error) for name, error in zip(MATERIAL_FACTORS, errors, strict=True)}
    changed = {name: getattr(options.nominal, name) * factor for name, factor in factors.items()}
    changed["g1"] = min(changed["g1"], 0.95)  # a fully relaxing foam would flow
    return replace(options.nominal, **changed), factors


def hidden_mesh(size_cm: Size, options: BeamLabOptions) -> float:
    """Edge [m] of the mesh of the lab's beam: the first choice that divides its sides and its grid and is affordable.

    Raises: OptionError where none divides them.
    """
    fitting = []
    for edge in options.mesh_cm:
        lengths = np.array([*size_cm, 100.0 * options.pitch]) / edge
        if np.abs(lengths - np.rint(lengths)).max() < 1e-6:
            fitting.append(edge)
            if np.prod(np.rint(lengths[:3])) <= options.max_cells:
                return edge / 100.0
    if not fitting:
        raise OptionError(
            f"None of the meshes {options.mesh_cm} cm divides a beam of {' x '.join(map(str, size_cm))} cm and its "
            f"grid of {100 * options.pitch:g} cm; add one to mesh_cm."
        )
    return max(fitting) / 100.0


def tip_motion(shape: BeamShape, material: Foam, force: float, lever: float) -> float:
    """Movement of the tip [m] of the relaxed beam in bending and shear, under a force [N] at `lever` [m]."""
    young = relaxed_young(material)
    area, inertia = shape.width * shape.depth, shape.width * shape.depth**3 / 12.0
    shear = 5.0 / 6.0 * material.shear * (1.0 - material.g1) * area
    return force * (lever**2 * (3.0 * shape.length - lever) / (6.0 * young * inertia) + lever / shear)


def largest_motion(size_cm: Size, options: BeamLabOptions) -> float:
    """Movement of the tip [m] of the nominal beam under the largest force, at the tip."""
    shape = _shape(size_cm)
    force = options.loads.force[1] * options.loads.force_scale
    return tip_motion(shape, options.nominal, force, shape.length)


def seen_motion(shape: BeamShape, material: Foam, case: LoadCase, times: Float[np.ndarray, " times"]) -> float:
    """Movement of the tip within the picture [m] since the first of `times` [s], by beam theory at rest.

    Loads from the front and the back and pushes on the tip count as not seen.
    """
    if case.face not in (Face.top, Face.bottom):
        return 0.0
    history = case.history(times)
    change = float(np.abs(history - history[0]).max()) * abs(case.force)
    return tip_motion(shape, material, change, 0.5 * (case.first[0] + case.first[1]))


def simulate_hidden(plan: ClipPlan, options: BeamLabOptions) -> Trajectory:
    """What the lab's beam does, at the times of the frames, on the grid that is painted on it.

    Loads that it does not bear are drawn again; causes of the rejected ones are in the meta data, with the factors of
    the material and the mesh. Raises: RunRejected where no load is borne.
    """
    material, factors = hidden_material(plan, options)
    interval = 1.0 / options.fps
    span = (options.frames - 1) * interval
    physics = SynthesisOptions(
        hand_duration=span,
        dynamic_duration=span,
        hand_frame_dt=interval,
        dynamic_frame_dt=interval,
        mesh=hidden_mesh(plan.size_cm, options),
        pitch=options.pitch,
        gravity=options.gravity,
        material=material,
        solver=options.solver,
        loads=options.loads,
        max_attempts=options.max_attempts,
        seed=options.seed,
    )
    job = Job("test", plan.number, plan.size_cm, plan.regime)
    times = interval * np.arange(options.frames)

    def accept(case: LoadCase) -> bool:
        if options.at_rest and abs(case.history(times[:1])[0]) > 0:
            return False
        if not options.planar and case.face in (Face.front, Face.back):
            return True
        seen = seen_motion(job.shape, material, case, times)
        if plan.regime is Regime.hand:
            return seen >= options.motion
        # Guesses of the swing and its speed; what the solver finds is judged again.
        seen *= SWING.get(case.history.kind, 1.0)
        return seen >= options.motion and swing_step(seen, job.shape, material, options.fps) <= options.max_step

    def draw(job: Job, physics: SynthesisOptions, attempt: int) -> LoadCase:
        try:
            return draw_case(job, physics, attempt, accept)
        except OptionError as error:
            raise OptionError(
                f"No load of the given range moves a beam of {' x '.join(map(str, job.size_cm))} cm visibly, bearably "
                "and slowly enough for the camera; lower motion, raise max_step or fps, or change loads.force."
            ) from error

    trajectory = first_accepted(
        job,
        physics,
        draw,
        lambda job, case, physics: _slow_enough(simulate(job, case, physics), options.max_step),
        "raise max_step or fps, or lower loads.demand_limit or the forces",
    )
    trajectory.meta.update(name=plan.name, factors=factors, virtual_lab=True)
    return trajectory


def swing_step(amplitude: float, shape: BeamShape, material: Foam, fps: float) -> float:
    """Movement per frame [m] of a swing of `amplitude` [m] at the first bending frequency."""
    return 2.0 * np.pi * bending_frequency(shape, material) * amplitude / fps


def _slow_enough(trajectory: Trajectory, limit: float) -> Trajectory:
    """The trajectory. Raises: RunRejected where a node moves by more than `limit` [m] from one frame to the next."""
    steps = np.linalg.norm(np.diff(trajectory.fields["position"], axis=0), axis=2)
    if steps.max() > limit:
        raise RunRejected(
            "too_fast",
            f"The beam moves by {1000 * steps.max():.0f} mm from frame to frame, more than max_step; use a higher fps.",
        )
    return trajectory


def node_grid(body: Body, side: ClampSide | str) -> dict[str, np.ndarray]:
    """Ids [columns, rows] of the nodes of the visible (`near`) and the hidden (`far`) side face of a brick grid.

    Column 0 is at the clamp, row 0 at the bottom.
    """
    counts = np.rint(np.ptp(body.points, axis=0) / body.pitch).astype(int) + 1
    index = np.arange(body.nodes).reshape(counts[::-1]).transpose(2, 1, 0)  # x, y, z
    low_y, high_y = index[:, 0], index[:, -1]
    near, far = (low_y, high_y) if ClampSide(side) is ClampSide.left else (high_y, low_y)
    return {"near": near, "far": far}


def slow_noise(
    rng: np.random.Generator, frames: int, components: int, memory: float = 0.8
) -> Float[np.ndarray, "frames components"]:
    """Random walk that is pulled back to zero, of unit standard deviation: shaking and flicker from frame to frame."""
    kicks = rng.standard_normal((frames, components))
    values = np.empty_like(kicks)
    values[0] = kicks[0]
    for k in range(1, frames):
        values[k] = memory * values[k - 1] + np.sqrt(1.0 - memory**2) * kicks[k]
    return values
