"""`python -m pipelines.bench`: speed against error of all that the newest finished jobs trained, and of the solvers.

Methods take turns in one process on one thread (OMP_NUM_THREADS to change it). Errors are those of the jobs of `make
sweep`, and for the seed's network to the letter those of `python -m pipelines.sweep bench`, which `--train` runs first
where they are missing (a quarter of an hour); without them it is timed untrained. CSV, Markdown and plots go into
outputs/reports/bench, with `--publish` into docs/results/bench and the table of the README as well.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from pipelines.bench_sources import SCENES, Source, sources
from pipelines.gather import read_jobs
from pipelines.provenance import commit_words, set_thread_environment
from pipelines.publish import copy_report, renew_table
from zsdt.errors import ZsdtError

if TYPE_CHECKING:
    from zsdt.evaluation.bench_report import Results

ROOT = Path(__file__).resolve().parents[1]
TRAINED_APART = ("bench_beam", "bench_glass")
JUDGED = 2  # trajectories of a regime on which another resolution is judged
SIZE_TURNS = 25  # how many turns of the clock a size of a growing body counts for in the progress bar


def main(arguments: Sequence[str] | None = None) -> int:
    """Times, writes and prints the page; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.bench", description=__doc__)
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of all runs")
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES), help="which scenes")
    parser.add_argument("--rounds", type=int, default=2, help="turns of each method on each body")
    parser.add_argument("--largest", type=int, default=100_000, help="nodes at which growth ends (0: no growth)")
    parser.add_argument("--train", action="store_true", help="train the seed's network where no job has")
    parser.add_argument("--publish", action="store_true", help="also into docs/results/bench")
    chosen = parser.parse_args(arguments)
    set_thread_environment(1)
    try:
        return _bench(chosen)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _bench(chosen: argparse.Namespace) -> int:
    import torch

    from zsdt.evaluation.bench import threads
    from zsdt.evaluation.bench_headline import headline_table
    from zsdt.evaluation.bench_report import write_report

    torch.set_num_threads(threads())
    if chosen.train:
        _train_missing(chosen.outputs)
    found = sources(chosen.outputs, chosen.scenes)
    results = _measure(found, chosen.rounds, chosen.largest)
    origin = _origin(found)
    page = write_report(chosen.outputs / "reports" / "bench", results, origin)
    print(page.read_text())
    print(f"Written to {page.parent}")
    if chosen.publish:
        print(f"Published: {copy_report(page.parent, 'bench*', ROOT / 'docs' / 'results' / 'bench')}")
        renew_table(ROOT / "README.md", "bench", f"{headline_table(results.points)}\n\n{origin}")
    return 0


def _train_missing(outputs: Path) -> None:
    """Runs the sweep `bench` if no finished job has trained the seed's network."""
    from pipelines.sweep import main as sweep

    done = {job.experiment for kind in ("runs", "multirun") for job in read_jobs(outputs / kind) if job.finished}
    if not set(TRAINED_APART) <= done:
        sweep(["bench", f"machine.outputs={outputs}"])


def _origin(found: Sequence[Source]) -> str:
    """Command, commit, and which experiments trained what is timed."""
    experiments = sorted({method.experiment for source in found for method in source.methods})
    return (
        f"Made by `make bench` at commit {commit_words()}. Networks and their errors: finished jobs of "
        f"{', '.join(experiments)}."
    )


def _measure(found: Sequence[Source], rounds: int, largest: int) -> Results:
    """All tables, behind one progress bar."""
    from pipelines.bench_parts import growers_of, points_of, ratio_parts, training_parts
    from zsdt.evaluation.bench import grouped, measure, turns
    from zsdt.evaluation.bench_growth import SIZES, exponents, grow
    from zsdt.evaluation.bench_ratio import compare
    from zsdt.evaluation.bench_report import Results, with_front
    from zsdt.evaluation.bench_training import training_costs

    cases = []
    for source in found:
        with tqdm(desc=f"{source.scene}: other resolutions", unit="method") as judging:

            def judged(what: str, bar: tqdm = judging) -> None:
                bar.set_postfix_str(what)
                bar.update()

            cases += points_of(source, JUDGED, judged)
    ratios = [part for source in found for part in ratio_parts(source)]
    sizes = [size for size in SIZES if size <= largest]
    networks = {source.scene: training_parts(source) for source in found}
    total = turns(cases, rounds) + sum((rounds + 3) * len(part.makers) for part in ratios)
    total += SIZE_TURNS * len(sizes) + sum(len(options) for options, _ in networks.values())
    with tqdm(total=total, desc="bench", unit="turn") as bar:

        def tick(what: str, count: int = 1) -> None:
            bar.set_postfix_str(what, refresh=False)
            bar.update(count)

        points = with_front([row for _, mine in grouped(cases) for row in measure(mine, rounds, progress=tick)])
        ratio = []
        for part in ratios:
            rows = compare(part.makers, part.trajectory, part.pairs, part.judged, rounds + 2, tick)
            ratio += [{"graph": part.name, **row} for row in rows]
        growth = grow(growers_of(found), sizes, progress=lambda what: tick(what, SIZE_TURNS)) if sizes else []
        training = []
        for scene, (options, trajectories) in networks.items():
            if options:
                training += [{"scene": scene, **row} for row in training_costs(options, trajectories, progress=tick)]
    return Results(points, ratio, growth, exponents(growth), training)


if __name__ == "__main__":
    sys.exit(main())
