"""Makes data sets of simulated beams: one HDF5 file per trajectory, in parallel, the same for any number of workers."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from enum import Enum
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from zsdt.errors import DataError, RunRejected
from zsdt.files import atomic_path
from zsdt.graph import brick_grid
from zsdt.solid.loads import LoadCase, bending_frequency
from zsdt.solid.mesh import BrickMesh, CoarseView, mesh_of
from zsdt.solid.sampler import Job, SynthesisOptions, draw_case, duration, frame_dt, plan
from zsdt.solid.solver import BrickSolver, Frame, Load
from zsdt.trajectory import Body, DatasetEntry, Trajectory, read_trajectory, write_index, write_trajectory

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
    """Draws and runs load cases until one is not rejected; causes of the rejected ones are in the meta data.

    Raises: RunRejected where `max_attempts` in a row are.
    """
    rejected: list[str] = []
    for attempt in range(options.max_attempts):
        case = draw_case(job, options, attempt)
        try:
            trajectory = simulate(job, case, options)
        except RunRejected as error:
            rejected.append(error.cause)
            continue
        trajectory.meta.update(seed=job.seed(options.seed, attempt), rejected=rejected)
        return trajectory
    raise RunRejected(
        "attempts",
        f"All {options.max_attempts} load cases for {job.name} ({' x '.join(map(str, job.size_cm))} cm) were rejected "
        f"({', '.join(f'{n} {c}' for c, n in Counter(rejected).items())}); lower loads.demand_limit or the forces.",
    )


def _work(job: Job, options: SynthesisOptions, path: str) -> dict[str, Any]:
    """Makes one file; says what it took."""
    began = time.process_time()
    trajectory = make_trajectory(job, options)
    write_trajectory(path, trajectory)
    return {
        "rejected": trajectory.meta["rejected"],
        "frames": trajectory.frames,
        "simulated": float(trajectory.times[-1]),
        "seconds": time.process_time() - began,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10),
    }


def _plain(value: Any) -> Any:
    """Options as plain values, for JSON."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


def _resume(out: Path, options: SynthesisOptions, jobs: list[Job]) -> dict[str, dict[str, Any]]:
    """What an interrupted run with the same options left in `out`; anything else there is an error."""
    card, wanted = out / "options.json", json.dumps(_plain(asdict(options)), indent=1, sort_keys=True)
    if not card.exists():
        with atomic_path(card) as beside:
            beside.write_text(wanted)
        return {}
    if card.read_text() != wanted:
        raise DataError(f"{out} holds a data set with other options; choose another folder or delete it.")
    done = {}
    for job in jobs:
        path = out / "trajectories" / f"{job.name}.h5"
        if path.exists():
            trajectory = read_trajectory(path)
            done[job.name] = {
                "rejected": trajectory.meta["rejected"],
                "frames": trajectory.frames,
                "simulated": float(trajectory.times[-1]),
                "seconds": 0.0,
                "peak_mb": 0.0,
            }
    return done


def generate(options: SynthesisOptions, out: str | os.PathLike[str], workers: int = 1) -> dict[str, Any]:
    """Writes the data set into folder `out`: `index.csv`, `options.json` and `trajectories/*.h5`.

    Trajectories depend on the options alone, not on `workers` (processes of one thread each). A run that was cut
    off goes on where it was. Gives back numbers for a manifest: trajectories, frames, simulated seconds, rejections
    by cause, wall and processor time in s, largest memory of a worker in MB.

    Raises: OptionError, DataError (disk), RunRejected where a trajectory finds no load that it survives.
    """
    began = time.perf_counter()
    folder = Path(out)
    jobs = plan(options)
    (folder / "trajectories").mkdir(parents=True, exist_ok=True)
    results = _resume(folder, options, jobs)
    todo = [job for job in jobs if job.name not in results]
    todo.sort(key=lambda j: -np.prod(j.size_cm) * duration(options, j.regime))  # large ones first: cores end together
    paths = {job.name: str(folder / "trajectories" / f"{job.name}.h5") for job in jobs}
    bar = tqdm(total=len(jobs), initial=len(results), desc="beams", unit="run", disable=None)
    with bar:
        if workers <= 1:
            for job in todo:
                results[job.name] = _work(job, options, paths[job.name])
                bar.update()
        else:
            _in_processes(todo, options, paths, workers, results, bar)
    entries = [
        DatasetEntry(f"trajectories/{j.name}.h5", j.name, j.split, j.regime.value, "x".join(map(str, j.size_cm)))
        for j in jobs
    ]
    write_index(folder, entries)
    causes = Counter(cause for r in results.values() for cause in r["rejected"])
    return {
        "trajectories": len(jobs),
        "frames": sum(r["frames"] for r in results.values()),
        "simulated_s": sum(r["simulated"] for r in results.values()),
        "rejections": dict(sorted(causes.items())),
        "wall_s": time.perf_counter() - began,
        "cpu_s": sum(r["seconds"] for r in results.values()),
        "peak_worker_mb": max(r["peak_mb"] for r in results.values()),
        "workers": workers,
    }


@contextmanager
def _spawning() -> Iterator[BaseContext]:
    """Context that starts fresh processes of one thread each; the settings of this process come back afterwards.

    A spawned process takes over the start method that its parent has as default. In a worker of joblib that is
    ``loky``, which a fresh process does not know, so the default is ``spawn`` while processes are started.
    """
    threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    variables = {name: os.environ.get(name) for name in threads}
    method = multiprocessing.get_start_method(allow_none=True)
    os.environ.update(dict.fromkeys(threads, "1"))
    multiprocessing.set_start_method("spawn", force=True)
    try:
        yield multiprocessing.get_context("spawn")
    finally:
        multiprocessing.set_start_method(method, force=True)
        for name, value in variables.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _in_processes(todo, options, paths, workers, results, bar) -> None:
    """Runs jobs in processes side by side; the first failure stops the rest."""
    with _spawning() as context, ProcessPoolExecutor(workers, mp_context=context) as pool:
        running = {pool.submit(_work, job, options, paths[job.name]): job for job in todo}
        try:
            for future in as_completed(running):
                results[running[future].name] = future.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
