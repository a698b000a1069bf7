"""The part of the report about twins in front of the virtual lab."""

from __future__ import annotations

from typing import Any

import pandas as pd

from pipelines.gather import JobRecord
from zsdt.evaluation.page import Page

STAGE = "evaluate_twin"


def twin_section(page: Page, jobs: list[JobRecord]) -> None:
    """A row for each job and case, and the curves of the job with the most clips; nothing where no twin was judged."""
    judged = [job for job in jobs if job.finished and job.artifact(STAGE)]
    if not judged:
        return
    page.section("Twins in front of the virtual lab")
    page.text(
        "Clips of beams that no network has met, of a material that is not the told one, under loads that nobody "
        "tells. All free nodes, hidden ones included; means over the clips. The open loop predicts from the first "
        "frame on. Milliseconds: median of predicting, tracking, correcting and decoding a frame."
    )
    page.table([row for job in judged for row in _rows(job, judged)])
    most = max(judged, key=lambda job: int(job.summary["figures"][STAGE]["clips"]))
    folder = most.artifact(STAGE)
    assert folder is not None
    page.image((folder / "errors.png").read_bytes(), "Position error over the frames")


def _rows(job: JobRecord, jobs: list[JobRecord]) -> list[dict[str, Any]]:
    """The summary of a job over all regimes."""
    folder = job.artifact(STAGE)
    assert folder is not None
    summary = pd.read_csv(folder / "summary.csv")
    speed = job.summary["figures"][STAGE]["latency"].get("total", {})
    rows = []
    for line in summary[summary["regime"] == "all"].to_dict("records"):
        shown = {
            str(k): v for k, v in line.items() if k not in ("regime", "survived") and not str(k).endswith(" worst")
        }
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
