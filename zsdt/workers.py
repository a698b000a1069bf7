"""A folder of trajectories made by simulation: in parallel, resumable, the same for any number of workers."""

from __future__ import annotations

import filecmp
import json
import multiprocessing
import os
import resource
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import Enum
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from tqdm import tqdm

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.files import atomic_path
from zsdt.lifeline import follow
from zsdt.trajectory import Trajectory, read_trajectory, write_trajectory


@runtime_checkable
class NamedJob(Protocol):
    """One trajectory to make; it can be sent to another process."""

    @property
    def name(self) -> str:
        """Name, unique in the data set."""


@dataclass(frozen=True)
class Shard:
    """Piece `number` (from 1) of the `of` pieces in which a data set is made."""

    number: int
    of: int

    @staticmethod
    def parse(text: str) -> Shard:
        """From ``i/n``. Raises: OptionError where that is no piece."""
        number, slash, of = text.partition("/")
        if not (slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
            raise OptionError(f"shard={text} is no piece of a data set; write i/n with 1 <= i <= n, such as shard=2/4.")
        return Shard(int(number), int(of))

    def share(self, jobs: Sequence[Any], cost: Callable[[Any], float]) -> list[Any]:
        """The jobs of this piece, in their order: all are dealt out by falling cost, so that pieces cost about the
        same; every job is in one piece, and which one depends on jobs and costs alone."""
        dealt = sorted(jobs, key=lambda job: (-cost(job), job.name))
        mine = {job.name for job in dealt[self.number - 1 :: self.of]}
        return [job for job in jobs if job.name in mine]


WHOLE = Shard(1, 1)


def take_pieces(pieces: Sequence[Path], out: Path) -> None:
    """Puts the trajectories of finished pieces of a data set into folder `out`, where `make_files` goes on from them
    and makes what is missing. Files are linked where the disk allows it, else copied.

    Raises: DataError where the pieces were made with different options, or a trajectory is in two of them.
    """
    for piece in pieces:
        card, theirs = out / "options.json", (piece / "options.json").read_text()
        if not card.exists():
            with atomic_path(card) as beside:
                beside.write_text(theirs)
        elif card.read_text() != theirs:
            raise DataError(f"{piece} was made with other options than the pieces before it; make it again.")
        for source in sorted((piece / "trajectories").glob("*.h5")):
            target = out / "trajectories" / source.name
            if not target.exists():
                with atomic_path(target) as beside:
                    _link(source, beside)
            elif not filecmp.cmp(source, target, shallow=False):
                raise DataError(f"{source} differs from the same trajectory of another piece; make the pieces again.")


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another disk, or one without links
        shutil.copy(source, target)


MakeTrajectory = Callable[[Any, Any], Trajectory]  # (job, options); its meta data say what was `rejected`


def first_accepted(
    job: Any,
    options: Any,
    draw: Callable[[Any, Any, int], Any],
    simulate: Callable[[Any, Any, Any], Trajectory],
    advice: str,
) -> Trajectory:
    """Draws and runs cases of a job until one is not rejected; causes of the rejected ones are in the meta data.

    `draw(job, options, attempt)` gives a case, `simulate(job, case, options)` its trajectory. `advice`: what to change
    where nothing is accepted.

    Raises: RunRejected where `options.max_attempts` in a row are.
    """
    rejected: list[str] = []
    for attempt in range(options.max_attempts):
        case = draw(job, options, attempt)
        try:
            trajectory = simulate(job, case, options)
        except RunRejected as error:
            rejected.append(error.cause)
            continue
        trajectory.meta.update(seed=job.seed(options.seed, attempt), rejected=rejected)
        return trajectory
    causes = ", ".join(f"{count} {cause}" for cause, count in Counter(rejected).items())
    raise RunRejected(
        "attempts", f"All {options.max_attempts} cases drawn for {job.name} were rejected ({causes}); {advice}."
    )


def make_files(
    make: MakeTrajectory,
    jobs: Sequence[NamedJob],
    cost: Callable[[Any], float],
    options: Any,
    out: str | os.PathLike[str],
    workers: int,
    title: str,
) -> dict[str, Any]:
    """Writes `options.json` and `trajectories/<name>.h5` of all jobs into folder `out`.

    `make` is a function of a module (processes find it by its name); what it makes depends on job and options alone,
    not on `workers` (processes of one thread each). The most costly jobs begin, so that cores end together. A run
    that was cut off goes on where it was. Gives back numbers for a manifest: trajectories, frames, simulated
    seconds, rejections by cause, wall and processor time in s, largest memory of a worker in MB.

    Raises: DataError where `out` holds another data set or the disk is full; whatever `make` raises.
    """
    began = time.perf_counter()
    folder = Path(out)
    (folder / "trajectories").mkdir(parents=True, exist_ok=True)
    results = _resume(folder, options, jobs)
    todo = [job for job in jobs if job.name not in results]
    todo.sort(key=lambda job: -cost(job))
    paths = {job.name: str(folder / "trajectories" / f"{job.name}.h5") for job in jobs}
    bar = tqdm(total=len(jobs), initial=len(results), desc=title, unit="run", disable=None)
    with bar:
        run_all(_work, {job.name: (make, job, options, paths[job.name]) for job in todo}, workers, results, bar)
    causes = Counter(cause for r in results.values() for cause in r["rejected"])
    return {
        "trajectories": len(jobs),
        "frames": sum(r["frames"] for r in results.values()),
        "simulated_s": sum(r["simulated"] for r in results.values()),
        "rejections": dict(sorted(causes.items())),
        "wall_s": time.perf_counter() - began,
        "cpu_s": sum(r["seconds"] for r in results.values()),
        "peak_worker_mb": max((r["peak_mb"] for r in results.values()), default=0.0),
        "workers": workers,
    }


def _work(make: MakeTrajectory, job: NamedJob, options: Any, path: str) -> dict[str, Any]:
    """Makes one file; says what it took."""
    began = time.process_time()
    trajectory = make(job, options)
    write_trajectory(path, trajectory)
    return {
        **_figures(trajectory),
        "seconds": time.process_time() - began,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10),
    }


def _figures(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "rejected": trajectory.meta["rejected"],
        "frames": trajectory.frames,
        "simulated": float(trajectory.times[-1]),
    }


def plain(value: Any) -> Any:
    """Options as plain values, for JSON."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


def _resume(out: Path, options: Any, jobs: Sequence[NamedJob]) -> dict[str, dict[str, Any]]:
    """What an interrupted run with the same options left in `out`; anything else there is an error."""
    card, wanted = out / "options.json", json.dumps(plain(asdict(options)), indent=1, sort_keys=True)
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
            done[job.name] = {**_figures(read_trajectory(path)), "seconds": 0.0, "peak_mb": 0.0}
    return done


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


def run_all(
    work: Callable[..., dict[str, Any]],
    arguments: Mapping[str, tuple[Any, ...]],
    workers: int,
    results: dict[str, dict[str, Any]],
    bar: tqdm,
) -> None:
    """Puts `work(*arguments[name])` into `results[name]` for all names, in processes of one thread each.

    `work` is a function of a module. With one worker everything runs here. The first failure stops the rest. The
    processes end when this one is killed.

    Raises: DataError where one of the processes is killed; whatever `work` raises.
    """
    if workers <= 1:
        for name, values in arguments.items():
            results[name] = work(*values)
            bar.update()
        return
    leader = (os.getpid(),)
    with _spawning() as context, ProcessPoolExecutor(workers, context, follow, leader) as pool:
        running = {pool.submit(work, *values): name for name, values in arguments.items()}
        try:
            for future in as_completed(running):
                results[running[future]] = future.result()
                bar.update()
        except BrokenProcessPool as error:
            raise DataError(
                "A process that makes data was killed (out of memory?); run again with fewer machine.workers, it goes "
                "on with what is missing."
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
