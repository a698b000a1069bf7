"""Twins over swept factors: parts of a sweep whose jobs differ in options, their pictures and tables, and a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from pipelines.gather import JobRecord
from zsdt.errors import DataError
from zsdt.evaluation.plots import error_against_factors
from zsdt.files import atomic_path

STAGE = "evaluate_twin"
FIGURES = {  # scene -> figure of the picture, its words; columns of the table: name, head, factor
    "beam": (
        "displacement_rrmse",
        "displacement error (RRMSE)",
        (("displacement_rrmse", "displacement %", 100.0), ("stress_rrmse", "stress %", 100.0)),
    ),
    "glass": (
        "level_share",
        "level error over the fill height",
        (
            ("level_share", "level % of fill", 100.0),
            ("level_mm", "level mm", 1.0),
            ("vertical_velocity_rrmse", "vertical velocity %", 100.0),
        ),
    ),
}
ABOUT = (
    "Clips of the virtual lab; open loops predict from the first frame on, closed ones are corrected by what is seen. "
    "Means over the runs that came through; a run that was refused or diverged is named with its reason and has no "
    "error. A velocity of which nothing is known scores 100 %. ms: median of predicting a frame. Rows without factors: "
    "other engines on the same clips."
)


@dataclass(frozen=True)
class FactorPart:
    """Jobs of one part of a sweep that differ in `factors`; others: jobs of other parts on the same clips in the same
    cases."""

    name: str
    jobs: tuple[JobRecord, ...]
    factors: tuple[str, ...]
    others: tuple[JobRecord, ...] = ()

    @property
    def scene(self) -> str:
        """beam or glass."""
        return str(self.jobs[0].summary["figures"][STAGE].get("scene", "beam"))

    def picture(self) -> bytes:
        """Error of each case against each factor, of the runs that came through."""
        figure, words, _ = FIGURES[self.scene]
        found = [(job, case, mean_of(runs, figure)) for job in self.jobs for case, runs in runs_of(job).items()]
        rows = [
            {"method": loop_of(case, cases_of(job)), "error": error, **asked(job, self.factors)}
            for job, case, error in found
            if math.isfinite(error)
        ]
        return error_against_factors(rows, self.factors, words)


def factor_parts(jobs: Sequence[JobRecord]) -> list[FactorPart]:
    """The parts of a sweep with twins that differ in more than their experiment."""
    judged = [job for job in jobs if job.finished and job.artifact(STAGE)]
    parts = []
    for folder in dict.fromkeys(job.folder.parent for job in judged):
        mine = tuple(job for job in judged if job.folder.parent == folder)
        names = dict.fromkeys(word.partition("=")[0] for job in mine for word in job.summary["overrides"])
        differ = (name for name in names if len({str(option(job, name)) for job in mine}) > 1)
        factors = tuple(name for name in differ if name != "experiment")
        if len(mine) > 1 and factors:
            parts.append(FactorPart(folder.name, mine, factors, _others(mine, judged)))
    return parts


def _others(mine: Sequence[JobRecord], judged: Sequence[JobRecord]) -> tuple[JobRecord, ...]:
    clips = {job.summary["stages"]["film"]["key"] for job in mine}
    cases = {cases_of(job) for job in mine}
    return tuple(
        job
        for job in judged
        if job not in mine and job.summary["stages"]["film"]["key"] in clips and cases_of(job) in cases
    )


def option(job: JobRecord, name: str) -> Any:
    """What an override of a job says, as a number where it is one; None where it has none."""
    for word in job.summary["overrides"]:
        key, _, value = word.partition("=")
        if key == name:
            return yaml.safe_load(value)
    return None


def asked(job: JobRecord, factors: Sequence[str]) -> dict[str, Any]:
    """The values of swept options of a job."""
    return {name: option(job, name) for name in factors}


def cases_of(job: JobRecord) -> tuple[str, ...]:
    """The conditions in which a job judged its twins."""
    figures = job.summary["figures"][STAGE]
    return tuple(name for name, found in figures.items() if isinstance(found, dict) and "survived" in found)


def loop_of(case: str, cases: Sequence[str]) -> str:
    """``open loop`` or ``closed loop``, where a job has one case of each kind; else the case."""
    words = {name: "open loop" if "open" in name else "closed loop" for name in cases}
    return words[case] if len(set(words.values())) == len(words) else case


def runs_of(job: JobRecord) -> dict[str, pd.DataFrame]:
    """The rows of a job's runs by case."""
    folder = job.artifact(STAGE)
    assert folder is not None
    return {str(case): runs for case, runs in pd.read_csv(folder / "clips.csv").groupby("case", sort=False)}


def mean_of(runs: pd.DataFrame, name: str) -> float:
    """Mean of a figure over the runs that came through; NaN where none did."""
    good = runs[runs["survived"].astype(bool)]
    return float(good[name].mean()) if name in good and len(good) else math.nan


def part_text(part: FactorPart) -> str:
    """A table of a part: a row per job and case, and other engines on the same clips; then who failed and why."""
    columns = FIGURES[part.scene][2]
    head = [*(name.rpartition(".")[2] for name in part.factors), "case", "survived", *(c[1] for c in columns), "ms"]
    rows, failed = [], []
    for job in (*part.jobs, *part.others):
        who = [_shown(value) for value in asked(job, part.factors).values()]
        if job in part.others:
            who = [str(job.config.get("tignn", {}).get("form", job.folder.parent.name)), *[""] * (len(who) - 1)]
        for case, runs in runs_of(job).items():
            lost = runs[~runs["survived"].astype(bool)].to_dict("records")
            values = [factor * mean_of(runs, name) for name, _, factor in (*columns, ("predict_p50_ms", "ms", 1.0))]
            cells = ["-" if math.isnan(value) else f"{value:.3g}" for value in values]
            rows.append([*who, case, f"{len(runs) - len(lost)}/{len(runs)}", *cells])
            failed += [f"- {', '.join(filter(None, who))}: {run['clip']} {case}: {run['reason']}" for run in lost]
    lines = ["| " + " | ".join(map(str, cells)) + " |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join([*lines, "", *failed]).rstrip()


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def publish_factors(name: str, jobs: list[JobRecord], origin: str, docs: Path) -> Path:
    """Writes NAME.md and a picture per part of the sweep into `docs`; returns the page.

    Raises: DataError where no part has twins that differ in an option.
    """
    parts = factor_parts(jobs)
    if not parts:
        raise DataError("None of the parts of this sweep has twins that differ in an option; there is nothing to show.")
    docs.mkdir(parents=True, exist_ok=True)
    for old in [docs / f"{name}.md", *docs.glob(f"{name}_*.png")]:
        old.unlink(missing_ok=True)
    texts = [f"# {name}", origin, ABOUT]
    for part in parts:
        picture = f"{name}_{part.name}.png"
        with atomic_path(docs / picture) as beside:
            beside.write_bytes(part.picture())
        texts += [f"## {part.name}", part_text(part), f"![{part.name}]({picture})"]
    with atomic_path(docs / f"{name}.md") as beside:
        beside.write_text("\n\n".join(texts) + "\n")
    return docs / f"{name}.md"
