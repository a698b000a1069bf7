"""A finished sweep with invented figures, for tests of the report: two regimes, eight jobs, one of them failed."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np

BASELINES = {"static": (1.0, 0.003), "fem_5cm": (0.03, 0.4)}


def write_json(path: Path, value: Any) -> None:
    """Writes JSON and makes the folder for it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def rows_of(method: str, error: float, milliseconds: float) -> list[dict[str, Any]]:
    """Rows of a summary: two regimes, two splits."""
    return [
        {
            "method": method,
            "split": split,
            "regime": regime,
            "trajectories": 2,
            "nodes_mean": 250.0,
            "ms_p50": milliseconds,
            "ms_p95": 1.3 * milliseconds,
            "diverged": 0,
            "long_checked": 1,
            "long_diverged": 0,
            "long_frames": 1000,
            "entropy_min": 0.0,
            "ledger_residual_mean": 1e-7 if method != "static" else None,
            "probe_entropy_leak": 1e-16 if "exact" in method else None,
            **{
                f"{name}_rrmse_{which}": error * factor * weight
                for name, factor in (("displacement", 1), ("position", 0.1), ("velocity", 2), ("stress", 3))
                for which, weight in (("mean", 1.0), ("worst", 1.5))
            },
        }
        for split, regime in itertools.product(("test", "beyond"), ("hand", "dynamic"))
    ]


def curves_of(method: str, error: float) -> list[dict[str, Any]]:
    """Errors that grow over 40 frames of four trajectories."""
    random = np.random.default_rng(len(method))
    return [
        {
            "method": method,
            "trajectory": f"t{k}",
            "regime": regime,
            "frame": frame,
            "time_s": 0.005 * frame,
            "displacement": error * (0.1 + frame / 40) * scale,
        }
        for regime in ("hand", "dynamic")
        for k, scale in enumerate(random.uniform(0.5, 2.0, 4))
        for frame in range(41)
    ]


def write_job(outputs: Path, folder: Path, passes: int, lambda_d: float, noise: float) -> None:
    """One finished job: its evaluation, its trained network and a black box that jobs of equal noise share."""
    key = f"p{passes}l{lambda_d:g}n{noise:g}"
    error = 0.05 / passes * (1 + 10 * noise) * (1.2 if lambda_d < 10 else 1.0)
    methods = {"tignn_soft": (error, 0.8 * passes), "black_box": (0.2 + noise, 0.6 * passes), **BASELINES}
    artifacts = outputs / "artifacts"
    options = {
        "tignn": {"bracket": "soft", "passes": passes, "lambda_d": lambda_d},
        "training": {"noise": noise, "steps": 100},
    }
    rival = {"tignn": {"bracket": "none", "passes": passes, "lambda_d": 50.0}, "training": options["training"]}
    trained = {"train_tignn": (key, options), "train_tignn.black_box": (f"b{passes}n{noise:g}", rival)}
    for name, config in trained.values():
        figures = {"parameters": 1000 * passes, "cpu_minutes": 2.0}
        write_json(
            artifacts / "train_tignn" / name / "manifest.json", {"key": name, "config": config, "figures": figures}
        )
    evaluated = artifacts / "evaluate" / key
    rows = [row for name, (e, ms) in methods.items() for row in rows_of(name, e, ms)]
    write_json(evaluated / "summary.json", {"rows": rows, "threads": 1})
    write_json(
        evaluated / "manifest.json", {"key": key, "inputs": {"dataset": "d1"}, "git_commit": "abc", "figures": {}}
    )
    with (evaluated / "errors_over_time.csv").open("w", newline="") as lines:
        curves = [row for name, (e, _) in methods.items() for row in curves_of(name, e)]
        writer = csv.DictWriter(lines, list(curves[0]))
        writer.writeheader()
        writer.writerows(curves)
    (evaluated / "recordings" / "tignn_soft").mkdir(parents=True)
    (evaluated / "recordings" / "tignn_soft" / "t0.rrd").write_bytes(b"RRF2")
    folder.mkdir(parents=True)
    stages = {label: (name, artifacts / "train_tignn" / name) for label, (name, _) in trained.items()}
    stages["evaluate"] = (key, evaluated)
    summary = {
        "status": "finished",
        "experiment": "beam_laptop",
        "overrides": [f"tignn.passes={passes}", f"tignn.lambda_d={lambda_d:g}", f"training.noise={noise:g}"],
        "stages": {
            label: {"key": name, "artifact": str(path.resolve()), "reused": False, "seconds": 1.0}
            for label, (name, path) in stages.items()
        },
        "figures": {"evaluate": {"first": "tignn_soft", "objective": error}},
        "seconds": 100.0,
    }
    write_json(folder / "summary.json", summary)
    (folder / "config.yaml").write_text(f"name: beam_laptop\ntignn: {{passes: {passes}}}\n")


def write_sweep(outputs: Path) -> Path:
    """The whole sweep; returns its folder."""
    root = outputs / "multirun" / "2026-01-01_00-00-00_made_up"
    for number, (passes, lambda_d, noise) in enumerate(itertools.product((4, 8), (5.0, 50.0), (0.003, 0.03))):
        write_job(outputs, root / "factors" / str(number), passes, lambda_d, noise)
    failed = {"status": "failed", "experiment": "beam_laptop", "overrides": ["tignn.passes=99"], "stages": {}}
    write_json(root / "factors" / "8" / "summary.json", failed | {"figures": {}, "error": "It <went> badly; mend it."})
    return root
