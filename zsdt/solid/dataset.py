"""Makes data sets of simulated beams: one HDF5 file per trajectory, in parallel, the same for any number of workers."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

import numpy as np

from zsdt.errors import RunRejected
from zsdt.graph import brick_grid
from zsdt.solid.loads import LoadCase, bending_frequency
from zsdt.solid.mesh import BrickMesh, CoarseView, mesh_of
from zsdt.solid.sampler import Job, SynthesisOptions, draw_case, duration, frame_dt, plan
from zsdt.solid.solver import BrickSolver, Frame, Load
from zsdt.trajectory import Body, DatasetEntry, Trajectory, write_index
from zsdt.workers import WHOLE, Shard, first_accepted, make_files

LEDGER = ("kinetic", "elastic", "dissipated", "work_load", "work_gravity", "residual")


def body_of(coarse: BrickMesh, options: SynthesisOptions, dt: float) -> Body:
    """The beam as its graph sees it: the grid of the output pitch with lumped masses [kg], frames of `dt` [s]."""
    grid = brick_grid(coarse.counts, coarse.edge)
    return Body(
        points=grid.points,
        pairs=grid.pairs,
        clamped=grid.points[:, 0] < 1e-9,
        mass=options.material.density * coarse.volume,
        frame_dt=dt,
        pitch=coarse.edge,
        gravity=np.array([0.0, 0.0, -options.gravity]),
        cells=grid.cells,
        material=options.material,
    )


class _Recorder:
    """Gathers frames on the output grid: nodal values where they are, forces and energies spread so that sums stay."""

    def __init__(self, view: CoarseView):
        self.view = view
        self.fields: dict[str, list[np.ndarray]] = {}
        self.load: list[np.ndarray] = []
        self.balance: list[float] = []
        self.ledger: dict[str, list[float]] = {name: [] for name in LEDGER}

    def add(self, frame: Frame) -> None:
        """Takes one frame."""
        view = self.view
        for name in ("position", "velocity", "stress"):
            self.fields.setdefault(name, []).append(getattr(frame, name)[view.picked])
        for name in ("elastic_energy", "dissipated_energy"):
            joules = view.spread @ (getattr(frame, name) * view.fine.volume[:, None])
            self.fields.setdefault(name, []).append(joules / view.coarse.volume[:, None])
        self.load.append(view.spread @ frame.load)
        for name in LEDGER[:-1]:
            self.ledger[name].append(getattr(frame, name))
        self.balance.append(frame.balance)
        self.ledger["residual"].append(frame.balance - self.balance[0])

    def check(self, limit: float) -> None:
        """Raises RunRejected where the energy account does not close."""
        stored = max(k + e for k, e in zip(self.ledger["kinetic"], self.ledger["elastic"], strict=True))
        residual = self.ledger["residual"][-1]
        if not abs(residual) <= limit * stored:
            raise RunRejected(
                "ledger",
                f"The energy account is off by {residual:.2e} J where {stored:.2e} J are stored; "
                "use a smaller step_fraction or load.",
            )


def simulate(job: Job, case: LoadCase, options: SynthesisOptions) -> Trajectory:
    """Runs one load case from rest under gravity and the load that holds at the first frame.

    Raises: RunRejected where the run leaves its range.
    """
    fine, coarse = mesh_of(job.shape, options.mesh), mesh_of(job.shape, options.pitch)
    view = CoarseView(fine, coarse)
    interval = frame_dt(options, job.regime)
    frames = round(duration(options, job.regime) / interval)
    solver = BrickSolver(fine, options.material, options.solver, np.array([0.0, 0.0, -options.gravity]))
    substeps = int(np.ceil(interval / solver.dt - 1e-9))
    solver.dt = interval / substeps
    load = Load(faces=case.faces(fine))
    solver.relax(load, float(case.pressure(np.zeros(1))[0]))
    recorder = _Recorder(view)
    recorder.add(solver.frame())
    for frame in range(frames):
        times = frame * interval + solver.dt * np.arange(1, substeps + 1)
        solver.step(load, case.pressure(times))
        recorder.add(solver.frame())
        recorder.check(options.ledger_limit)
    return Trajectory(
        body=body_of(coarse, options, interval),
        times=interval * np.arange(frames + 1),
        fields={name: np.stack(values) for name, values in recorder.fields.items()},
        load=np.stack(recorder.load),
        ledger={name: np.array(values) for name, values in recorder.ledger.items()},
        meta={
            "name": job.name,
            "regime": job.regime.value,
            "shape": asdict(job.shape),
            "load": case.describe(),
            "element": options.solver.element.value,
            "mesh": options.mesh,
            "dt": solver.dt,
            "first_frequency": bending_frequency(job.shape, options.material),
        },
    )


def make_trajectory(job: Job, options: SynthesisOptions) -> Trajectory:
    """The first case of a job that is not rejected (see `zsdt.workers.first_accepted`)."""
    return first_accepted(job, options, draw_case, simulate, "lower loads.demand_limit or the forces")


def generate(
    options: SynthesisOptions, out: str | os.PathLike[str], workers: int = 1, shard: Shard = WHOLE
) -> dict[str, Any]:
    """Writes the data set, or a piece of it, into folder `out`: `index.csv`, `options.json` and `trajectories/*.h5`.

    Trajectories depend on the options alone, not on `workers` (processes of one thread each) nor on `shard`; pieces
    are put together by `zsdt.workers.take_pieces`. A run that was cut off goes on where it was. Gives back numbers for
    a manifest (see `zsdt.workers.make_files`).

    Raises: OptionError, DataError (disk), RunRejected where a trajectory finds no load that it survives.
    """
    jobs = plan(options)

    def cost(job: Job) -> float:
        return float(np.prod(job.size_cm) * duration(options, job.regime))

    jobs = shard.share(jobs, cost)
    figures = make_files(make_trajectory, jobs, cost, options, out, workers, "beams")
    entries = [
        DatasetEntry(f"trajectories/{j.name}.h5", j.name, j.split, j.regime.value, "x".join(map(str, j.size_cm)))
        for j in jobs
    ]
    write_index(out, entries)
    return figures
