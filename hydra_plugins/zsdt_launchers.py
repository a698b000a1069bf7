"""The launchers of this program, where Hydra looks for them; their options are in conf/hydra/launcher.

This folder is a part of Hydra's namespace package `hydra_plugins`, so it has no `__init__.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from pipelines import pools
from pipelines.launch import PoolLauncher

LOGS = ".submitit/%j"  # below the folder of the sweep


class SideBySideLauncher(PoolLauncher):
    """`n_jobs` processes of this machine."""

    def __init__(self, n_jobs: int):
        self.n_jobs = n_jobs

    def outcomes(self, payloads: Sequence[bytes], sweep: Path) -> list[pools.Outcome]:
        """See `pipelines.pools.side_by_side`."""
        return pools.side_by_side(payloads, self.n_jobs)


class SubmititLocalLauncher(PoolLauncher):
    """Submitit without a cluster, `n_jobs` at a time; the other options are submitit's."""

    def __init__(self, n_jobs: int, **parameters: Any):
        self.n_jobs, self.parameters = n_jobs, parameters

    def outcomes(self, payloads: Sequence[bytes], sweep: Path) -> list[pools.Outcome]:
        """See `pipelines.pools.submitit_local`."""
        return pools.submitit_local(payloads, self.n_jobs, sweep / LOGS, plain(self.parameters))


class SlurmLauncher(PoolLauncher):
    """A job array of Slurm; the options are submitit's, those of Slurm alone under `slurm`."""

    def __init__(self, max_num_timeout: int, slurm: Any, **parameters: Any):
        self.max_num_timeout = max_num_timeout
        self.parameters = parameters | {f"slurm_{name}": value for name, value in slurm.items()}

    def outcomes(self, payloads: Sequence[bytes], sweep: Path) -> list[pools.Outcome]:
        """See `pipelines.pools.submitit_slurm`."""
        return pools.submitit_slurm(payloads, sweep / LOGS, self.max_num_timeout, plain(self.parameters))


class RayLauncher(PoolLauncher):
    """Ray: `n_jobs` cores of this machine, or the cluster at `address`."""

    def __init__(self, n_jobs: int, address: str | None):
        self.n_jobs, self.address = n_jobs, address

    def outcomes(self, payloads: Sequence[bytes], sweep: Path) -> list[pools.Outcome]:
        """See `pipelines.pools.on_ray`."""
        return pools.on_ray(payloads, self.n_jobs, self.address)


def plain(parameters: dict[str, Any]) -> dict[str, Any]:
    """Options without OmegaConf's containers, as submitit wants them."""
    return {k: OmegaConf.to_container(v, resolve=True) if OmegaConf.is_config(v) else v for k, v in parameters.items()}
