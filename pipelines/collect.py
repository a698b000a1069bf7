"""The end of a sweep: one table of all jobs below a folder, as CSV and Markdown, with the failed ones named."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from pipelines.jobs import SUMMARY

TABLE = "sweep"
STAGE = "stage"  # column: the last one of a job
ONLY_IN_CSV = ("others.", "psi_ini.", "threads", "objective")
FIXED = ("job", "status", "experiment")


class LastSweep(Callback):
    """Remembers the folder of the sweep that this process has just run, so that its jobs can be collected."""

    folder: ClassVar[Path | None] = None

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Called by Hydra when all jobs of a sweep are over."""
        LastSweep.folder = Path(HydraConfig.get().sweep.dir if HydraConfig.initialized() else config.hydra.sweep.dir)


@dataclass(frozen=True)
class Table:
    """Rows of a sweep, one per job: job, status, experiment, overrides, seconds, figures, reason."""

    rows: list[dict[str, Any]]
    overrides: list[str]

    def columns(self) -> list[str]:
        """Names of all columns: what a job is, what it was asked, what came out."""
        return list(dict.fromkeys([*FIXED, *self.overrides, *(name for row in self.rows for name in row)]))

    def failed(self) -> list[tuple[str, str]]:
        """Name and reason of each job that did not finish."""
        return [(row["job"], str(row.get("reason", ""))) for row in self.rows if row["status"] != "finished"]

    def csv(self) -> str:
        """All columns as CSV."""
        text = io.StringIO()
        writer = csv.DictWriter(text, self.columns(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        return text.getvalue()

    def markdown(self, limit: int = 16) -> str:
        """A Markdown table for each part of the sweep and stage that it ended with: their figures are not the same.

        It has the columns that differ between its jobs, at most `limit`; all of them are in the CSV.
        """
        usual: dict[str, str] = {}  # folder -> stage, for its jobs that did not get there
        for row in self.rows:
            if row.get(STAGE):
                usual.setdefault(row["job"].rpartition("/")[0], row[STAGE])
        parts: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for row in self.rows:
            folder = row["job"].rpartition("/")[0]
            parts.setdefault((folder, row.get(STAGE) or usual.get(folder, "")), []).append(row)
        return "\n".join(Table(rows, self._asked(rows))._one_table(limit) for rows in parts.values())

    def _asked(self, rows: list[dict[str, Any]]) -> list[str]:
        return [name for name in self.overrides if any(row.get(name, "") != "" for row in rows)]

    def _one_table(self, limit: int) -> str:
        differ = [name for name in self.columns() if name in FIXED or self._differs(name)]
        names = [name for name in differ if not name.startswith(ONLY_IN_CSV)]
        names = names[:limit] if len(self.rows) > 1 else self.columns()[:limit]
        lines = [names, ["---"] * len(names), *([_short(row.get(n, "")) for n in names] for row in self.rows)]
        return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"

    def _differs(self, name: str) -> bool:
        """Whether jobs that were asked for it were asked for different values, or whether figures differ."""
        rows = [row for row in self.rows if name in row] if name in self.overrides else self.rows
        return len({str(row.get(name, "")) for row in rows}) > 1

    def text(self) -> str:
        """What the terminal shows at the end of a sweep."""
        done = sum(row["status"] == "finished" for row in self.rows)
        return f"\n{self.markdown()}\n{done} of {len(self.rows)} jobs finished."


def _short(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("|", "/").replace("\n", " ")


def collect(folder: Path) -> Table:
    """Reads the summaries below `folder` and writes `sweep.csv` and `sweep.md` into it."""
    jobs = sorted(folder.rglob(SUMMARY), key=in_order)
    asked = [name.partition("=")[0] for path in jobs for name in json.loads(path.read_text())["overrides"]]
    table = Table([row_of(path.parent, folder) for path in jobs], list(dict.fromkeys(asked)))
    (folder / f"{TABLE}.csv").write_text(table.csv())
    (folder / f"{TABLE}.md").write_text(table.markdown())
    return table


def in_order(path: Path) -> list[tuple[int, str]]:
    """Sorts folders by name and numbered jobs by number."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in path.parts]


def row_of(job: Path, root: Path) -> dict[str, Any]:
    """One row of the table: what the job was asked, how it ended, and the figures of its last stage."""
    summary = json.loads((job / SUMMARY).read_text())
    status = "interrupted" if summary["status"] == "running" else summary["status"]
    row: dict[str, Any] = {"job": str(job.relative_to(root)), "status": status, "experiment": summary["experiment"]}
    for override in summary["overrides"]:
        name, _, value = override.partition("=")
        row[name] = value
    if status == "finished":
        row[STAGE] = next(reversed(summary["figures"]))
        row |= flat(summary["figures"][row[STAGE]])
    row["seconds"] = summary.get("seconds", "")
    row["reason"] = summary.get("error", "was killed; start the sweep again" if status == "interrupted" else "")
    return row


def flat(figures: dict[str, Any], before: str = "") -> dict[str, Any]:
    """Nested figures as dotted names; only numbers and short texts."""
    found: dict[str, Any] = {}
    for name, value in figures.items():
        if isinstance(value, dict):
            found |= flat(value, f"{before}{name}.")
        elif isinstance(value, int | float | str):
            found[f"{before}{name}"] = value
    return found
