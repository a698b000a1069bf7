"""One training in two processes against one, and data made in pieces against data made at once."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.compare import same_content
from pipelines.jobs import SUMMARY
from pipelines.provenance import THREAD_VARIABLES
from pipelines.store import MANIFEST
from zsdt.errors import ZsdtError
from zsdt.tignn.choice import read_table

TOLERANCE = 1e-4  # of a loss: floats are added in another order, and a training carries that on from step to step
PIECES = 3
DATA = ("machine.workers=1", "data.train=4", "data.val=0", "data.test=0", "data.beyond=0")
TRAININGS = {
    "beam, soft bracket": ("experiment=beam_ci", "tignn.bracket=soft"),
    "glass, exact bracket": ("experiment=glass_ci", "tignn.bracket=exact"),
}
TRAINING = ("tignn.form=node", "rivals.seed_form=null", "rivals.black_box=null", "training.steps=100")
CHECKS = ("training.check_every=10", "training.batch=4", "training.holdout_count=1", "stages=[train_tignn]")


def job(outputs: Path, *words: str) -> dict[str, Any]:
    """Runs `python -m pipelines` in a process of its own; gives the stages of the (newest) job.

    Raises: ZsdtError where it fails.
    """
    outputs.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "pipelines", f"machine.outputs={outputs}", *words]
    with (outputs / "terminal.txt").open("a") as terminal:
        environment = {**{name: "1" for name in THREAD_VARIABLES}, **os.environ}
        if subprocess.run(command, stdout=terminal, stderr=terminal, env=environment).returncode:
            raise ZsdtError(f"{' '.join(words)} failed; see {outputs / 'terminal.txt'}.")
    newest = max((outputs / ("multirun" if "-m" in words else "runs")).rglob(SUMMARY), key=os.path.getmtime)
    stages: dict[str, Any] = json.loads(newest.read_text())["stages"]
    return {name: stage | {"folder": (newest.parent / stage["artifact"]).resolve()} for name, stage in stages.items()}


def compare_devices(outputs: Path) -> tuple[list[dict[str, Any]], dict[str, list[list[dict[str, float]]]]]:
    """A row for each training, and its tables with one and with two processes."""
    rows, curves = [], {}
    for name, words in TRAININGS.items():
        folder = outputs / "whole"
        runs = [
            job(folder, *words, *DATA, *TRAINING, *CHECKS, f"training.devices={count}")["train_tignn"]
            for count in (1, 2)
        ]
        tables = [read_table(run["folder"] / "training.csv") for run in runs]
        figures = [json.loads((run["folder"] / MANIFEST).read_text())["figures"] for run in runs]
        curves[name] = tables
        columns = [column for column in tables[0][0] if column.startswith(("loss_", "rollout_"))]
        apart = np.array([[b[c] / a[c] - 1.0 for c in columns] for a, b in zip(*tables, strict=True)])
        rows.append(
            {
                "training": name,
                "steps": int(tables[0][-1]["step"]),
                "losses and errors compared": apart.size,
                "largest relative difference": float(np.abs(apart).max()),
                "at the first check": float(np.abs(apart[0]).max()),
                "s per 1,000 steps, one process": figures[0]["seconds_per_1000_steps"],
                "two processes": figures[1]["seconds_per_1000_steps"],
            }
        )
    return rows, curves


def draw_curves(path: Path, curves: dict[str, list[list[dict[str, float]]]]) -> None:
    """Loss over steps, one process as a line and two as dots on it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, (name, (one, two)) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        for column in (c for c in one[0] if c.startswith("loss_")):
            (line,) = axes.plot([r["step"] for r in one], [r[column] for r in one], label=column[5:])
            axes.plot([r["step"] for r in two], [r[column] for r in two], "o", mfc="none", color=line.get_color())
        axes.set(title=name, xlabel="step", ylabel="loss", yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(title="line: one process\ndots: two")
    figure.savefig(path, dpi=110)


def compare_shards(outputs: Path) -> list[dict[str, Any]]:
    """A row for each kind of data: pieces made by jobs of a sweep and put together, against the same made at once."""
    rows = []
    for name in ("beam_ci", "glass_ci"):
        words = (f"experiment={name}", *DATA)
        whole = job(outputs / "whole", *words, "stages=[synthesize]")["synthesize"]
        apart = outputs / f"pieces_{name}"
        shutil.rmtree(apart, ignore_errors=True)
        names = ",".join(f"{k}/{PIECES}" for k in range(1, PIECES + 1))
        job(apart, "-m", "hydra/launcher=side_by_side", *words, "stages=[synthesize_shard]", f"shard={names}")
        merged = job(apart, *words, "stages=[synthesize]", f"machine.shards={PIECES}")
        files = [_data(stage["folder"]) for stage in (whole, merged["synthesize"])]
        both = sorted(files[0] & files[1])
        bitwise = [
            file
            for file in both
            if same_content(whole["folder"] / file, merged["synthesize"]["folder"] / file) == "bitwise"
        ]
        rows.append(
            {
                "data": name,
                "pieces": sum(stage.startswith("synthesize_shard") for stage in merged),
                "same key": "yes" if whole["key"] == merged["synthesize"]["key"] else "no",
                "files bitwise the same": len(bitwise),
                "files that differ": len(files[0] | files[1]) - len(bitwise),
                "s at once": _seconds(whole["folder"]),
                "s of each piece": ", ".join(
                    f"{_seconds(stage['folder']):.3g}"
                    for stage_name, stage in merged.items()
                    if stage_name.startswith("synthesize_shard")
                ),
                "s to put together": _seconds(merged["synthesize"]["folder"]),
            }
        )
    return rows


def _data(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name != MANIFEST}


def _seconds(folder: Path) -> float:
    return float(json.loads((folder / MANIFEST).read_text())["wall_seconds"])
