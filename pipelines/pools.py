"""Calls in processes of their own, in the four ways that a sweep knows; a process that dies costs the call it had.

Each way takes pickled calls (see `packed`) and gives back, in their order, what they returned or why nothing came
back. What happens when a process is killed is the same everywhere: the other calls go on, nobody is started twice.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import cloudpickle

from zsdt.errors import OptionError, ZsdtError
from zsdt.lifeline import follow

RAY_STORE_BYTES = 80 << 20  # the smallest object store that Ray takes; calls and results are a few kB


@dataclass(frozen=True)
class Lost:
    """A call that came to no end. reason: how its process ended, as half a sentence."""

    reason: str


Outcome = Any  # what the call returned, or Lost


def packed(function: Callable[..., Any], *arguments: Any) -> bytes:
    """A call that can be sent to a process that was started afresh: closures, and where modules are found."""
    return cloudpickle.dumps((sys.path, cloudpickle.dumps((function, arguments))))


def call(payload: bytes, leader: int | None = None) -> bytes:
    """Runs a packed call in this process, which ends with the process `leader` if one is named."""
    if leader is not None:
        follow(leader)
    path, inner = cloudpickle.loads(payload)
    sys.path += [place for place in path if place not in sys.path]
    try:
        function, arguments = cloudpickle.loads(inner)
        return cloudpickle.dumps(function(*arguments))
    except Exception as error:
        traceback.print_exc()
        return cloudpickle.dumps(Lost(f"it could not be run ({type(error).__name__}: {error})"))


def how_it_ended(code: int | None) -> str:
    """What the exit code of a process says, as half a sentence."""
    if code is not None and code < 0:
        return f"its process was killed by {signal.Signals(-code).name}"
    return f"its process ended by itself with code {code}"


class Worker:
    """A fresh process that runs one call after the other; it stays alive between them, so imports are paid once."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, end = context.Pipe()
        self.process = context.Process(target=_serve, args=(end, os.getpid()))
        self.process.start()
        end.close()  # so that the pipe breaks when the process dies

    def begin(self, payload: bytes) -> None:
        """Sends a call; where the process is dead already, `finished` will say so."""
        with suppress(BrokenPipeError):
            self.pipe.send_bytes(payload)

    def finished(self) -> Outcome:
        """The outcome of the call that was sent."""
        try:
            return cloudpickle.loads(self.pipe.recv_bytes())
        except (EOFError, ConnectionError):
            self.process.join()
            return Lost(how_it_ended(self.process.exitcode))

    def close(self, at_once: bool) -> None:
        """Lets the process go: when it has read that no call follows, or at once."""
        self.pipe.close()
        if at_once:
            self.process.terminate()
        self.process.join()


def _serve(pipe: Connection, leader: int) -> None:
    follow(leader)
    while True:
        try:
            pipe.send_bytes(call(pipe.recv_bytes()))
        except (EOFError, KeyboardInterrupt):  # no call follows, or the person at the terminal has had enough
            return


def side_by_side(payloads: Sequence[bytes], n_jobs: int) -> list[Outcome]:
    """`n_jobs` processes of this machine, used again; one that dies is replaced by a new one.

    Raises: OptionError where n_jobs is not positive.
    """
    _positive(n_jobs)
    outcomes: list[Outcome] = [None] * len(payloads)
    waiting = deque(enumerate(payloads))
    idle: list[Worker] = []
    busy: dict[Connection, tuple[Worker, int]] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < n_jobs:
                number, payload = waiting.popleft()
                idle = [worker for worker in idle if worker.process.is_alive()]
                worker = idle.pop() if idle else Worker()
                worker.begin(payload)
                busy[worker.pipe] = (worker, number)
            for pipe in wait(list(busy)):
                worker, number = busy.pop(pipe)  # type: ignore[call-overload]
                outcomes[number] = worker.finished()
                if isinstance(outcomes[number], Lost):
                    worker.pipe.close()
                else:
                    idle.append(worker)
    finally:
        for worker in idle:
            worker.close(at_once=False)
        for worker, _ in busy.values():
            worker.close(at_once=True)
    return outcomes


def submitit_local(payloads: Sequence[bytes], n_jobs: int, folder: Path, parameters: dict[str, Any]) -> list[Outcome]:
    """Submitit without a cluster: a process for each call, `n_jobs` at a time; its logs and results in `folder`.

    parameters: of submitit's executor (timeout_min, ...).

    Raises: OptionError where n_jobs is not positive, ZsdtError where submitit is not installed.
    """
    _positive(n_jobs)
    executor = _executor(folder, "local", {}, parameters)
    jobs: list[Any] = []
    for payload in payloads:  # submitit would start all of them at once
        while sum(not job.done() for job in jobs) >= n_jobs:
            time.sleep(0.1)
        jobs.append(executor.submit(call, payload, os.getpid()))
    return [_result(job) for job in jobs]


def submitit_slurm(
    payloads: Sequence[bytes], folder: Path, max_num_timeout: int, parameters: dict[str, Any]
) -> list[Outcome]:
    """A job array of Slurm, a task for each call. A call that runs out of time is put into the queue again, at most
    `max_num_timeout` times; folders must lie on a disk that all nodes see.

    parameters: of submitit's executor (timeout_min, cpus_per_task, mem_gb, slurm_partition, ...).

    Raises: ZsdtError where submitit is not installed, there is no Slurm, or it does not take the jobs.
    """
    executor = _executor(folder, "slurm", {"slurm_max_num_timeout": max_num_timeout}, parameters)
    from submitit.core.utils import FailedJobError

    try:
        jobs = executor.map_array(Again(), payloads)
    except FailedJobError as error:
        raise ZsdtError(f"Slurm did not take the jobs: {error}; correct the options under hydra.launcher.") from error
    return [_result(job) for job in jobs]


class Again:
    """A call that Slurm may cut off: submitit asks it what to put into the queue then."""

    def __call__(self, payload: bytes) -> bytes:
        """Runs the call."""
        return call(payload)

    def checkpoint(self, payload: bytes) -> Any:
        """The same call again: finished artifacts are reused, a training goes on from its checkpoint."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, payload)


def _executor(folder: Path, cluster: str, settings: dict[str, Any], parameters: dict[str, Any]) -> Any:
    try:
        import submitit
    except ImportError as error:
        raise ZsdtError("This launcher needs submitit; install it with pip install 'zsdt[submitit]'.") from error
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=cluster, **settings)
    except RuntimeError as error:
        raise ZsdtError(f"{error}; run this on a login node of the cluster, or choose another launcher.") from error
    executor.update_parameters(**{name: value for name, value in parameters.items() if value is not None})
    return executor


def _result(job: Any) -> Outcome:
    from submitit.core.utils import UncompletedJobError

    try:
        return cloudpickle.loads(job.result())
    except UncompletedJobError:
        return Lost(f"its process ended without a result (state {job.state}; its log is {job.paths.stderr})")


def on_ray(payloads: Sequence[bytes], n_jobs: int, address: str | None) -> list[Outcome]:
    """Tasks of one core each on Ray: on the cluster at `address`, or on a new one of `n_jobs` cores on this machine.

    Raises: OptionError where n_jobs is not positive, ZsdtError where Ray is not installed.
    """
    _positive(n_jobs)
    try:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray warns that this will be the default
        import ray
    except ImportError as error:
        raise ZsdtError("This launcher needs Ray; install it with pip install 'zsdt[ray]'.") from error
    if address is None:
        ray.init(
            num_cpus=n_jobs, object_store_memory=RAY_STORE_BYTES, include_dashboard=False, logging_level=logging.ERROR
        )
    else:
        ray.init(address=address, logging_level=logging.ERROR)
    try:
        task: Any = ray.remote(num_cpus=1, max_retries=0)(call)
        leader = os.getpid() if address is None else None
        running = [task.remote(payload, leader) for payload in payloads]
        return [_ray_result(ray, reference) for reference in running]
    finally:
        ray.shutdown()


def _ray_result(ray: Any, reference: Any) -> Outcome:
    try:
        return cloudpickle.loads(ray.get(reference))
    except ray.exceptions.OutOfMemoryError:
        return Lost("Ray ended its process because memory ran out")
    except ray.exceptions.RayError as error:
        return Lost(f"its process died ({type(error).__name__})")


def _positive(n_jobs: int) -> None:
    if n_jobs < 1:
        raise OptionError(f"hydra.launcher.n_jobs={n_jobs}: at least one job must run at a time.")
