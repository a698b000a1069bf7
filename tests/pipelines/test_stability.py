"""`python -m pipelines.stability`: a table of what was asked for, resumable, and its words for mistakes."""

import csv
import logging

from pipelines.stability import main


def test_cases_by_name_give_a_table_and_are_not_run_twice(tmp_path, capsys):
    asked = [
        "--outputs",
        str(tmp_path),
        "--workers",
        "1",
        "--cases",
        "normal_release, load_10x",
        "--parties",
        "network",
    ]
    before = logging.getLogger("zsdt").level
    assert main(asked) == 0
    assert logging.getLogger("zsdt").level == before, "whoever runs hard cases hears of rejections afterwards"
    folder = tmp_path / "reports" / "stability"
    with (folder / "stability.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(line["case"], line["party"], line["verdict"]) for line in lines] == [
        ("load_10x", "network", "rejected"),  # the worse one first
        ("normal_release", "network", "bounded"),
    ]
    assert lines[0]["reason"].startswith("collapse") and float(lines[1]["energy_growth"]) < 1e-3
    page = (folder / "stability.md").read_text()
    assert "make stability" in page and "2 N let go" in page
    assert (folder / "stability.png").read_bytes().startswith(b"\x89PNG")
    rows = {path: path.stat().st_mtime_ns for path in (folder / "rows").glob("*.json")}
    assert len(rows) == 2 and main(asked) == 0
    assert rows == {path: path.stat().st_mtime_ns for path in (folder / "rows").glob("*.json")}
    assert "rejected" in capsys.readouterr().out


def test_a_wrong_name_is_told_before_anything_runs(tmp_path, capsys):
    assert main(["--outputs", str(tmp_path), "--cases", "load_3y"]) == 1
    assert "no hard case 'load_3y'" in capsys.readouterr().err
    assert main(["--list"]) == 0 and "load_3x" in capsys.readouterr().out
