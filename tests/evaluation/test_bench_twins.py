"""The clock of the twins: which frames count, what counts as a whole frame, and what the tables say."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.evaluation.bench_twins import WARM_UP, TwinCase, time_twins, write_twin_report


def log(scale, frames=40, start=None):
    """A made-up log: two parts that take `scale` and 2 `scale` ms, the first frames far slower."""
    slow = np.where(np.arange(frames) < WARM_UP + (start or 0), 1000.0, scale)
    latency = {"capture": slow * 100, "predict": slow, "track": 2 * slow}
    found = SimpleNamespace(latency=latency, start_ms={"fit": 10.0 * scale}, body=SimpleNamespace(nodes=7))
    if start is not None:  # a twin that does two things at once says itself what a frame took
        found.start, found.whole = start, 2.5 * slow
    return found


def test_warm_frames_count_and_what_runs_side_by_side_counts_once(tmp_path):
    ran = []

    def case(name, start):
        def run(folder):
            ran.append((name, folder.name))
            return log(float(folder.name), start=start)

        return TwinCase("beam" if start is None else "glass", name, 1, run)

    clips = {"beam": [tmp_path / "1", tmp_path / "3"], "glass": [tmp_path / "2"]}
    rows, begun = time_twins([case("plain", None), case("beside", 4)], clips)
    # Everything once to warm up, then all cases in turn, clip by clip.
    assert ran == [("plain", "1"), ("beside", "2"), ("plain", "1"), ("beside", "2"), ("plain", "3")]
    of = {(row["case"], row["part"]): row for row in rows}
    assert of["plain", "total"]["p50"] == pytest.approx(6.0) and of["plain", "total"]["max"] == pytest.approx(9.0)
    assert of["plain", "total"]["worst_clip_p99"] == pytest.approx(9.0)
    assert of["plain", "predict"]["frames"] == 2 * (40 - WARM_UP)
    assert of["beside", "total"]["p99"] == pytest.approx(5.0) and of["beside", "total"]["nodes"] == "7 to 7"
    assert {(row["case"], row["ms"]) for row in begun} == {("plain", 20.0), ("beside", 20.0)}
    page = write_twin_report(tmp_path / "out", rows, begun, "Made by a test.")
    assert "Made by a test." in page.read_text() and "| plain | 1 | total | 6.00 |" in page.read_text()
    with (tmp_path / "out" / "bench_twins.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def test_nothing_timed_is_said(tmp_path):
    with pytest.raises(DataError, match="name folders"):
        write_twin_report(tmp_path, [], [], "")
