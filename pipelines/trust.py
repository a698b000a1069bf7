"""`python -m pipelines.trust`: the limits of trust beside the weights, and what their flags are worth.

`calibrate SCENE --data DIR --clips DIR` measures the training data (a folder of the stage synthesize), rollouts on its
unseen bodies, and closed loops on clean clips (a folder of the stage film), writes `trust.json` beside the engine, and
counts false alarms on the runs that were kept apart. `report` reads the rows of `make stability` and says which flags
came before the error had tripled. Tables, page and picture go to docs/results/trust.
"""

from __future__ import annotations

import argparse
import csv
import platform
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.provenance import commit_words, set_thread_environment
from zsdt.errors import DataError, ZsdtError

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "results" / "trust"
SCENES = ("foam_beam", "glycerin_glass")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; one clear sentence where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.trust", description=__doc__)
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the tables and the page")
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("calibrate", help="limits of one scene's weights")
    make.add_argument("scene", choices=SCENES)
    make.add_argument("--data", type=Path, required=True, help="data set that the weights were trained on")
    make.add_argument("--clips", type=Path, nargs="*", default=[], help="folders of clean clips of the virtual lab")
    make.add_argument("--most", type=int, default=12, help="clips of each folder that are run")
    make.add_argument("--lab-masks", action="store_true", help="glasses: the lab's own masks, as a good eye would see")
    make.add_argument("--again", action="store_true", help="runs clips whose run is kept, too")
    make.add_argument("--weights", type=Path, help="folder of the engine (the shipped one if not given)")
    commands.add_parser("report", help="flags against errors on the hard cases")
    words = parser.parse_args(arguments)
    set_thread_environment(1)
    try:
        return calibrate(words) if words.command == "calibrate" else report(words)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def calibrate(words: argparse.Namespace) -> int:
    """Writes the limits and what they do on normal runs."""
    from pipelines.ship import note_limits
    from zsdt.evaluation import tables
    from zsdt.evaluation.trust_normal import calibrated, closed_runs, open_runs, training_ranges
    from zsdt.evaluation.trust_report import false_alarms, limit_table, normal_table
    from zsdt.shipped import TwinWeights, shipped

    folder = words.weights or shipped(words.scene, "tignn")
    weights = TwinWeights(folder, shipped(words.scene, "psi_ini"), shipped(words.scene, "vision"))
    training = training_ranges(words.data)
    kept = words.outputs / "reports" / "trust" / "runs"
    runs = list(open_runs(words.data, folder, kept, words.again))
    for clips in words.clips:
        runs += closed_runs(clips, weights, words.most, kept, words.lab_masks, words.again)
    about = {
        "command": f"python -m pipelines.trust calibrate {words.scene}",
        "data": words.data.resolve().name,
        "clips": [clips.resolve().name for clips in words.clips],
        "masks": "of the lab" if words.lab_masks else "of the segmentation",
        "commit": commit_words(),
    }
    limits = calibrated(training, runs, about)
    print(f"Written: {limits.save(folder)}")
    if words.weights is None:
        note_limits(folder.parent)
    words.docs.mkdir(parents=True, exist_ok=True)
    rows = normal_table(words.scene, runs, limits)
    tables.write_csv(words.docs / f"trust_normal_{words.scene}.csv", rows)
    tables.write_csv(words.docs / f"trust_limits_{words.scene}.csv", limit_table(words.scene, limits))
    for line in false_alarms(rows):
        print("  ".join(line))
    return 0


def report(words: argparse.Namespace) -> int:
    """Writes the page. Raises: DataError where `make stability` has left no rows."""
    from zsdt.evaluation.stability_registry import CASES, StabilityOptions
    from zsdt.evaluation.stability_row import Party
    from zsdt.evaluation.stability_run import judged_rows
    from zsdt.evaluation.trust_report import normal_row, warned, write_report

    rows = words.outputs / "reports" / "stability" / "rows"
    options = StabilityOptions(parties=[Party.network, Party.twin])
    judged = judged_rows(options, rows)
    if not judged:
        raise DataError(f"There are no rows of hard cases in {rows}; run `make stability` first.")
    normal: list[dict[str, Any]] = []
    for path in sorted(words.docs.glob("trust_normal_*.csv")):
        with path.open() as file:
            normal += list(csv.DictReader(file))
    normal += [normal_row(j.row) for j in judged if CASES[j.row.case].normal]
    what = {name: case.what for name, case in CASES.items()}
    origin = (
        f"Made by `python -m pipelines.trust report` from the rows of `make stability` at commit {commit_words()} "
        f"on {platform.system()} {platform.machine()}."
    )
    cases = [warned(j) for j in judged if not CASES[j.row.case].normal]
    print(f"Written: {write_report(words.docs, cases, normal, what, origin)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
