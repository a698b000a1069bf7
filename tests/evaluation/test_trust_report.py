"""What the flags were worth, and what normal runs make of limits."""

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.evaluation.stability_row import Row
from zsdt.evaluation.stability_table import Judged
from zsdt.evaluation.trust_normal import CLOSED, OPEN, NormalRun, _keep, _kept, calibrated, ranges_of
from zsdt.evaluation.trust_report import false_alarms, normal_table, page_text, picture, warned
from zsdt.twin.trust import TrustSeries


def judged(first_flag, first_3x, outcome="bounded"):
    flags = ["" if first_flag is None or k < first_flag else "range" for k in range(30)]
    return Judged(Row("case", "beam", "twin", outcome, flags=flags), 5.0, first_3x, first_flag, "")


@pytest.mark.parametrize(
    "flag, passed, outcome, verdict",
    [
        (3, 9, "bounded", "before"),
        (9, 9, "bounded", "same frame"),
        (12, 9, "bounded", "late"),
        (None, 9, "bounded", "silent"),
        (3, None, "bounded", "flag alone"),
        (None, None, "bounded", "quiet"),
        (10, None, "rejected", "gone"),
        (None, 9, "rejected", "gone"),
    ],
)
def test_a_flag_is_worth_what_it_comes_before(flag, passed, outcome, verdict):
    found = warned(judged(flag, passed, outcome))
    assert found.verdict == verdict
    assert found.lead == (None if None in (flag, passed) else passed - flag)


def run(name, loop, peak, calibrates, leak=0.0):
    values = {"rate": np.linspace(0.0, peak, 20), "leak": np.full(20, leak), "gap": np.full(20, np.nan)}
    return NormalRun(name, loop, TrustSeries([""] * 20, [""] * 20, values), {"length": 0.5}, calibrates)


@pytest.fixture
def runs():
    return [
        run("a", OPEN, 1.0, True), run("b", OPEN, 1.05, False),
        run("c", CLOSED, 3.0, True), run("d", CLOSED, 5.0, False),
    ]  # fmt: skip


def test_limits_are_those_of_the_runs_that_calibrate(runs):
    """An engine alone is not allowed what corrections do to a twin; runs that test make no limit."""
    limits = calibrated({"rate": (0.0, 0.5)}, runs, {})
    assert limits.within(alone=True)["rate"][1] == pytest.approx(1.1)
    assert limits.within(alone=False)["rate"][1] == pytest.approx(3.3)
    assert "gap" not in limits.limits  # never measured
    alarms = {r.name: r.alarms(limits) for r in runs}
    assert not any(alarms["a"]) and not any(alarms["b"]) and not any(alarms["c"])
    expected = int((np.linspace(0.0, 5.0, 20) > 3.3).sum())
    assert alarms["d"].count("range") == expected and alarms["d"].count("") == 20 - expected
    rows = normal_table("foam_beam", runs, limits)
    assert [r["flagged_frames"] for r in rows] == [0, 0, 0, expected]
    tested = next(line for line in false_alarms(rows) if line[1:3] == [CLOSED, "tests"])
    assert tested[3:7] == ["1", "20", "1", str(expected)]


def test_without_a_run_that_calibrates_there_are_no_limits(runs):
    with pytest.raises(DataError, match="No run"):
        calibrated({}, [r for r in runs if not r.calibrates], {})


def test_a_run_is_kept_as_it_was(runs, tmp_path):
    _keep(tmp_path / "run.json", runs[2])
    found = _kept(tmp_path / "run.json")
    assert (found.name, found.loop, found.calibrates, found.card) == ("c", CLOSED, True, {"length": 0.5})
    assert ranges_of(found.series) == ranges_of(runs[2].series) and len(found.alarms(calibrated({}, runs, {}))) == 20


def test_the_page_names_the_worst_first(runs):
    cases = [warned(judged(12, 9)), warned(judged(3, 9))]
    rows = normal_table("foam_beam", runs, calibrated({}, runs, {}))
    text = page_text(cases, rows, {"case": "what it is"}, "Made by a test.")
    assert text.index("| late |") < text.index("| before | 3 | 9 | 6 | range |")
    assert picture(cases).startswith(b"\x89PNG")
