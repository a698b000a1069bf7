"""One training in several processes (distributed data parallel): who learns which graphs, and how much they count.

Every process draws the same batch and keeps its own graphs of it; gradients are averaged over the processes. A loss
that is a mean over n of the N terms of the whole batch is multiplied with `processes * n / N`, so that this average is
the gradient of the whole batch: the loss curve is that of one process but for the order in which floats are added.
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import distributed


def place() -> tuple[int, int]:
    """Number of this process among those that train together, and how many they are; (0, 1) for one alone."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def own_graphs(batch: int) -> slice:
    """Which of the `batch` graphs of a step this process learns from."""
    rank, processes = place()
    return slice(rank * batch // processes, (rank + 1) * batch // processes)


def portion(terms: int) -> float:
    """What a mean over `terms` terms of this process counts in the average over the processes; 1 for one alone."""
    _, processes = place()
    if processes == 1:
        return 1.0
    total = torch.tensor(float(terms), dtype=torch.float64)
    distributed.all_reduce(total)
    return processes * terms / float(total)


def strategy_for(devices: int) -> Any:
    """Lightning's strategy: processes started afresh that talk through gloo, or none for one."""
    if devices == 1:
        return "auto"
    return DDPStrategy(start_method="spawn", process_group_backend="gloo")


def settings_here() -> dict[str, Any]:
    """What makes torch repeatable in this process, and whether progress is told; for `take_settings` in the others."""
    return {
        "threads": torch.get_num_threads(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "level": logging.getLogger().getEffectiveLevel(),
    }


def take_settings(settings: dict[str, Any]) -> None:
    """Makes this process work as the one that started it."""
    rank, processes = place()
    if processes == 1:
        return
    torch.set_num_threads(settings["threads"])
    torch.use_deterministic_algorithms(settings["deterministic"], warn_only=True)
    if rank == 0:
        logging.basicConfig(level=settings["level"], format="%(message)s")
