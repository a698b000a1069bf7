"""What the benchmark takes from finished jobs: errors by regime, the best of variants that cost the same."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from pipelines.bench_sources import Source, costs_of, entries_of, judged_of, sources
from pipelines.gather import Method
from zsdt.errors import DataError
from zsdt.trajectory import Dataset


def row(regime: str, split: str, count: int, mean: float, worst: float) -> dict:
    return {"regime": regime, "split": split, "trajectories": count, "method": "x",
            "displacement_rrmse_mean": mean, "displacement_rrmse_worst": worst}  # fmt: skip


def method(name: str, error: float, steps: int = 10, **options) -> Method:
    rows = [row("hand", "test", 1, error, error)]
    figures = {"steps": steps, "cpu_minutes": 0.5}
    return Method(name, name, "key", "experiment", False, options, figures, rows, folder=Path("somewhere"))


def test_errors_are_means_over_trajectories_and_worst_over_splits() -> None:
    rows = [row("hand", "test", 3, 0.1, 0.2), row("hand", "beyond", 1, 0.5, 0.5), row("dynamic", "test", 2, 9.0, "inf")]
    found = judged_of(Method("x", "x", "key", "e", True, rows=rows))
    assert found["hand"].trajectories == 4
    assert found["hand"].errors["displacement_rrmse"] == pytest.approx(0.2)
    assert found["hand"].errors["displacement_rrmse_worst"] == 0.5
    assert found["dynamic"].errors["displacement_rrmse_worst"] == math.inf  # a rollout that diverged
    assert "velocity_rrmse" not in found["hand"].errors


def source_of(methods: list[Method], folder: Path) -> Source:
    folder.mkdir(exist_ok=True)
    (folder / "index.csv").write_text("name,split,regime,family\n")
    return Source("foam_beam", Dataset(folder), methods)


def test_of_variants_of_one_shape_the_best_stands_for_all(tmp_path: Path) -> None:
    methods = [
        method("tignn_soft", 0.9, passes=4, width=48, lambda_d=5),
        method("tignn_soft", 0.4, passes=4, width=48, lambda_d=50),
        method("tignn_soft", 0.6, passes=8, width=48, lambda_d=50),
        method("tignn_cell_from_psi_ini", 0.1),
    ]
    source = source_of(methods, tmp_path / "set")
    found = [(e.method, e.judged["hand"].errors["displacement_rrmse"], e.note) for e in entries_of(source)]
    assert found == [("tignn_soft", 0.4, "best of 2"), ("tignn_soft", 0.6, "")]


def test_the_longest_training_of_a_name_is_the_one_that_is_meant(tmp_path: Path) -> None:
    source = source_of([method("seed_form", 0.3, 300), method("seed_form", 0.2, 2200)], tmp_path / "set")
    longest = source.named("seed_form", "tignn_exact")
    assert longest is not None and costs_of(longest)["steps"] == 2200
    assert costs_of(longest)["displacement_rrmse"] == 0.2
    assert source.named("seed_literal") is None


def test_without_a_finished_job_it_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="make sweep"):
        sources(tmp_path, ["glass"])
