"""`python -m pipelines.publish NAME`: the newest sweep or run as docs/results/NAME.md with its plots and tables.

What is published says which command made it, at which commit and on which machine. Where the README or a page of
docs/ has the lines `<!-- results NAME -->` and `<!-- end -->`, a short table of it is put between them. What an earlier
publication under the same name left is removed.
"""

from __future__ import annotations

import argparse
import math
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.gather import JobRecord, Method, methods_of, newest_sweep, pictures_of, read_jobs
from pipelines.provenance import commit_words
from pipelines.report import errors_of, method_rows, write_report
from pipelines.twin_factors import STAGE as TWINS
from pipelines.twin_factors import publish_factors
from zsdt.errors import DataError, ZsdtError
from zsdt.evaluation import tables
from zsdt.files import atomic_path

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Publishes and prints where; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.publish", description=__doc__)
    parser.add_argument("name", help="name of the publication, for example beam_sweep")
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--sweep", type=Path, help="folder of one sweep or run (the newest if not given)")
    parser.add_argument("--experiments", nargs="+", default=[], help="only jobs of these (all if not given)")
    parser.add_argument("--command", default="make sweep", help="the command that a person types to get these figures")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs" / "results", help="folder that it goes to")
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md", help="page whose tables are renewed")
    parser.add_argument("--twin", action="store_true", help="the twin in front of the virtual lab, not the rollouts")
    parser.add_argument("--twin-factors", action="store_true", help="twins over swept options, not the rollouts")
    chosen = parser.parse_args(arguments)
    try:
        root = chosen.sweep or newest_sweep(chosen.outputs)
        jobs = [job for job in read_jobs(root) if not chosen.experiments or job.experiment in chosen.experiments]
        if chosen.twin_factors:
            page = publish_factors(chosen.name, jobs, origin_of(twins_of(jobs), chosen.command, TWINS), chosen.docs)
        elif chosen.twin:
            page = publish_twin(chosen.name, jobs, chosen.command, chosen.docs, chosen.readme)
        else:
            page = publish(chosen.name, root, jobs, chosen.outputs, chosen.command, chosen.docs, chosen.readme)
        print(f"Published: {page}")
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def publish(
    name: str, root: Path, jobs: list[JobRecord], outputs: Path, command: str, docs: Path, readme: Path
) -> Path:
    """Writes NAME.md, NAME_methods.csv and the plots of `jobs` into `docs`, renews the README; returns the page.

    Raises: DataError where none of the jobs has finished.
    """
    jobs = [job for job in jobs if job.finished and job.artifact("evaluate")]
    methods = methods_of(jobs)
    if not methods:
        raise DataError(f"No job below {root} has finished an evaluation; there is nothing to publish.")
    report = write_report(root, outputs / "reports").parent
    docs.mkdir(parents=True, exist_ok=True)
    for old in [docs / f"{name}.md", *docs.glob(f"{name}_*.png"), *docs.glob(f"{name}_methods.csv")]:
        old.unlink(missing_ok=True)
    plots = []
    ours = tuple(f"{job.experiment}_" for job in jobs)
    for plot in [*(p for p in sorted(report.glob("*.png")) if p.name.startswith(ours)), *pictures_of(jobs)]:
        plots.append(f"{name}_{plot.name}")
        shutil.copy(plot, docs / plots[-1])
    tables.write_csv(docs / f"{name}_methods.csv", [row for method in methods for row in method_rows(method)])
    origin = origin_of(jobs, command)
    page = docs / f"{name}.md"
    with atomic_path(page) as beside:
        beside.write_text(page_text(name, origin, methods, jobs, plots))
    renew_table(readme, name, f"{short_table(methods)}\n\n{origin}")
    return page


def publish_twin(name: str, jobs: list[JobRecord], command: str, docs: Path, readme: Path) -> Path:
    """Writes NAME.md, NAME_clips.csv and NAME_errors.png of the evaluation with the most clips; returns the page.

    Raises: DataError where none of the jobs has evaluated a twin.
    """
    able = twins_of(jobs)
    job = max(able, key=lambda job: int(job.summary["figures"]["evaluate_twin"]["clips"]))
    folder = job.artifact("evaluate_twin")
    assert folder is not None
    docs.mkdir(parents=True, exist_ok=True)
    shutil.copy(folder / "clips.csv", docs / f"{name}_clips.csv")
    shutil.copy(folder / "errors.png", docs / f"{name}_errors.png")
    origin = origin_of([job], command, "evaluate_twin")
    _, _, text = (folder / "summary.md").read_text().partition("\n")
    page = docs / f"{name}.md"
    with atomic_path(page) as beside:
        beside.write_text(f"# {name}\n\n{origin}\n{text}\n![Errors over time]({name}_errors.png)\n")
    short, _, _ = text.partition("\nOpen loop over closed loop")
    table = "\n".join(line for line in short.splitlines() if line.startswith(("| case", "| ---")) or "| all |" in line)
    renew_table(readme, name, f"{table}\n\n{origin}")
    return page


def twins_of(jobs: list[JobRecord]) -> list[JobRecord]:
    """The jobs that judged a twin. Raises: DataError where there is none."""
    able = [job for job in jobs if job.finished and job.artifact(TWINS)]
    if not able:
        raise DataError("None of the jobs has finished the stage evaluate_twin; there is nothing to publish.")
    return able


def origin_of(jobs: list[JobRecord], command: str, stage: str = "evaluate") -> str:
    """One line: command, commits, machine, threads."""
    manifests = [job.manifest(stage) for job in jobs]
    commits = sorted({commit_words(str(m.get("git_commit", "unknown"))) for m in manifests})
    machines = sorted({str(m.get("machine", "unknown")) for m in manifests})
    threads = sorted({threads_of(job) for job in jobs})
    return (
        f"Made by `{command}` at commit {', '.join(commits)} on {', '.join(machines)}, "
        f"{', '.join(map(str, threads))} thread(s) a job."
    )


def threads_of(job: JobRecord) -> int:
    """Threads of one process while the job was evaluated."""
    return int(job.summary["figures"].get("evaluate", {}).get("threads", 1))


def page_text(name: str, origin: str, methods: list[Method], jobs: list[JobRecord], plots: list[str]) -> str:
    """The page: origin, one table per data set, Psi_ini, what training cost, plots."""
    parts = [f"# {name}", origin]
    for dataset in dict.fromkeys(method.dataset for method in methods):
        mine = [method for method in methods if method.dataset == dataset]
        parts.append(f"## {' and '.join(dict.fromkeys(method.experiment for method in mine))}")
        rows = [{**_numbers(row), "method": method.label} for method in mine for row in method.rows]
        rows.sort(key=lambda row: (row["regime"], row["split"], row["displacement_rrmse_mean"]))
        parts.append(tables.markdown(rows, threads=threads_of(jobs[0])))
        parts.append(cost_table(mine))
    parts.append(psi_ini_table(jobs))
    parts += [f"![{plot}]({plot})" for plot in plots]
    return "\n\n".join(part for part in parts if part) + "\n"


def _numbers(row: dict[str, Any]) -> dict[str, Any]:
    """A row as it was before JSON, which knows neither NaN nor infinity."""
    special = {None: math.nan, "inf": math.inf, "-inf": -math.inf}
    return {k: special[v] if v is None or v in ("inf", "-inf") else v for k, v in row.items()}


def cost_table(methods: list[Method]) -> str:
    """What the training of each method cost."""
    names = ("parameters", "cpu_minutes", "seconds_per_1000_steps", "receptive_field")
    trained = [m for m in methods if any(n in m.figures for n in names)]
    rows = [[m.label, *(_cell(m.figures.get(n)) for n in names)] for m in trained]
    return _table(["trained", "parameters", "CPU minutes", "seconds per 1,000 steps", "receptive field"], rows)


def psi_ini_table(jobs: list[JobRecord]) -> str:
    """Errors of the hidden first state, one row per data set; bodies of different kinds have different figures."""
    found: dict[str, dict[str, Any]] = {}
    for job in jobs:
        figures = job.summary["figures"].get("evaluate", {}).get("psi_ini")
        if figures:
            found.setdefault(job.experiment, figures)
    parts = ["## The hidden first state from the picture"] if found else []
    for experiment, figures in found.items():
        names = [name for name in figures if figures[name] == figures[name]]
        cells = [f"{100 * figures[n]:.2f}" if n.endswith("rrmse") else f"{figures[n]:.3g}" for n in names]
        heads = [_title(name) for name in names]
        parts.append(_table(["Psi_ini", *heads], [[experiment, *cells]]))
    return "\n\n".join(parts)


def _title(figure: str) -> str:
    """``axial stress RRMSE %``, ``velocity z RMSE m/s``: a figure's name with its unit."""
    *words, kind = figure.split("_")
    units = {"velocity": "m/s", "internal": "J/kg"}
    unit = "%" if kind == "rrmse" else units.get(words[0], "Pa")
    return f"{' '.join(words)} {kind.upper()} {unit}"


def short_table(methods: list[Method]) -> str:
    """Speed against error: a table per kind of body; of variants of a method only the best in displacement."""
    kinds: dict[tuple[str, ...], list[Method]] = {}
    for dataset in dict.fromkeys(method.dataset for method in methods):
        mine = [method for method in methods if method.dataset == dataset]
        kinds.setdefault(errors_of(mine), []).extend(mine)
    return "\n\n".join(_short_table(of_kind, errors) for errors, of_kind in kinds.items())


def _short_table(methods: list[Method], errors: tuple[str, ...]) -> str:
    """Per data set and regime one row a method."""
    rows: list[list[str]] = []
    for dataset in dict.fromkeys(method.dataset for method in methods):
        mine = [method for method in methods if method.dataset == dataset]
        for regime in sorted({regime for method in mine for regime in method.regimes()}):
            groups: dict[str, list[Method]] = {}
            for method in mine:
                if regime in method.regimes():
                    groups.setdefault(method.name, []).append(method)
            best = [min(group, key=lambda m: _order(m, regime)) for group in groups.values()]
            for method in sorted(best, key=lambda m: _order(m, regime)):
                rows.append(_short_row(method, regime, errors, len(groups[method.name])))
    heads = [f"{error.replace('_', ' ')} %" for error in errors]
    return _table(["experiment, regime", "method", "n", *heads, "ms per frame"], rows)


def _order(method: Method, regime: str) -> float:
    value = method.mean("displacement_rrmse_mean", regime)
    return math.inf if math.isnan(value) else value


def _short_row(method: Method, regime: str, errors: tuple[str, ...], variants: int) -> list[str]:
    mine = [row for row in method.rows if row["regime"] == regime]
    cells = []
    for error in errors:
        worst = max((float(row.get(f"{error}_rrmse_worst") or math.nan) for row in mine), default=math.nan)
        cells.append(f"{_percent(method.mean(f'{error}_rrmse_mean', regime))} ({_percent(worst)})")
    name = method.name + (f" (best of {variants})" if variants > 1 else "")
    count = str(sum(row["trajectories"] for row in mine))
    time = method.mean("ms_p50", regime)
    return [f"{method.experiment}, {regime}", name, count, *cells, "-" if math.isnan(time) else f"{time:.2g}"]


def _percent(fraction: float) -> str:
    if math.isnan(fraction):
        return "-"
    return f"{100 * fraction:.0f}" if fraction >= 0.0995 else f"{100 * fraction:.2g}"


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return "; ".join(_cell(v) for v in value)
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def _table(head: list[str], rows: list[list[str]]) -> str:
    if not rows:
        return ""
    lines = ["| " + " | ".join(line) + " |" for line in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def copy_report(report: Path, names: str, docs: Path) -> Path:
    """Copies the files of a report whose names fit (a pattern) into `docs`; what an earlier one left there goes."""
    docs.mkdir(parents=True, exist_ok=True)
    for stale in docs.glob(names):
        stale.unlink()
    for file in report.glob(names):
        shutil.copy(file, docs / file.name)
    return docs


def renew_table(readme: Path, name: str, text: str) -> None:
    """Puts `text` between the marks of `name` in the README and in the pages of docs/ beside it that have them."""
    marks = re.compile(rf"(<!-- results {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    for page in (readme, *sorted((readme.parent / "docs").glob("*.md"))):
        if not page.is_file():
            continue
        before = page.read_text()
        after = marks.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", before)
        if after != before:
            with atomic_path(page) as beside:
                beside.write_text(after)


if __name__ == "__main__":
    sys.exit(main())
