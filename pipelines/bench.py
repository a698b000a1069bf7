"""`python -m pipelines.bench`: frame times of all methods of the newest finished job, and what their training took.

Without a finished job it runs `experiment=beam_ci` first. Writes CSV, Markdown and a plot into outputs/reports/bench.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from pipelines.evaluate import engines_of
from pipelines.gather import LEARNED, JobRecord, read_jobs
from pipelines.provenance import set_thread_environment
from pipelines.registry import APPLICATION
from pipelines.stages import settings_of
from zsdt.errors import DataError, ZsdtError

SPLITS = ("test", "beyond", "val")


def newest_job(outputs: Path, experiment: str | None) -> JobRecord | None:
    """The newest job with an evaluation, of one experiment if it is named."""
    jobs = [job for kind in ("runs", "multirun") for job in read_jobs(outputs / kind)]
    fitting = [job for job in jobs if job.finished and job.artifact("evaluate")]
    fitting = [job for job in fitting if experiment in (None, job.summary["experiment"])]
    return max(fitting, key=lambda job: (job.folder / "summary.json").stat().st_mtime, default=None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Times, writes and prints the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.bench", description=__doc__)
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--experiment", help="newest job of this experiment")
    parser.add_argument("--rounds", type=int, default=5, help="rollouts of each method and body")
    parser.add_argument("--bodies", type=int, default=3, help="how many bodies, from small to large")
    chosen = parser.parse_args(arguments)
    set_thread_environment(1)
    try:
        return _bench(chosen)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _bench(chosen: argparse.Namespace) -> int:
    job = newest_job(chosen.outputs, chosen.experiment)
    if job is None:
        from pipelines.app import main as run

        if run(APPLICATION, [f"machine.outputs={chosen.outputs}", f"experiment={chosen.experiment or 'beam_ci'}"]):
            return 1
        job = newest_job(chosen.outputs, chosen.experiment)
    if job is None:
        raise DataError(f"There is no finished job below {chosen.outputs}; run `make smoke` first.")
    import torch

    from zsdt.evaluation.bench import bench, write_bench
    from zsdt.trajectory import Dataset

    torch.set_num_threads(1)
    labels = [label for label in job.summary["stages"] if label.partition(".")[0] == LEARNED]
    inputs = {label: folder for label in labels if (folder := job.artifact(label))}
    config = APPLICATION.compose([f"experiment={job.summary['experiment']}"])
    engines = engines_of(settings_of(config, ["baselines", "evaluation"]), inputs)
    source = job.artifact("synthesize") or job.artifact("import_abaqus")
    assert source is not None
    dataset = Dataset(source)
    bodies = sorted((dataset.read(entry) for entry in dataset.split(*SPLITS)), key=lambda t: t.body.nodes)
    picked = [bodies[round(k * (len(bodies) - 1) / max(chosen.bodies - 1, 1))] for k in range(chosen.bodies)]
    rows = bench(engines, list({id(t): t for t in picked}.values()), rounds=chosen.rounds)
    training = [
        {"method": label, **figures}
        for label in labels
        if "seconds_per_1000_steps" in (figures := job.manifest(label).get("figures", {}))
    ]
    page = write_bench(chosen.outputs / "reports" / "bench", rows, training)
    print(page.read_text())
    print(f"Written to {page.parent}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
