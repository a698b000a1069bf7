"""`python -m pipelines.stability`: hard cases by solver, network and twin, as one table and picture.

Every case and party is kept in outputs/reports/stability/rows, so a run that was cut off goes on where it was. With
`--publish` the whole table goes to docs/results/stability.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

from pipelines.provenance import commit_words, set_thread_environment
from zsdt.errors import ZsdtError

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the cases, writes the table; the exit code is 1 where a row failed."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.stability", description=__doc__)
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--cases", default="", help="names, comma or space between them (all if not given; ci: a few)")
    parser.add_argument("--parties", default="", help="of solver, network, soft, twin (all if not given)")
    parser.add_argument("--soft-beam", type=Path, help="trained network of the seed's form for beams (artifact folder)")
    parser.add_argument("--soft-glass", type=Path, help="the same for liquids")
    parser.add_argument("--workers", type=int, default=2, help="cases at a time, one thread each")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds of processor time, then it is a hang")
    parser.add_argument("--again", action="store_true", help="runs what has a row, too")
    parser.add_argument("--table", action="store_true", help="runs nothing: the table of what has been run so far")
    parser.add_argument("--list", action="store_true", help="names and words of all cases")
    parser.add_argument("--publish", action="store_true", help="writes the table into docs/results/stability, too")
    chosen = parser.parse_args(arguments)
    set_thread_environment(1)
    try:
        return _run(chosen)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _run(chosen: argparse.Namespace) -> int:
    from zsdt.evaluation.stability_registry import CASES, CI, StabilityOptions
    from zsdt.evaluation.stability_report import count_table, write_report
    from zsdt.evaluation.stability_row import Party
    from zsdt.evaluation.stability_run import judged_rows, run_cases

    if chosen.list:
        print("\n".join(f"{case.kind:7} {name:20} {case.what}" for name, case in CASES.items()))
        return 0
    names = chosen.cases.replace(",", " ").split()
    options = StabilityOptions(
        cases=list(CI) if names == ["ci"] else names,
        parties=[Party(p) for p in chosen.parties.replace(",", " ").split()] or list(Party),
        soft_beam=None if chosen.soft_beam is None else str(chosen.soft_beam),
        soft_glass=None if chosen.soft_glass is None else str(chosen.soft_glass),
        limit_s=chosen.limit,
        again=chosen.again,
    )
    folder = chosen.outputs / "reports" / "stability"
    if not chosen.table:
        run_cases(options, folder / "rows", chosen.workers)
    judged = judged_rows(options, folder / "rows")
    what = {name: case.what for name, case in CASES.items()}
    origin = (
        f"Made by `make stability` at commit {commit_words()} on "
        f"{platform.system()} {platform.machine()}, one thread a case."
    )
    page = write_report(folder, judged, what, origin)
    print(count_table(judged))
    print(f"Written to {page.parent}")
    if chosen.publish:
        print(f"Published: {write_report(ROOT / 'docs' / 'results' / 'stability', judged, what, origin)}")
    return int(any(j.verdict == "failed" for j in judged))


if __name__ == "__main__":
    sys.exit(main())
