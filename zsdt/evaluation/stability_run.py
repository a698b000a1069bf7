"""Runs many hard cases side by side, resumable, and gathers their rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tqdm import tqdm

from zsdt.evaluation.stability_registry import CASES, Job, StabilityOptions, jobs_of, known_row, run_case
from zsdt.evaluation.stability_row import Row
from zsdt.evaluation.stability_table import Judged, judge
from zsdt.logs import errors_alone
from zsdt.workers import run_all


def run_cases(options: StabilityOptions, folder: Path, workers: int = 1) -> dict[str, dict[str, Any]]:
    """Runs what has no row in `folder` yet, the longest first, in `workers` processes of one thread each.

    Returns case -> party -> outcome and reason of what was run now.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = jobs_of(options)
    todo = [job for job in jobs if options.again or known_row(folder, job) is None]
    todo.sort(key=lambda job: -job.case.cost)
    cases: dict[str, list[Job]] = {}
    for job in todo:
        cases.setdefault(job.case.name, []).append(job)
    done: dict[str, dict[str, Any]] = {}
    total = len({job.case.name for job in jobs})
    left = total - len(cases)
    # Restarts and rejections are what the table tells.
    with errors_alone("zsdt"), tqdm(total=total, initial=left, desc="hard cases", unit="case", disable=None) as bar:
        run_all(run_case, {name: (of, str(folder)) for name, of in cases.items()}, workers, done, bar)
    return done


def judged_rows(options: StabilityOptions, folder: Path) -> list[Judged]:
    """All rows that the options name and that were run, judged; the normal cases' rows count wherever they are."""
    jobs = jobs_of(options)
    rows = [row for job in jobs if (row := known_row(folder, job)) is not None]
    named = {(row.case, row.party) for row in rows}
    normal = [name for name, case in CASES.items() if case.normal]
    others = jobs_of(StabilityOptions(normal, options.parties, options.soft_beam, options.soft_glass))
    extra: list[Row] = [
        r for job in others if (r := known_row(folder, job)) is not None and (r.case, r.party) not in named
    ]
    return [j for j in judge([*rows, *extra], normal) if (j.row.case, j.row.party) in named]
