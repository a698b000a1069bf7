"""The table of a sweep: what differs stands beside what came out, apart for jobs whose figures are not the same."""

from __future__ import annotations

import json
from pathlib import Path

from pipelines.collect import collect


def _job(folder: Path, overrides: list[str], figures: dict[str, dict[str, float]]) -> None:
    folder.mkdir(parents=True)
    card = {"status": "finished", "experiment": "e", "overrides": overrides, "figures": figures, "seconds": 1.0}
    (folder / "summary.json").write_text(json.dumps(card))


def test_parts_with_other_figures_get_tables_of_their_own(tmp_path: Path) -> None:
    for k, (gain, error) in enumerate([(0.3, 0.4), (1, 0.1)]):
        _job(tmp_path / "gain" / str(k), [f"twin.gain={gain}"], {"evaluate_twin": {"closed": error}})
        _job(tmp_path / "depth" / str(k), [f"tignn.passes={k + 4}"], {"evaluate": {"engine": error}})
    table = collect(tmp_path)
    parts = [part.splitlines() for part in table.markdown().split("\n\n")]
    assert [part[0] for part in parts] == [
        "| job | status | experiment | tignn.passes | engine |",
        "| job | status | experiment | twin.gain | closed |",
    ]
    assert parts[1][2:] == ["| gain/0 | finished | e | 0.3 | 0.4 |", "| gain/1 | finished | e | 1 | 0.1 |"]
    header = (tmp_path / "sweep.csv").read_text().splitlines()[0]
    assert set(header.split(",")) >= {"tignn.passes", "twin.gain", "engine", "closed", "stage"}
