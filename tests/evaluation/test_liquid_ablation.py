"""The ablation of the node form of liquids, end to end on tiny liquids."""

import csv
from pathlib import Path

import pytest

from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.errors import DataError
from zsdt.evaluation.liquid_ablation import COLUMNS, FROM_WATER, PHYSICAL, REFERENCE, RELAXED, Settings, ablate
from zsdt.trajectory import DatasetEntry, write_index, write_trajectory

TINY = Settings(steps=2, passes=1, width=8)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, entries = tmp_path_factory.mktemp("liquids"), []
    for seed, split in enumerate(("train", "train", "test", "beyond")):
        trajectory = make_flow(make_liquid(0.013, 0.015, seed), seed=seed, name=f"flow_{seed}")
        write_trajectory(folder / f"{trajectory.name}.h5", trajectory)
        entries.append(DatasetEntry(f"{trajectory.name}.h5", trajectory.name, split, "glycerin", "cylinder"))
    write_index(folder, entries)
    return folder


def test_rows_of_every_named_variant_and_no_training_twice(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "table"
    names = [REFERENCE, PHYSICAL, RELAXED]
    rows = ablate(dataset, out, None, TINY, names, "the command")
    assert [(r["variant"], r["split"]) for r in rows] == [(n, s) for n in names for s in ("test", "beyond")]
    assert all(float(r["displacement_percent"]) > 0 and r["steps"] == 2 for r in rows)
    trained = {p: p.stat().st_mtime_ns for p in out.rglob("weights.pt")}
    assert len(trained) == 2  # relaxation is judged on the weights of the reference
    ablate(dataset, out, dataset, TINY, [REFERENCE, FROM_WATER], "the command")
    assert all(p.stat().st_mtime_ns == t for p, t in trained.items())
    with out.with_suffix(".csv").open(newline="") as lines:
        table = list(csv.DictReader(lines))
    assert tuple(table[0]) == COLUMNS and len(table) == 8
    text = out.with_suffix(".md").read_text()
    assert "the command" in text and FROM_WATER in text


def test_an_unknown_variant_is_named(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no variant"):
        ablate(dataset, tmp_path / "table", None, TINY, ["nonsense"])
