"""The part of the report about twins in front of the virtual lab."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pandas as pd

from pipelines.gather import JobRecord
from pipelines.report_plots import Plots
from pipelines.twin_factors import STAGE, factor_parts
from zsdt.evaluation.page import Page


@dataclass(frozen=True)
class _Section:
    """How the evaluation of a kind of scene is told. group: column of its summary by which it splits the clips."""

    title: str
    text: str
    group: str
    picture: str


SECTIONS = {
    "beam": _Section(
        "Twins of beams in front of the virtual lab",
        "Clips of beams that no network has met, of a material that is not the told one, under loads that nobody "
        "tells. All free nodes, hidden ones included; means over the clips. The open loop predicts from the first "
        "frame on. Milliseconds: median of predicting, tracking, correcting and decoding a frame.",
        "regime",
        "Position error over the frames",
    ),
    "glass": _Section(
        "Twins of liquids in front of the virtual lab",
        "Clips of liquids in vessels that no network has met, of a viscosity that is up to a fifth from the told one. "
        "Means over the clips. The open loop predicts from t0 on. Vertical velocity: at the lab's particles. "
        "Milliseconds: median of a frame, from the picture to the decoded fields.",
        "family",
        "Errors and motion over the time after t0",
    ),
}


def twin_section(page: Page, plots: Plots, jobs: list[JobRecord]) -> None:
    """For each kind of scene a row for each job and case, and the curves of the job with the most clips; nothing where
    no twin was judged."""
    every = [job for job in jobs if job.finished and job.artifact(STAGE)]
    for scene, section in SECTIONS.items():
        judged = [job for job in every if job.summary["figures"][STAGE].get("scene", "beam") == scene]
        if not judged:
            continue
        page.section(section.title)
        page.text(section.text)
        page.table([row for job in judged for row in _rows(job, every, section.group)])
        most = max(judged, key=lambda job: int(job.summary["figures"][STAGE]["clips"]))
        folder = most.artifact(STAGE)
        assert folder is not None
        page.image((folder / "errors.png").read_bytes(), section.picture)
        for part in factor_parts(judged):
            page.heading(f"Error against each swept option ({part.name})")
            page.image(plots.twin_factors(part), f"Error against {', '.join(part.factors)}")


def _rows(job: JobRecord, jobs: list[JobRecord], group: str) -> list[dict[str, Any]]:
    """The summary of a job over all its clips."""
    folder = job.artifact(STAGE)
    assert folder is not None
    summary = pd.read_csv(folder / "summary.csv")
    speed = job.summary["figures"][STAGE]["latency"].get("total", {})
    rows = []
    for line in summary[summary[group] == "all"].to_dict("records"):
        shown = {str(k): v for k, v in line.items() if k not in (group, "survived") and not str(k).endswith(" worst")}
        survived = f"{line['survived']}/{line['clips']}"
        rows.append({"job": _name(job, jobs), **shown, "survived": survived, "ms": speed.get("p50", float("nan"))})
    return rows


def _name(job: JobRecord, jobs: list[JobRecord]) -> str:
    """Part of the sweep, or experiment, and what this job was asked and its neighbours were not."""
    beside = [other for other in jobs if other.folder.parent == job.folder.parent]
    common = set.intersection(*(set(other.summary["overrides"]) for other in beside))
    asked = [word.partition("=") for word in job.summary["overrides"] if word not in common]
    own = [f"{key.rpartition('.')[2]}={value}" for key, _, value in asked]
    return " ".join([job.folder.parent.name, *own]) if len(beside) > 1 else job.experiment
