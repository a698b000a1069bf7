"""`python -m pipelines.scale PART [--outputs DIR]`: what happens when there is more to run; tables go to docs/results.

launchers: one small sweep through every launcher, a worker killed on the way, results compared bit by bit.
devices: one training in one and in two processes, loss curves compared.
shards: data made in pieces and at once, compared bit by bit.
cost: what a sweep of many jobs costs, computed from the pieces of a finished one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipelines.gather import newest_sweep
from pipelines.jobs import say
from pipelines.provenance import commit_words, provenance
from pipelines.publish import ROOT, renew_table
from pipelines.scale_cost import commits_of, parts_below, pieces_of, start_seconds
from pipelines.scale_launchers import compare_launchers
from pipelines.scale_pieces import TOLERANCE, compare_devices, compare_shards, draw_curves
from zsdt.errors import ZsdtError
from zsdt.evaluation.tables import write_csv

PAGE = "scale.md"
WORK = "scale"  # below the folder of all runs: what is run for the comparisons


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one part and renews its table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.scale", description=__doc__.partition(":")[0])
    parser.add_argument("part", choices=["launchers", "devices", "shards", "cost"])
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs" / "results", help="folder that tables go to")
    parser.add_argument("--sweep", type=Path, help="cost: folder of a finished sweep (the newest if not given)")
    parser.add_argument("--jobs", type=int, default=10_000, help="cost: jobs of the sweep that is reckoned")
    chosen = parser.parse_args(arguments)
    try:
        words = [chosen.part] + (["--jobs", str(chosen.jobs)] if chosen.part == "cost" else [])
        good = PARTS[chosen.part](chosen, f"python -m pipelines.scale {' '.join(words)}")
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0 if good else 1


def launchers(chosen: argparse.Namespace, command: str) -> bool:
    """Whether every launcher gave the results of `basic` and a killed worker cost one job."""
    rows = compare_launchers(chosen.outputs / WORK / "launchers")
    publish(chosen.docs, "launchers", rows, command)
    return all(row["finished at last"] == row["jobs"] and not row.get("files that differ", 0) for row in rows) and all(
        row["killed: lost"] == 1 for row in rows[1:]
    )


def devices(chosen: argparse.Namespace, command: str) -> bool:
    """Whether two processes gave the loss curve of one."""
    rows, curves = compare_devices(chosen.outputs / WORK)
    draw_curves(chosen.docs / "scale_devices.png", curves)
    publish(chosen.docs, "devices", rows, command)
    return all(row["largest relative difference"] <= TOLERANCE for row in rows)


def shards(chosen: argparse.Namespace, command: str) -> bool:
    """Whether pieces put together are the data that are made at once."""
    rows = compare_shards(chosen.outputs / WORK)
    publish(chosen.docs, "shards", rows, command)
    return all(row["same key"] == "yes" and row["files that differ"] == 0 for row in rows)


def cost(chosen: argparse.Namespace, command: str) -> bool:
    """Reckons what a sweep costs."""
    sweep = chosen.sweep or newest_sweep(chosen.outputs)
    start = start_seconds()
    parts = [pieces_of(part, start) for part in parts_below(sweep)]
    origin = f"from the sweep {sweep.name} ({commits_of(sweep)})"
    publish(chosen.docs, "pieces", [part.row() for part in parts], command, origin)
    publish(chosen.docs, "cost", [part.reckoning(chosen.jobs) for part in parts], command, origin)
    return True


PARTS: dict[str, Callable[[argparse.Namespace, str], bool]] = {
    "launchers": launchers,
    "devices": devices,
    "shards": shards,
    "cost": cost,
}


def publish(docs: Path, name: str, rows: list[dict[str, Any]], command: str, origin: str = "") -> None:
    """Writes ``scale_NAME.csv`` and renews the table of that name in the page, with what made it."""
    facts = provenance()
    where = f"at commit {commit_words(facts['git_commit'])} on {facts['machine']}"
    text = f"{markdown(rows)}\n\nMade by `{command}` {where}{', ' if origin else ''}{origin}."
    write_csv(docs / f"scale_{name}.csv", rows)
    renew_table(docs / PAGE, name, text)
    say(text)


def markdown(rows: list[dict[str, Any]]) -> str:
    """Rows as a Markdown table; a column that a row does not have shows a dash."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [columns, ["---"] * len(columns), *([short(row.get(name)) for name in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def short(value: Any) -> str:
    """A cell: three digits of a number, a dash for nothing."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return "-" if value in (None, "") else f"{value:,}" if isinstance(value, int) else str(value).replace("|", "/")


if __name__ == "__main__":
    sys.exit(main())
