"""What all launchers of a sweep share: jobs are sent to a pool of processes, and a job that is lost is recorded.

Hydra finds launchers in the namespace `hydra_plugins` alone, so the classes that it sees are there; the pools are in
`pipelines.pools`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from pipelines.jobs import record_loss, say
from pipelines.pools import Lost, Outcome, packed


class PoolLauncher(Launcher):
    """A launcher of Hydra whose jobs run in the processes of a pool."""

    config: DictConfig
    context: HydraContext
    task: TaskFunction

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra before the jobs are launched."""
        self.config, self.context, self.task = config, hydra_context, task_function

    @abstractmethod
    def outcomes(self, payloads: Sequence[bytes], sweep: Path) -> list[Outcome]:
        """Runs packed calls; `sweep` is the folder of the sweep."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Runs one job for each list of overrides; one that is lost is recorded as failed and returns NaN."""
        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        sweep = Path(str(self.config.hydra.sweep.dir))
        sweep.mkdir(parents=True, exist_ok=True)
        jobs = [(initial_job_idx + place, list(words)) for place, words in enumerate(job_overrides)]
        shared = (self.context, self.config, self.task, Singleton.get_state())
        found = self.outcomes([packed(execute, *job, *shared) for job in jobs], sweep)
        return [
            self._lost(*job, outcome) if isinstance(outcome, Lost) else outcome
            for job, outcome in zip(jobs, found, strict=True)
        ]

    def _lost(self, number: int, overrides: list[str], lost: Lost) -> JobReturn:
        config = config_of_job(number, overrides, self.context, self.config)
        folder = Path(config.hydra.sweep.dir) / config.hydra.sweep.subdir
        words = list(config.hydra.overrides.task)
        sentence = record_loss(folder, str(config.name), words, lost.reason)
        say(f"[{number}] failed: {sentence}")
        return JobReturn(overrides=words, _return_value=float("nan"), status=JobStatus.COMPLETED)


def config_of_job(number: int, overrides: list[str], context: HydraContext, master: DictConfig) -> DictConfig:
    """Config of one job of a sweep; dates in it are those of the sweep."""
    config = context.config_loader.load_sweep_config(master, overrides)
    with open_dict(config):
        config.hydra.job.id = f"{config.hydra.job.name}_{number}"
        config.hydra.job.num = number
    return config


def execute(
    number: int, overrides: list[str], context: HydraContext, master: DictConfig, task: TaskFunction, state: Any
) -> JobReturn:
    """Runs one job in this process, which may have been started afresh."""
    setup_globals()
    Singleton.set_state(state)
    config = config_of_job(number, overrides, context, master)
    HydraConfig.instance().set_config(config)
    return run_job(
        task_function=task,
        config=config,
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
        hydra_context=context,
    )
