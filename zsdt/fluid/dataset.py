"""Makes data sets of simulated liquids: one HDF5 file per trajectory, in parallel, the same for any worker count."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from zsdt.errors import RunRejected
from zsdt.fluid.sampler import Case, Job, LiquidSynthesisOptions, draw_case, plan
from zsdt.fluid.sampling import fill
from zsdt.fluid.solver import LiquidFrame, SphSolver
from zsdt.fluid.vessel import Vessel
from zsdt.trajectory import Body, DatasetEntry, Trajectory, write_index
from zsdt.workers import WHOLE, Shard, first_accepted, make_files, plain

FIELDS = ("position", "velocity", "internal_energy", "density", "pressure")
LIVELY = 0.02  # m/s: a particle that is still faster after settling is not at rest


def body_of(solver: SphSolver, first: LiquidFrame, case: Case, options: LiquidSynthesisOptions) -> Body:
    """The liquid as engines know it before the first frame: particles of one mass, no fixed neighbours."""
    n = solver.particles
    return Body(
        points=first.position,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(n, bool),
        mass=np.full(n, options.liquid.density * solver.spacing**3),
        frame_dt=options.frame_dt,
        pitch=solver.spacing,
        gravity=np.asarray(case.excitation.gravity(case.excitation.duration), np.float64),
        liquid=options.liquid,
        vessel=case.shape,
        motion=case.excitation.history(),
    )


def prepare(case: Case, options: LiquidSynthesisOptions) -> SphSolver:
    """The solver with packed and settled particles, at rest in the vessel before it is excited.

    Raises: RunRejected ("packing", "layers", "unsettled").
    """
    vessel, solver_options = Vessel(case.shape), options.solver
    filling = fill(
        vessel,
        case.fill,
        case.particles,
        np.random.default_rng(case.seed),
        solver_options.smoothing,
        solver_options.fineness,
    )
    solver = SphSolver(
        vessel,
        options.liquid,
        filling.points,
        filling.spacing,
        solver_options,
        motion=case.excitation,
        tables=filling.tables,
    )
    left = solver.settle(options.settle)
    if left > LIVELY:
        raise RunRejected(
            "unsettled",
            f"A particle still moves at {left:.3f} m/s after settling (limit {LIVELY:g}); let it settle for longer.",
        )
    return solver


def _advance(solver: SphSolver, duration: float) -> None:
    """Advances; a particle over the rim is a rejection: the number of particles of a trajectory is fixed."""
    solver.advance(duration)
    if solver.spilled:
        raise RunRejected(
            "spill", f"{solver.spilled} particles went over the rim; use more freeboard or a gentler motion."
        )


def excite(solver: SphSolver, case: Case, interval: float) -> None:
    """Runs the solver to the end of the excitation, in pieces of at most `interval` [s] that are watched."""
    duration = case.excitation.duration
    if duration > 0.0:
        pieces = int(np.ceil(duration / interval - 1e-9))
        for _ in range(pieces):
            _advance(solver, duration / pieces)
    if case.excitation.jump.any():  # a stop at once, with nothing before it: the vessel stands, the liquid goes on
        solver.start(np.broadcast_to(case.excitation.jump, (solver.particles, 3)))


def simulate(job: Job, case: Case, options: LiquidSynthesisOptions) -> Trajectory:
    """Packs, settles, moves the vessel, and records frames from the end of the excitation on.

    Raises: RunRejected where the run leaves its range or liquid is spilled.
    """
    solver = prepare(case, options)
    excite(solver, case, options.frame_dt)
    frames, kept = round(options.duration / options.frame_dt), [solver.frame()]
    watched = {"mach": 0.0, "density": 0.0}
    for _ in range(frames):
        _advance(solver, options.frame_dt)
        frame = solver.frame()
        kept.append(frame)
        speed = float(np.linalg.norm(frame.velocity, axis=1).max())
        watched["mach"] = max(watched["mach"], speed / options.liquid.sound_speed)
        off = float(np.abs(frame.density / options.liquid.density - 1.0).max())
        watched["density"] = max(watched["density"], off)
    accounts = [frame.account.joules() for frame in kept]
    body = body_of(solver, kept[0], case, options)
    return Trajectory(
        body=body,
        times=options.frame_dt * np.arange(frames + 1),
        fields={name: np.stack([getattr(frame, name) for frame in kept]) for name in FIELDS},
        load=np.zeros((frames + 1, body.nodes, 3)),
        ledger={name: np.array([a[name] for a in accounts]) for name in accounts[0]},
        meta={
            "name": job.name,
            "regime": options.liquid.name,
            "family": job.family.value,
            "fill": case.fill,
            "stop": plain(case.excitation.describe()),
            "spacing": solver.spacing,
            "particles": solver.particles,
            "dt": options.frame_dt / max(1, int(np.ceil(options.frame_dt / solver.critical_dt - 1e-9))),
            "leaks": _leaks(solver, kept),
            "guards": solver.guards,
            "clips": solver.clips,
            "watched": watched,
        },
    )


def _leaks(solver: SphSolver, frames: list[LiquidFrame]) -> int:
    """Particles that are inside the wall below the rim in any frame, by the exact distance."""
    outside = [(solver.vessel.distance(f.position) < 0.0) & (f.position[:, 2] < solver.vessel.rim) for f in frames]
    return int(np.any(outside, axis=0).sum())


def make_trajectory(job: Job, options: LiquidSynthesisOptions) -> Trajectory:
    """The first case of a job that is not rejected (see `zsdt.workers.first_accepted`)."""
    return first_accepted(job, options, draw_case, simulate, "use gentler motions or more freeboard")


def generate(
    options: LiquidSynthesisOptions, out: str | os.PathLike[str], workers: int = 1, shard: Shard = WHOLE
) -> dict[str, Any]:
    """Writes the data set, or a piece of it, into folder `out`: `index.csv`, `options.json` and `trajectories/*.h5`.

    Trajectories depend on the options alone, not on `workers` (processes of one thread each) nor on `shard`; pieces
    are put together by `zsdt.workers.take_pieces`. A run that was cut off goes on where it was. Gives back numbers for
    a manifest (see `zsdt.workers.make_files`).

    Raises: OptionError, DataError (disk), RunRejected where a trajectory finds no case that is not rejected.
    """
    jobs = plan(options)

    def cost(job: Job) -> float:
        case = draw_case(job, options, 0)
        return float(case.particles) ** (4.0 / 3.0) / Vessel(case.shape).volume(case.fill) ** (1.0 / 3.0)

    jobs = shard.share(jobs, cost)
    figures = make_files(make_trajectory, jobs, cost, options, out, workers, "liquids")
    entries = [
        DatasetEntry(f"trajectories/{j.name}.h5", j.name, j.split, options.liquid.name, j.family.value) for j in jobs
    ]
    write_index(out, entries)
    return figures
