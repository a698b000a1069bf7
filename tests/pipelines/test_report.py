"""The report opens from the disk by itself, and holds what the sweep found."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from made_up import write_sweep

from pipelines.collect import collect
from pipelines.gather import methods_of, read_jobs
from pipelines.report import main


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished sweep and its report."""
    folder = tmp_path_factory.mktemp("outputs")
    write_sweep(folder)
    assert main(["--outputs", str(folder)]) == 0
    return folder


def test_the_page_needs_nothing_from_outside(outputs: Path) -> None:
    page = next((outputs / "reports").glob("*/index.html")).read_text()
    assert not re.search(r"(src|href)\s*=\s*['\"]?(https?:|//)", page)
    assert "<script" not in page and "@import" not in page
    pictures = re.findall(r"src='([^']{30})", page)
    assert len(pictures) == 4 and all(picture.startswith("data:image/png;base64,iVBOR") for picture in pictures)
    for link in re.findall(r"href='([^#'][^']*)'", page):
        assert (outputs / "reports" / "any" / link).resolve().is_file()


def test_the_page_names_failed_jobs_and_escapes_what_they_say(outputs: Path) -> None:
    page = next((outputs / "reports").glob("*/index.html")).read_text()
    assert "8 of 9 jobs finished" in page
    assert "It &lt;went&gt; badly; mend it." in page


def test_shared_methods_are_counted_once(outputs: Path) -> None:
    methods = methods_of(read_jobs(outputs / "multirun"))
    names = [method.name for method in methods]
    assert {name: names.count(name) for name in names} == {"tignn_soft": 8, "black_box": 4, "static": 1, "fem_5cm": 1}
    assert len({method.label for method in methods}) == len(methods)
    black_box = [method.label for method in methods if method.name == "black_box"]
    assert "black_box passes=4 noise=0.003" in black_box
    best = min(methods, key=lambda method: method.mean("displacement_rrmse_mean", "hand"))
    assert best.label == "tignn_soft passes=8 lambda_d=50 noise=0.003"


def test_the_table_of_a_sweep_has_a_row_for_each_job(outputs: Path) -> None:
    table = collect(outputs / "multirun")
    assert len(table.rows) == 9 and [name for name, _ in table.failed()] == ["2026-01-01_00-00-00_made_up/factors/8"]
    assert len(table.csv().splitlines()) == 10


def test_nothing_to_report_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--outputs", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("error: Nothing was run below")
