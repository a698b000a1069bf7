"""How good the first frame is that a network (Psi_ini) makes up from what a camera sees."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from jaxtyping import Bool

from zsdt.evaluation import tables
from zsdt.evaluation.evaluate import EvaluationOptions, chosen_entries
from zsdt.evaluation.metrics import field_errors, rmse
from zsdt.trajectory import Dataset

REGIME = "rest"
COMPONENTS = ("x", "y", "z")


def evaluate_psi_ini(
    dataset_folder: str | os.PathLike[str], initial: Any, options: EvaluationOptions
) -> dict[str, Any]:
    """Judges a network of first fields (Psi_ini) on the first frames of the evaluated trajectories.

    `initial` has `infer_fields(body, positions [nodes, 3] m) -> {field: values}`. Of every field that it infers RMSE
    (SI) and RRMSE [-] over the free nodes: of a stress also of its axial component and of von Mises (the seed reports
    these two), of a velocity also the RMSE of each component, as `velocity_x_rmse` and so on (z is up).

    Returns: {"rows": mean and worst per split, "per_trajectory": [...], "trajectories": n}.
    Raises: DataError where the data set has none of the wanted trajectories.
    """
    dataset = Dataset(dataset_folder)
    rows = []
    for entry in chosen_entries(dataset, options):
        trajectory = dataset.read(entry)
        first, free = trajectory.at(0), ~trajectory.body.clamped
        inferred = initial.infer_fields(trajectory.body, first["position"])
        regime = REGIME if trajectory.body.liquid is None else entry.regime
        keys = {"method": "psi_ini", "trajectory": entry.name, "split": entry.split, "regime": regime}
        rows.append({**keys, "family": entry.family, **_errors(first, inferred, free)})
    return {"trajectories": len(rows), "rows": tables.summarise(rows), "per_trajectory": rows}


def _errors(
    first: dict[str, np.ndarray], inferred: dict[str, np.ndarray], free: Bool[np.ndarray, " nodes"]
) -> dict[str, float]:
    # Two equal frames, because errors are taken over all frames but the first.
    twice = {name: np.stack([np.asarray(values, np.float64)] * 2) for name, values in inferred.items()}
    truth = {name: np.stack([first[name]] * 2) for name in inferred}
    place = np.stack([first["position"]] * 2)
    errors = field_errors({**twice, "position": place}, {**truth, "position": place}, free)
    known = {k: v for k, v in errors.items() if not k.startswith(("position", "displacement", "energy_increment"))}
    if "velocity" in inferred:
        for k, name in enumerate(COMPONENTS):
            known[f"velocity_{name}_rmse"] = rmse(
                twice["velocity"][1:, free, k : k + 1], truth["velocity"][1:, free, k : k + 1]
            )
    return known
