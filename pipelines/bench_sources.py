"""What the benchmark takes from finished jobs: data sets, trained engines with their errors, and what training cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.evaluate import baseline
from pipelines.gather import JobRecord, Method, methods_of, read_jobs
from pipelines.options import Baseline
from zsdt.errors import DataError
from zsdt.evaluation.bench_cases import ERRORS, Entry, Judged
from zsdt.tignn.engine import Engine, load_engine
from zsdt.trajectory import Dataset, Trajectory

# Scene -> experiments whose data set it uses, the first that has a finished job.
SCENES = {
    "foam_beam": ("beam_laptop", "beam_ci"),
    "abaqus_beam": ("abaqus_beam", "bench_beam"),
    "glass": ("glass_laptop", "bench_glass", "glass_ci"),
}
SPLITS = ("test", "val", "beyond")  # bodies are taken from the first of these that has any
SHAPE = ("form", "bracket", "passes", "local_passes", "width", "hidden_layers", "global_context", "shared_weights")


@dataclass(frozen=True)
class Source:
    """A scene with its data set and the methods that were judged on it."""

    scene: str
    dataset: Dataset
    methods: list[Method]

    def bodies(self) -> dict[str, Trajectory]:
        """One trajectory for each regime: that of the middle size."""
        entries = next(found for split in SPLITS if (found := self.dataset.split(split)))
        picked = {}
        for regime in dict.fromkeys(entry.regime for entry in entries):
            mine = [self.dataset.read(entry) for entry in entries if entry.regime == regime]
            picked[regime] = sorted(mine, key=lambda t: t.body.nodes)[len(mine) // 2]
        return picked

    def some(self, regime: str, count: int) -> list[Trajectory]:
        """The first `count` trajectories of a regime that methods are judged on."""
        entries = [e for split in ("test", "beyond", "val") for e in self.dataset.split(split) if e.regime == regime]
        return [self.dataset.read(entry) for entry in entries[:count]]

    def named(self, *names: str) -> Method | None:
        """The trained method of one of these names that was trained for the most steps."""
        able = [m for m in self.methods if m.name in names and m.folder is not None]
        return max(able, key=lambda m: float(m.figures.get("steps", 0) or 0), default=None)


def sources(outputs: Path, scenes: Iterable[str]) -> list[Source]:
    """Every wanted scene that has a finished job, with all methods that were judged on the same data.

    Raises: DataError where no scene has one.
    """
    jobs = [job for kind in ("runs", "multirun") for job in read_jobs(outputs / kind)]
    jobs = [job for job in jobs if job.finished and job.artifact("evaluate")]
    found = []
    for scene in scenes:
        newest = _newest(jobs, SCENES[scene])
        if newest is None:
            continue
        key = _dataset_of(newest)
        mine = [job for job in jobs if _dataset_of(job) == key]
        folder = newest.artifact("synthesize") or newest.artifact("import_abaqus")
        assert folder is not None
        found.append(Source(scene, Dataset(folder), methods_of(mine)))
    if not found:
        raise DataError(f"There is no finished job below {outputs}; run `make sweep` first (or `make smoke`).")
    return found


def _newest(jobs: list[JobRecord], experiments: tuple[str, ...]) -> JobRecord | None:
    for name in experiments:
        able = [job for job in jobs if job.experiment == name]
        if able:
            return max(able, key=lambda job: (job.folder / "summary.json").stat().st_mtime)
    return None


def _dataset_of(job: JobRecord) -> str:
    return str(job.manifest("evaluate")["inputs"]["dataset"])


def entries_of(source: Source) -> list[Entry]:
    """Methods of a scene that can be timed: of variants that cost the same (noise, lambda_d, steps) the best one."""
    groups: dict[tuple[Any, ...], list[Method]] = {}
    for method in source.methods:
        if not method.name.endswith("_from_psi_ini"):
            shape = tuple(str(method.options.get(name)) for name in SHAPE)
            groups.setdefault((method.name, *shape), []).append(method)
    entries = []
    for group in groups.values():
        best = min(group, key=error_of)
        note = f"best of {len(group)}" if len(group) > 1 else ""
        entries.append(Entry(best.name, maker_of(best), judged_of(best), note))
    return entries


def maker_of(method: Method) -> Callable[[], Engine]:
    """How the engine of a method is made anew."""
    folder = method.folder
    if folder is not None:
        return lambda: load_engine(folder)
    return lambda: baseline(Baseline(method.name))


def error_of(method: Method) -> float:
    """Mean displacement RRMSE over the regimes of a method."""
    errors = [judged.errors.get("displacement_rrmse", math.inf) for judged in judged_of(method).values()]
    return sum(errors) / len(errors)


def judged_of(method: Method) -> dict[str, Judged]:
    """Errors of a method by regime: means over the trajectories of all splits, and the worst."""
    found = {}
    for regime in method.regimes():
        rows = [row for row in method.rows if row["regime"] == regime]
        errors: dict[str, float] = {}
        for name in ERRORS:
            mean = method.mean(f"{name}_mean", regime)
            worst = [_number(row.get(f"{name}_worst")) for row in rows]
            if not math.isnan(mean):
                errors |= {name: mean, f"{name}_worst": max(worst)}
        found[regime] = Judged(errors, sum(int(row["trajectories"]) for row in rows))
    return found


def _number(value: Any) -> float:
    """A number of a summary as it was before JSON: diverged rollouts have the error `inf`."""
    return math.nan if value is None else float(value)


def costs_of(method: Method) -> dict[str, Any]:
    """Training steps and CPU-minutes of a method, and its errors without their worst."""
    judged = next(iter(judged_of(method).values()))
    errors = {name: value for name, value in judged.errors.items() if not name.endswith("_worst")}
    return {name: method.figures.get(name) for name in ("steps", "cpu_minutes")} | errors
