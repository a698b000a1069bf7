"""What the solver says of a hard case of a liquid: frames of the vessel's way, its stop, and of the liquid after it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from zsdt.errors import RunRejected
from zsdt.evaluation.stability_glass_cases import LEAD, Beginning, GlassCase
from zsdt.fluid.motion import Excitation
from zsdt.fluid.sampling import fill
from zsdt.fluid.solver import GRAVITY, LiquidFrame, SphOptions, SphSolver
from zsdt.fluid.vessel import Vessel
from zsdt.trajectory import Body, Trajectory

FIELDS = ("position", "velocity", "internal_energy", "density", "pressure")
SETTLE = 0.2  # s
LEANT = 0.6  # s of gravity askew, in which the liquid comes to rest
THICK = 1.0  # Pa s: with which it does
LOW, HIGH = 0.012, 0.026  # m: bottom of the two lumps
INTERVAL = 1 / 240  # s: of the watch while the vessel is stopped


@dataclass
class GlassTruth:
    """trajectory: from t0 on, of all wanted frames, of which the first `known` are true (NaN after them). inside
    [frames, nodes]: not spilled. way [frames] m: of the vessel in all frames of a film, lead and stop included; before:
    states in those before t0. reason: why the solver gave up where it did."""

    trajectory: Trajectory
    known: int
    inside: Bool[np.ndarray, "frames nodes"]
    way: Float[np.ndarray, " film"]
    before: list[LiquidFrame]
    reason: str = ""

    @property
    def spilled(self) -> int:
        """Particles that are gone in the last known frame."""
        return int((~self.inside[self.known - 1]).sum())


class Askew:
    """A vessel that stands still while gravity leans by an angle [rad] in the plane of the picture."""

    def __init__(self, angle: float):
        self.angle = angle

    def acceleration(self, t: float) -> Float[np.ndarray, "3"]:
        """None."""
        return np.zeros(3)

    def gravity(self, t: float) -> Float[np.ndarray, "3"]:
        """[m/s2]."""
        return -GRAVITY[2] * np.array([math.sin(self.angle), 0.0, -math.cos(self.angle)])


def started(case: GlassCase, particles: int | None = None) -> SphSolver:
    """The solver before the vessel is moved. Raises: RunRejected ("packing", "layers" and others)."""
    vessel, options = Vessel(case.shape), SphOptions()
    rng = np.random.default_rng(7)
    filling = fill(vessel, case.fill, particles or case.particles, rng, options.smoothing, options.fineness)
    motion = case.excitation() if case.beginning is Beginning.moved else None
    if case.beginning is Beginning.lumps:
        loose = SphOptions(watch=replace(options.watch, layers=1.0))  # thin at rest, but it is not at rest
        points = lumps(case.volume, filling.spacing, min(case.shape.radii))
        return SphSolver(vessel, case.liquid, points, filling.spacing, loose, tables=filling.tables)
    solver = SphSolver(vessel, case.liquid, filling.points, filling.spacing, options, motion, filling.tables)
    solver.settle(SETTLE)
    if case.beginning is Beginning.leaning:
        _lean(solver, case)
    return solver


def _lean(solver: SphSolver, case: GlassCase) -> None:
    """Lets the liquid come to rest under gravity askew, then sets the vessel upright at once."""
    liquid, motion = solver.liquid, solver.motion
    solver.motion, solver.liquid = Askew(case.lean), replace(liquid, viscosity=THICK)
    for _ in range(round(LEANT / INTERVAL)):
        solver.advance(INTERVAL)
    solver.liquid, solver.motion = liquid, motion
    solver.start()


def lumps(volume: float, spacing: float, radius: float) -> Float[np.ndarray, "n 3"]:
    """Two square pillars of particles of half the volume [m3] each beside the axis of a vessel of `radius` [m], one
    higher than the other."""
    wide = max(2, int(0.75 * (radius - spacing) / spacing))
    tall = max(2, round(0.5 * volume / spacing**3 / wide**2))
    counts = (np.arange(wide), np.arange(wide), np.arange(tall))
    grid = spacing * np.stack(np.meshgrid(*counts, indexing="ij"), axis=-1).reshape(-1, 3)
    grid[:, 1] -= 0.5 * spacing * (wide - 1)
    left, right = np.array([0.6 * spacing, 0.0, LOW]), np.array([0.6 * spacing, 0.0, HIGH])
    return np.concatenate([(grid + left) * [-1.0, 1.0, 1.0], grid + right])


def glass_truth(case: GlassCase, particles: int | None = None) -> GlassTruth:
    """Runs the solver. Raises: RunRejected where it has no first frame."""
    solver = started(case, particles)
    excitation, dt = case.excitation(), 1.0 / case.fps
    moving = math.ceil(excitation.duration / dt - 1e-9)
    lead = LEAD if case.beginning is Beginning.moved else 0
    before = [solver.frame()] * lead
    if moving:
        # The stop ends on a frame: the vessel's way is laid so that t0 is one.
        for k in range(moving):
            before.append(solver.frame())
            _advance(solver, min((k + 1) * dt, excitation.duration) - solver.time)
        _advance(solver, moving * dt - solver.time)
    first = solver.frame()
    n = solver.particles
    body = Body(
        points=first.position,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(n, bool),
        mass=np.full(n, case.liquid.density * solver.spacing**3),
        frame_dt=dt,
        pitch=solver.spacing,
        gravity=np.array(GRAVITY),
        liquid=case.liquid,
        vessel=case.shape,
        motion=excitation.history(),
    )
    fields = {name: np.full((case.frames, n, getattr(first, name).shape[1]), np.nan) for name in FIELDS}
    inside, books = np.zeros((case.frames, n), bool), {name: np.full(case.frames, np.nan) for name in BOOKS}
    known, reason = 0, ""
    try:
        for k in range(case.frames):
            if k:
                _advance(solver, dt)
            frame = solver.frame()
            for name in FIELDS:
                fields[name][k] = getattr(frame, name)
            inside[k] = frame.inside
            for name, value in _booked(frame).items():
                books[name][k] = value
            known = k + 1
    except RunRejected as error:
        reason = f"{error.cause}: {error}"
    times, load = dt * np.arange(case.frames), np.zeros((case.frames, n, 3))
    trajectory = Trajectory(body, times, fields, load, books, {"name": case.name})
    return GlassTruth(trajectory, known, inside, way_of(excitation, lead, moving, case), before, reason)


BOOKS = ("kinetic", "potential", "internal", "heat", "work_of_ports")


def _booked(frame: LiquidFrame) -> dict[str, float]:
    """The solver's account as the table reads it; energy that left over the rim counts as work of the ports."""
    a = frame.account
    heat = a.friction + a.impulse + a.numerical + a.guard
    ports = a.work_inertial + a.wall_work - a.spilled
    return {
        "kinetic": a.kinetic,
        "potential": a.potential,
        "internal": a.internal,
        "heat": heat,
        "work_of_ports": ports,
    }


def _advance(solver: SphSolver, duration: float) -> None:
    """Advances in pieces that are watched."""
    if duration <= 1e-12:
        return
    pieces = max(1, math.ceil(duration / INTERVAL - 1e-9))
    for _ in range(pieces):
        solver.advance(duration / pieces)


def way_of(excitation: Excitation, lead: int, moving: int, case: GlassCase) -> Float[np.ndarray, " film"]:
    """Place x [m] of the vessel in all frames of the film; zero from t0 on."""
    times = (np.arange(lead + moving + case.frames) - lead) / case.fps
    fine = np.linspace(min(float(times[0]), 0.0), max(excitation.duration, 1e-9), 2_000)
    speed = np.array([excitation.velocity(t)[0] for t in fine])
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(fine))])
    return np.interp(times, fine, travelled - travelled[-1])
