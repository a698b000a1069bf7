"""The choice of weights by rollout: they are judged on trajectories kept aside, and the best are kept."""

from __future__ import annotations

import copy
import csv
import functools
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch

from zsdt.files import atomic_path
from zsdt.tignn.engine import Engine, Rollout, roll_out
from zsdt.tignn.options import TrainingOptions
from zsdt.trajectory import Trajectory

log = logging.getLogger(__name__)
Judge = Callable[[Any], dict[str, float]]  # relative errors of a model, `score` among them


def judge_of(
    engine: Callable[[Any], Engine],
    held: list[Trajectory],
    names: tuple[str, ...] = ("displacement", "velocity", "stress"),
) -> Judge | None:
    """The judge that rolls `engine(model)` out on trajectories kept aside; None where there are none. It can be sent
    to another process."""
    return functools.partial(_judged, engine, held, names) if held else None


def _judged(
    engine: Callable[[Any], Engine], held: list[Trajectory], names: tuple[str, ...], model: Any
) -> dict[str, float]:
    return rollout_score(engine(model), held, names)


def rollout_score(
    engine: Engine, trajectories: list[Trajectory], names: tuple[str, ...] = ("displacement", "velocity", "stress")
) -> dict[str, float]:
    """Mean relative errors of full rollouts by the names of fields, and `score`, their mean."""
    rows = []
    for trajectory in trajectories:
        rollout = roll_out(engine, trajectory)
        rows.append([_relative(rollout, trajectory, name) for name in names])
    mean = np.mean(rows, axis=0)
    found = dict(zip(names, map(float, mean), strict=True))
    return found | {"score": float(mean.mean())}


def _relative(rollout: Rollout, trajectory: Trajectory, name: str) -> float:
    """RRMSE over all frames but the first and all free nodes (DESIGN 6); 10 where the rollout diverged. Of
    displacement and internal energy what counts is the change since the first frame."""
    free = ~trajectory.body.clamped
    key = "position" if name == "displacement" else name
    predicted, true = rollout.fields[key][1:, free], trajectory.fields[key][1 : len(rollout.fields[key]), free]
    if name in ("displacement", "internal_energy"):
        first = trajectory.fields[key][0, free]
        predicted, true = predicted - first, true - first
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.sqrt(np.sum((predicted - true) ** 2) / max(float(np.sum(true**2)), 1e-300))
    return float(min(error, 10.0)) if np.isfinite(error) else 10.0


class ChooseByRollout(L.Callback):
    """Rolls the averaged weights out on trajectories kept aside, keeps the best, logs, stops when nothing is gained.

    judge: relative errors of a model, `score` among them (the smallest wins); None where nothing was kept aside.
    """

    def __init__(self, judge: Judge | None, training: TrainingOptions, scratch: Path):
        self.judge, self.training_options, self.scratch = judge, training, scratch
        self.table: list[dict[str, Any]] = []
        self.best, self.waited = math.inf, 0
        self.first, self.began = 0, time.perf_counter()

    def on_train_start(self, trainer: L.Trainer, module: Any) -> None:
        """Where this process begins, for the time that is left."""
        self.first, self.began = trainer.global_step, time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """Kept in Lightning's checkpoints."""
        return {"best": self.best, "waited": self.waited, "table": self.table}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Goes on after a resume."""
        self.best, self.waited = state_dict["best"], state_dict["waited"]
        self.table[:] = state_dict["table"]

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        """Every `check_every` steps, and at the end."""
        step, options = trainer.global_step, self.training_options
        if step % options.check_every and step != options.steps:
            return
        row: dict[str, Any] = {"step": step, "cpu_seconds": round(time.process_time(), 1)}
        row |= {f"loss_{name}": _mean_of_all(trainer, values) for name, values in module.totals.items()}
        module.totals.clear()
        score = trainer.strategy.broadcast(self._score(module, step) if trainer.is_global_zero else {})
        row |= {f"rollout_{name}": value for name, value in score.items()}
        self.table.append(row)
        if trainer.is_global_zero:
            write_table(self.scratch / "training.csv", self.table)
            self._say(row)
        for logger in trainer.loggers:
            logger.log_metrics({k: v for k, v in row.items() if k != "step"}, step)
        if score["score"] < self.best:
            self.best, self.waited = score["score"], 0
            if trainer.is_global_zero:
                with atomic_path(self.scratch / "best.pt") as beside:
                    torch.save(module.averaged.state_dict(), beside)
        else:
            self.waited += 1
            if options.patience and self.waited >= options.patience:
                log.info("stopping early: %d checks without gain", self.waited)
                trainer.should_stop = True

    def _score(self, module: Any, step: int) -> dict[str, float]:
        return self.judge(copy.deepcopy(module.averaged)) if self.judge is not None else {"score": -float(step)}

    def _say(self, row: dict[str, Any]) -> None:
        """One line with the time that is left."""
        done, total = row["step"], self.training_options.steps
        left = (time.perf_counter() - self.began) / max(done - self.first, 1) * (total - done) / 60.0
        numbers = "  ".join(f"{k} {v:.4g}" for k, v in row.items() if k.startswith(("loss_", "rollout_")))
        log.info("step %d of %d, %.1f min left  %s", done, total, left, numbers)


def _mean_of_all(trainer: L.Trainer, values: list[float]) -> float:
    """Mean of what all processes noted (of equally many steps)."""
    mean = torch.tensor(float(np.mean(values)), dtype=torch.float64)
    return float(trainer.strategy.reduce(mean, reduce_op="mean"))


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """Rows as CSV; a column that a row does not have stays empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_path(path) as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, columns)
        writer.writeheader()
        writer.writerows(rows)


def read_table(path: Path) -> list[dict[str, float]]:
    """What `write_table` wrote, as numbers; empty cells are left out."""
    with path.open(newline="") as lines:
        return [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(lines)]
