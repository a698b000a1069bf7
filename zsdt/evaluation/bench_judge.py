"""Errors of a method that no job has judged yet: full rollouts on a few trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from zsdt.errors import OptionError
from zsdt.evaluation.bench_cases import ERRORS, Judged
from zsdt.evaluation.metrics import field_errors, mean_and_worst
from zsdt.tignn.engine import Engine, roll_out
from zsdt.trajectory import Trajectory


def judge(make: Callable[[], Engine], trajectories: Sequence[Trajectory]) -> Judged:
    """Mean and worst RRMSE of full rollouts on the trajectories whose bodies the method takes."""
    rows = []
    for trajectory in trajectories:
        try:
            rollout = roll_out(make(), trajectory)
        except OptionError:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append(field_errors(rollout.fields, trajectory.fields, ~trajectory.body.clamped))
    errors: dict[str, float] = {}
    for name in ERRORS:
        values = [row[name] for row in rows if name in row]
        if values:
            errors[name], errors[f"{name}_worst"] = mean_and_worst(values)
    return Judged(errors, len(rows))
