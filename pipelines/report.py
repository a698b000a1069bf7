"""`python -m pipelines.report`: one HTML page of the newest sweep, with plots and tables, in outputs/reports/.

`--all` takes every job that was ever run, `--sweep FOLDER` a certain one. Beside the page lie the plots as PNG and the
table of methods as CSV and Markdown.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from pipelines.collect import collect
from pipelines.gather import JobRecord, Method, differing, methods_of, newest_sweep, pictures_of, read_jobs
from pipelines.report_plots import Plots
from pipelines.report_twin import twin_section
from pipelines.store import write_json
from zsdt.errors import ZsdtError
from zsdt.evaluation.page import Page, number
from zsdt.evaluation.tables import is_of_liquids, shown_errors, write_csv
from zsdt.files import atomic_path

COSTS = ["training_seconds", "seconds_per_1000_steps", "parameters"]
ACCOUNTS = {
    "ledger_residual_mean": "energy account: residual",
    "entropy_min": "least entropy production",
    "elastic_account_rrmse_mean": "elastic energy: error",
    "dissipated_account_rrmse_mean": "dissipated energy: error",
    "kinetic_account_rrmse_mean": "kinetic energy: error",
    "internal_account_rrmse_mean": "internal energy: error",
    "energy_drift_mean": "total energy: largest change",
    "momentum_rrmse_mean": "momentum: error",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the page and prints its path; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.report", description=__doc__)
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--sweep", type=Path, help="folder of one sweep or run (the newest if not given)")
    parser.add_argument("--all", action="store_true", help="every job below the folder of all runs")
    chosen = parser.parse_args(arguments)
    try:
        root = chosen.outputs if chosen.all else chosen.sweep or newest_sweep(chosen.outputs)
        page = write_report(root, chosen.outputs / "reports")
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"Report: {page}")
    return 0


def write_report(root: Path, reports: Path) -> Path:
    """Writes the report of all jobs below `root` into a folder below `reports`; returns the page."""
    jobs = read_jobs(root)
    name = root.resolve().name
    folder = reports / name
    folder.mkdir(parents=True, exist_ok=True)
    methods = methods_of(jobs)
    commits = sorted({job.manifest("evaluate").get("git_commit", "") for job in jobs} - {""})
    done = sum(job.finished for job in jobs)
    page = Page(f"zsdt: {name}", f"{done} of {len(jobs)} jobs finished. Commit {', '.join(c[:12] for c in commits)}.")
    plots = Plots(folder)
    _failures(page, jobs)
    for dataset, experiments in _datasets(methods).items():
        mine = [method for method in methods if method.dataset == dataset]
        _dataset(page, plots, " and ".join(experiments), mine, [job for job in jobs if _is_of(job, dataset)])
    twin_section(page, plots, jobs)
    _recordings(page, jobs, folder)
    _jobs(page, jobs, root)
    _configs(page, jobs, root)
    write_csv(folder / "methods.csv", [row for method in methods for row in method_rows(method)])
    path = folder / "index.html"
    with atomic_path(path) as beside:
        beside.write_text(page.html())
    write_json(folder / "report.json", {"jobs": len(jobs), "finished": done, "methods": [m.label for m in methods]})
    return path


def _is_of(job: JobRecord, dataset: str) -> bool:
    return job.finished and job.manifest("evaluate").get("inputs", {}).get("dataset") == dataset


def _datasets(methods: list[Method]) -> dict[str, list[str]]:
    """Data sets in order of appearance with the experiments that use them."""
    found: dict[str, list[str]] = {}
    for method in methods:
        names = found.setdefault(method.dataset, [])
        if method.experiment not in names:
            names.append(method.experiment)
    return found


def _failures(page: Page, jobs: list[JobRecord]) -> None:
    failed = [job for job in jobs if not job.finished]
    if not failed:
        page.text("Every job finished.", "good")
    for job in failed:
        reason = job.summary.get("error") or "it was killed; start the same sweep again to go on"
        page.text(f"Failed: {job.folder.name} ({' '.join(job.summary['overrides'])}): {reason}", "failed")


def _dataset(page: Page, plots: Plots, title: str, methods: list[Method], jobs: list[JobRecord]) -> None:
    page.section(title)
    page.text(
        "RRMSE over whole rollouts from the first frame, in percent: mean over trajectories on bodies that were not in "
        "training. A picture in which nothing moves (static) scores 100 % in displacement and velocity. Milliseconds "
        "per frame: median, on the threads and the machine of the run; methods of one job alternate in one process."
    )
    key = f"{methods[0].experiment}"
    page.image(plots.pareto(key, methods), "Error against milliseconds per frame")
    rows = sorted(
        (row for method in methods for row in _short_rows(method)),
        key=lambda row: (row["regime"], row["displacement %"] != row["displacement %"], row["displacement %"]),
    )
    best = {f"{name} %": "least" for name in errors_of(methods)}
    page.table(rows, best=best, group="regime")
    page.folded_table("Each split by itself, with the worst trajectory", [r for m in methods for r in method_rows(m)])
    page.heading("Error over the rollout (of each kind of method the best)")
    page.image(plots.over_time(key, methods), "Error over time")
    _factors(page, plots, key, methods)
    _ablation(page, methods)
    _accounts(page, methods)
    _psi_ini(page, jobs)
    _pictures(page, jobs)


def _pictures(page: Page, jobs: list[JobRecord]) -> None:
    """Pictures that the evaluation of the most complete job made of its recorded trajectories."""
    found = pictures_of(jobs)
    if found:
        page.heading("What it looks like")
    for path in found:
        page.image(path.read_bytes(), path.stem)


def _short_rows(method: Method) -> list[dict[str, Any]]:
    """One row per regime, over all splits."""
    rows: list[dict[str, Any]] = []
    for regime in method.regimes():
        errors = {f"{name} %": 100 * method.mean(f"{name}_rrmse_mean", regime) for name in errors_of([method])}
        mine = [row for row in method.rows if row["regime"] == regime]
        count = sum(row["trajectories"] for row in mine)
        rows.append(
            {
                "method": method.label,
                "regime": regime,
                "n": count,
                **errors,
                "frequency %": 100 * method.mean("frequency_error_mean", regime),
                **(_liquid_figures(method, regime) if is_of_liquids(method.rows) else {}),
                "ms per frame": method.mean("ms_p50", regime),
                "ms 95th": method.mean("ms_p95", regime),
                "diverged": f"{sum(row.get('diverged') or 0 for row in mine)}/{count}",
                **_long_run(mine),
            }
        )
    return rows


def errors_of(methods: list[Method]) -> tuple[str, ...]:
    """Names of the fields whose errors are shown for methods of one data set."""
    return shown_errors(row for method in methods for row in method.rows)


def _liquid_figures(method: Method, regime: str) -> dict[str, Any]:
    """What a person sees of a liquid, and the share of the time that building graphs takes."""
    return {
        "damping %": 100 * method.mean("damping_error_mean", regime),
        "level mm": 1e3 * method.mean("level_rmse_mean", regime),
        "leaked": method.mean("leaked_worst", regime),
        "ms graph": method.mean("graph_ms_mean", regime),
    }


def _long_run(rows: list[dict[str, Any]]) -> dict[str, str]:
    checked = sum(row.get("long_checked") or 0 for row in rows)
    if not checked:
        return {}
    frames = max(row["long_frames"] for row in rows)
    return {"diverged in long run": f"{sum(row['long_diverged'] for row in rows)}/{checked} ({frames} frames)"}


def method_rows(method: Method) -> list[dict[str, Any]]:
    """One row per regime and split with mean and worst."""
    rows: list[dict[str, Any]] = []
    for row in method.rows:
        found = {"method": method.label, "regime": row["regime"], "split": row["split"], "n": row["trajectories"]}
        found |= {"families": row["families"]} if is_of_liquids([row]) else {}
        for name in errors_of([method]):
            for which in ("mean", "worst"):
                value = row.get(f"{name}_rrmse_{which}")
                found[f"{name} % {which}"] = 100 * value if isinstance(value, int | float) else float("nan")
        found |= _seen_figures(row) if is_of_liquids([row]) else {}
        rows.append({**found, "ms per frame": row.get("ms_p50", float("nan"))})
    return rows


def _seen_figures(row: dict[str, Any]) -> dict[str, float]:
    """What a person sees of a liquid, and what must not happen, in one split."""
    shown = {
        "frequency %": ("frequency_error_mean", 100.0),
        "damping %": ("damping_error_mean", 100.0),
        "level mm": ("level_rmse_mean", 1e3),
        "volume %": ("volume_error_mean", 100.0),
        "leaked worst": ("leaked_worst", 1.0),
        "close %": ("close_share_mean", 100.0),
        "kinetic x worst": ("kinetic_factor_worst", 1.0),
    }
    values = {title: (row.get(name), scale) for title, (name, scale) in shown.items()}
    return {t: scale * v if isinstance(v, int | float) else float("nan") for t, (v, scale) in values.items()}


def _factors(page: Page, plots: Plots, key: str, methods: list[Method]) -> None:
    """Error against each option that the sweep changed."""
    swept = [
        method for method in methods if method.is_first and not method.name.startswith(("tignn_cell", "tignn_particle"))
    ]
    groups: dict[str, list[Method]] = {}
    for method in swept:
        groups.setdefault(method.name, []).append(method)
    for name, group in groups.items():
        factors = differing(group)
        if len(group) < 2 or not factors:
            continue
        page.heading(f"Error against each swept factor ({name})")
        for regime in group[0].regimes():
            page.image(plots.factors(f"{key}_{name}", group, factors, regime), f"Error against {', '.join(factors)}")


def _ablation(page: Page, methods: list[Method]) -> None:
    """Trained methods with the options in which they differ, and what training cost."""
    trained = [method for method in methods if method.options]
    if not trained:
        return
    page.heading("Trained methods and their choices")
    options = differing(trained)[:14]
    rows: list[dict[str, Any]] = []
    for method in trained:
        errors = {
            f"displacement % {regime}": 100 * method.mean("displacement_rrmse_mean", regime)
            for regime in method.regimes()
        }
        shown = {name: method.figures[name] for name in COSTS if name in method.figures}
        choices = {name: str(method.options.get(name, "")) for name in options}
        rows.append({"method": method.name, **choices, **errors, **shown})
    page.table(rows)


def _accounts(page: Page, methods: list[Method]) -> None:
    """Energy and entropy accounts, and how well a bracket keeps its degeneracy conditions."""
    probes = list(dict.fromkeys(k for m in methods for row in m.rows for k in row if k.startswith("probe_")))
    rows: list[dict[str, Any]] = []
    for method in methods:
        for regime in method.regimes():
            values = {title: method.mean(name, regime) for name, title in ACCOUNTS.items()}
            values |= {name.removeprefix("probe_").replace("_", " "): method.mean(name, regime) for name in probes}
            if any(value == value for value in values.values()):
                rows.append({"method": method.label, "regime": regime, **values})
    names = dict.fromkeys(k for row in rows for k in row)
    known = [k for k in names if any(k in row and row[k] == row[k] for row in rows)]  # a column of nothing says nothing
    rows = [{k: row[k] for k in known if k in row} for row in rows]
    if rows:
        page.heading("Energy, entropy and degeneracy")
        page.text(
            "Account: energy change against work of the ports, relative to what is turned over. The other columns are "
            "probes of the bracket in double precision, relative to the terms that they are sums of: the exact bracket "
            "is zero to rounding, the soft one is as good as its penalty made it. Of several trainings the worst.",
            "quiet",
        )
        page.table(_worst(rows))
        page.folded_table("Each training by itself", rows)


def _worst(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of the rows of one kind of method and regime the worst figures: the largest, of entropy production the least."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        name = row["method"].split()[0]
        into = found.setdefault((name, row["regime"]), {"method": name, "regime": row["regime"]})
        for title, value in row.items():
            if isinstance(value, float):
                worse = min if "entropy production" in title else max
                known = [v for v in (into.get(title, math.nan), value) if v == v]
                into[title] = worse(known) if known else math.nan
    return list(found.values())


def _psi_ini(page: Page, jobs: list[JobRecord]) -> None:
    found = {}
    for job in jobs:
        figures = job.summary["figures"].get("evaluate", {}).get("psi_ini")
        if figures:
            found[job.summary["stages"]["train_psi_ini"]["key"]] = figures
    if found:
        page.heading("The hidden first state from the picture (Psi_ini)")
        page.table([{"artifact": key, **figures} for key, figures in found.items()])


def _recordings(page: Page, jobs: list[JobRecord], folder: Path) -> None:
    targets: dict[str, str] = {}
    seen: set[Path] = set()
    for job in jobs:
        evaluated = job.artifact("evaluate")
        if evaluated is None or evaluated in seen:
            continue
        seen.add(evaluated)
        for path in sorted(evaluated.glob("recordings/**/*.rrd")):
            text = f"{job.summary['experiment']} job {job.folder.name}: {path.parent.name} {path.stem}"
            targets[f"{text} ({path.stat().st_size / 1e6:.1f} MB)"] = os.path.relpath(path, folder)
    page.section("Recordings")
    page.text("For the Rerun viewer: `make view` opens the newest, `.venv/bin/rerun FILE` any of these.")
    page.links(targets)


def _jobs(page: Page, jobs: list[JobRecord], root: Path) -> None:
    page.section("Jobs")
    rows: list[dict[str, Any]] = []
    for job in jobs:
        stages = job.summary["stages"]
        built = [f"{label} {number(s['seconds'])} s" for label, s in stages.items() if not s["reused"]]
        rows.append(
            {
                "job": os.path.relpath(job.folder, root),
                "status": job.summary["status"],
                "overrides": " ".join(job.summary["overrides"]),
                "seconds": job.summary.get("seconds", float("nan")),
                "built": ", ".join(built),
                "reused": ", ".join(label for label, s in stages.items() if s["reused"]),
            }
        )
    page.table(rows)
    collect(root)


def _configs(page: Page, jobs: list[JobRecord], root: Path) -> None:
    page.section("Resolved configs")
    for job in jobs:
        text = yaml.safe_dump(job.config, sort_keys=False)
        page.folded(f"{os.path.relpath(job.folder, root)}: {job.summary['experiment']}", text)


if __name__ == "__main__":
    sys.exit(main())
