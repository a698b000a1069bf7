"""The judge of glass geometry: right about a case it can check, and tables that count what they say."""

from pathlib import Path

import numpy as np
import pytest

from zsdt.evaluation import glass_geometry_cases as cases
from zsdt.evaluation.glass_geometry_bench import family_table, report, stop_table
from zsdt.fluid.vessel import Vessel
from zsdt.lab.glass_lab import GlassLabOptions
from zsdt.lab.glass_painter import GlassPainter
from zsdt.scene import VesselFamily


def test_a_stop_of_the_lab_is_found_from_its_outlines() -> None:
    row = cases.drawn_stop(1, GlassLabOptions())
    assert abs(row["frames_off"]) <= 1 and abs(row["instant_ms"]) < 8 and 0 < row["told_after"] <= 6


def test_a_painted_glass_is_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "MOVING", 2)
    monkeypatch.setattr(cases, "AFTER", 0)
    case = cases.lab_case(0, GlassLabOptions(families=[VesselFamily.tumbler]), GlassPainter())
    x, height = cases.true_contact(case)
    assert np.ptp(height) > 2e-3 and (np.diff(x) > 0).all()  # askew
    assert case.fill < Vessel(case.shape).rim
    reading = cases.read_case(case)
    assert abs(reading.figures["cavity_pct"]) < 2 and reading.figures["profile_pct"] < 3
    assert abs(reading.figures["cavity_pct_flat"]) > 2 * abs(reading.figures["cavity_pct"])
    nothing = cases.read_case(case, lambda image: (case.masks[-1][0], 0 * case.masks[-1][1]))
    assert np.isnan(nothing.figures["profile_pct"])


def test_tables_count_failures_and_what_is_within(tmp_path: Path) -> None:
    fair = {"case": "a", "family": "jar", "source": "painter", "masks": "exact", "profile_pct": 1.0, "volume_pct": -2.0}
    rows = [fair, {**fair, "profile_pct": 4.0}, {**fair, "volume_pct": 6.0}, {**fair, "profile_pct": np.nan}]
    jar, every = family_table(rows)
    assert jar["within"] == "1/4" == every["within"] and jar["failed"] == 1 and every["family"] == "all"
    assert jar["volume_pct_worst"] == 6.0
    offs = (0.0, 1.0, -2.0, float("nan"))
    stops = [{"masks": "outlines", "frames_off": off, "instant_ms": off, "told_after": off} for off in offs]
    (line,) = stop_table(stops)
    assert (line["exact"], line["within a frame"], line["missed"]) == (1, 2, 1)
    assert report(tmp_path, rows, stops, [], "a command") == 1
    assert report(tmp_path, [fair], stops[:1], [], "a command") == 0
    assert "a command" in (tmp_path / "README.md").read_text() and (tmp_path / "stops.csv").is_file()
