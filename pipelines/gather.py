"""Everything that a report or a table needs from finished jobs, as plain rows."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from pipelines.collect import in_order
from pipelines.jobs import SUMMARY
from pipelines.store import MANIFEST
from zsdt.errors import DataError

LEARNED = "train_tignn"


@dataclass(frozen=True)
class JobRecord:
    """A job as its folder tells it."""

    folder: Path
    summary: dict[str, Any]
    config: dict[str, Any] = field(default_factory=dict)

    @property
    def experiment(self) -> str:
        """Name of its experiment."""
        return str(self.summary["experiment"])

    @property
    def finished(self) -> bool:
        """Whether all its stages came to their end."""
        return self.summary["status"] == "finished"

    def artifact(self, label: str) -> Path | None:
        """Folder of the artifact of a stage, if the job has it."""
        stage = self.summary["stages"].get(label)
        return (self.folder / stage["artifact"]).resolve() if stage else None

    def manifest(self, label: str) -> dict[str, Any]:
        """Manifest of the artifact of a stage; empty if the job has none."""
        folder = self.artifact(label)
        return json.loads((folder / MANIFEST).read_text()) if folder and (folder / MANIFEST).is_file() else {}


def read_jobs(root: Path) -> list[JobRecord]:
    """All jobs below a folder, by their folders' names."""
    jobs = []
    for path in sorted(root.rglob(SUMMARY), key=in_order):
        config = path.parent / "config.yaml"
        content = yaml.safe_load(config.read_text()) if config.is_file() else {}
        jobs.append(JobRecord(path.parent, json.loads(path.read_text()), content))
    return jobs


def pictures_of(jobs: Iterable[JobRecord]) -> list[Path]:
    """Pictures of rollouts that the evaluations of the jobs made: those of the one that made the most."""
    folders = [folder for job in jobs if (folder := job.artifact("evaluate")) is not None]
    return max((sorted((folder / "pictures").glob("**/*.png")) for folder in folders), key=len, default=[])


def newest_sweep(outputs: Path) -> Path:
    """Folder of the newest sweep, or of the newest single run where there is no sweep.

    Raises: DataError where nothing was run yet.
    """
    for kind in ("multirun", "runs"):
        found = [path for path in (outputs / kind).glob("*") if next(path.rglob(SUMMARY), None)]
        if found:
            return max(found, key=lambda path: path.name)
    raise DataError(f"Nothing was run below {outputs} yet; start with `make sweep` or `python -m pipelines`.")


@dataclass
class Method:
    """One method of a report: a trained engine with its options, or a baseline, with its figures.

    rows: of `summary.json` (per split and regime); curves: of `errors_over_time.csv`. folder: artifact of a trained
    engine.
    """

    name: str
    label: str
    dataset: str
    experiment: str
    is_first: bool
    options: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    curves: list[dict[str, str]] = field(default_factory=list)
    folder: Path | None = None

    def regimes(self) -> list[str]:
        """Kinds of trajectories that it was judged on."""
        return sorted({row["regime"] for row in self.rows})

    def mean(self, figure: str, regime: str, split: str = "") -> float:
        """Mean of a figure over the trajectories of a regime; not a number where it is not known."""
        rows = [r for r in self.rows if r["regime"] == regime and split in ("", r["split"])]
        values = [(_number(row.get(figure)), row["trajectories"]) for row in rows]
        known = [(value, weight) for value, weight in values if value == value]
        total = sum(weight for _, weight in known)
        return sum(value * weight for value, weight in known) / total if total else float("nan")


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float | str) and value != "" else float("nan")


def methods_of(jobs: Iterable[JobRecord]) -> list[Method]:
    """Methods of all finished jobs, each trained engine once (by its artifact) and each baseline once per data set."""
    found: dict[tuple[str, str], Method] = {}
    for job in jobs:
        evaluated = job.artifact("evaluate")
        if not job.finished or evaluated is None:
            continue
        rows = json.loads((evaluated / "summary.json").read_text())["rows"]
        with (evaluated / "errors_over_time.csv").open(newline="") as lines:
            curves = list(csv.DictReader(lines))
        dataset = str(job.manifest("evaluate")["inputs"]["dataset"])
        first = job.summary["figures"]["evaluate"]["first"]
        for name in dict.fromkeys(row["method"] for row in rows):
            label = LEARNED if name == first else f"{LEARNED}.{name}"
            trained = job.manifest(label)
            key = (dataset, trained.get("key", name))
            if key in found:
                continue
            found[key] = Method(
                name=name,
                label=name,
                dataset=dataset,
                experiment=job.summary["experiment"],
                is_first=name == first,
                options=options_of(trained),
                figures={**trained.get("figures", {}), "training_seconds": trained.get("wall_seconds", math.nan)},
                rows=[row for row in rows if row["method"] == name],
                curves=[row for row in curves if row["method"] == name],
                folder=job.artifact(label),
            )
    methods = list(found.values())
    name_apart(methods)
    return methods


def options_of(manifest: dict[str, Any]) -> dict[str, Any]:
    """Options of a training as dotted names without the name of their group."""
    found: dict[str, Any] = {}

    def walk(node: dict[str, Any], before: str) -> None:
        for name, value in node.items():
            if isinstance(value, dict):
                walk(value, f"{before}{name}.")
            else:
                found[before + name] = value

    for group in manifest.get("config", {}).values():
        walk(group, "")
    return found


def name_apart(methods: list[Method]) -> None:
    """Gives methods of the same name and data set labels with the options in which they differ."""
    groups: dict[tuple[str, str], list[Method]] = {}
    for method in methods:
        groups.setdefault((method.dataset, method.name), []).append(method)
    for group in groups.values():
        if len(group) > 1:
            for method in group:
                parts = [f"{option}={_text(method.options.get(option))}" for option in differing(group)]
                method.label = " ".join([method.name, *parts])


def differing(methods: Iterable[Method]) -> list[str]:
    """Options in which methods that read them differ."""
    everything = list(methods)
    names = list(dict.fromkeys(name for method in everything for name in method.options))
    values = {name: {str(m.options[name]) for m in everything if name in m.options} for name in names}
    return [name for name in names if len(values[name]) > 1]


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
