"""Figures of a glass twin against the truth: known lags, known amounts, kept rows, tables that say who failed."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from tests.twin.made_up_glass import FLOOR, FPS, LEVEL, WALL, camera, made_up_glass
from zsdt.errors import DataError, OptionError
from zsdt.evaluation import glass_twin_report
from zsdt.evaluation.glass_twin_cases import (
    GlassCase,
    GlassTwinEvaluationOptions,
    fill_height,
    glass_errors,
    lag_of,
    survival,
)
from zsdt.evaluation.glass_twin_report import evaluate_glass_clips, gains, latency, page, picture, summarise
from zsdt.evaluation.true_masks import TrueMasks
from zsdt.lab.faults import FaultPlan
from zsdt.lab.glass_clips import GlassClip, GlassClipScene
from zsdt.scene import Liquid
from zsdt.shipped import TwinWeights


@pytest.mark.parametrize("late", [-0.02, 0.0, 0.011, 0.04])
def test_a_swing_that_is_late_is_late_by_that_much(late: float) -> None:
    times = np.arange(60) / 60.0

    def swing(when: np.ndarray) -> np.ndarray:
        return np.exp(-4.0 * when) * np.cos(2.0 * np.pi * 3.0 * when)

    assert lag_of(swing(times - late), swing(times), 1 / 60) == pytest.approx(late, abs=3e-3)


def test_what_does_not_move_has_no_lag() -> None:
    assert np.isnan(lag_of(np.zeros(40), np.sin(np.arange(40.0)), 0.02))


def test_the_truth_has_no_error_and_the_closed_loop_less_than_the_open_one() -> None:
    closed, opened, truth = made_up_glass()
    assert fill_height(truth) == pytest.approx(LEVEL, rel=0.15), "the lattice leaves a gap at the wall"
    own = glass_errors(truth, truth)
    assert own["level_mm"] == own["centroid_mm"] == own["volume_error"] == 0.0
    assert own["rest_ratio"] == 1.0
    ours, theirs = glass_errors(closed, truth), glass_errors(opened, truth)
    assert ours["level_mm"] < theirs["level_mm"]
    assert ours["vertical_velocity_rrmse"] < 0.6 * theirs["vertical_velocity_rrmse"]
    assert ours["level_px"] == pytest.approx(ours["level_mm"] * 1.4 / 0.6, rel=0.1), "1400 px at 0.6 m"
    assert theirs["rest_s"] <= ours["rest_s"] <= ours["true_rest_s"] + 2 / FPS
    assert ours["volume_drift"] == 0.0


def test_a_run_that_leaves_the_vessel_or_the_numbers_has_not_survived() -> None:
    closed, _, truth = made_up_glass()
    assert survival(closed, truth) == (True, "")
    closed.positions[3, 0] = [0.2, 0.0, 0.02]
    assert survival(closed, truth) == (False, "1 particles leaked")
    closed.positions[3, 0] = np.nan
    assert survival(closed, truth) == (False, "not finite")


def row(clip: str, case: str, error: float) -> dict:
    """A row as `judge_glass_clip` gives it."""
    return {
        "clip": clip, "case": case, "family": "bowl", "viscosity_ratio": 1.2, "particles": 700, "level_mm": error,
        "vertical_velocity_rrmse": 0.1 * error, "total_p50_ms": 20.0, "total_p95_ms": 22.0, "total_p99_ms": 30.0,
        "survived": error < 9, "reason": "" if error < 9 else "diverged",
        "curves": {n: [error, error] for n in ("level_mm", "vertical_velocity", "rise", "true_rise")},
    }  # fmt: skip


def test_tables_give_the_mean_the_worst_the_gain_and_who_failed() -> None:
    rows = [row("a", "open", 4.0), row("b", "open", 9.0), row("a", "closed", 1.0), row("b", "closed", 3.0)]
    table = pd.DataFrame([{k: v for k, v in r.items() if k != "curves"} for r in rows])
    summary = summarise(table).set_index(["case", "family"])
    assert summary.loc[("open", "all"), "level mm"] == 6.5
    assert summary.loc[("closed", "bowl"), "level mm worst"] == 3.0
    (found,) = gains(table).values()
    assert found["level_mm_gain"] == 13.0 / 4.0 and found["level_mm_gain_least"] == 3.0
    assert latency(table)["p50"].tolist() == [20.0]
    words = page(table, summary.reset_index(), "make it")
    assert "b open: diverged" in words and "`make it`" in words
    assert picture(rows, 1 / 60)[:4] == b"\x89PNG"


def test_an_evaluation_that_was_interrupted_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    (clips / "index.csv").write_text("name,family,regime,contents,frames,fps\na,bowl,stop,liquid,60,60.0\n")
    (tmp_path / "rows").mkdir()
    (tmp_path / "rows" / "a.open.json").write_text(json.dumps(row("a", "open", 4.0)))
    asked = []

    def judge(folder: str, case: str, *_) -> dict:
        asked.append(case)
        return row(Path(folder).name, case, 1.0)

    monkeypatch.setattr(glass_twin_report, "judge_glass_clip", judge)
    options = GlassTwinEvaluationOptions(cases=[GlassCase.open, GlassCase.closed])
    figures = evaluate_glass_clips(clips, TwinWeights(clips, clips, clips), options, tmp_path, tmp_path)
    assert asked == ["closed"]
    assert figures["open"]["level_mm"] == 4.0 and figures["closed"]["level_mm"] == 1.0
    assert json.loads((tmp_path / "rows" / "a.closed.json").read_text())["case"] == "closed"
    assert (tmp_path / "summary.md").is_file() and (tmp_path / "errors.png").is_file()


def test_options_that_make_no_sense_are_refused() -> None:
    with pytest.raises(OptionError, match="at least one case"):
        GlassTwinEvaluationOptions(cases=[])


def test_true_masks_are_those_of_the_picture_and_of_no_other(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (2, 48, 64, 3), np.uint8)
    for part in ("frames", "masks"):
        (tmp_path / part).mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "frames" / f"{k:05d}.png"), image)
        for part, level in (("container", 200), ("liquid", 255)):
            cv2.imwrite(str(tmp_path / "masks" / f"{k:05d}_{part}.png"), np.full((48, 64), level - 50 * k, np.uint8))
    scene = GlassClipScene(Liquid(), WALL, FLOOR, 1.5, 1.473, None, 60.0, 9.81)
    segmenter = TrueMasks(GlassClip(tmp_path, scene, camera()))
    second = segmenter.masks(images[1])
    assert np.allclose(second.container, 150 / 255) and np.allclose(second.liquid, 150 / 255), "liquid is in the glass"
    hidden = TrueMasks(segmenter.clip, plan=FaultPlan(boxes={1: (10, -5, 30, 20)}, shift={0: 7.0}))
    assert hidden.masks(images[1]).container[:20, 10:30].max() == 0.0 < hidden.masks(images[1]).container[21].min()
    assert hidden.masks(images[0]).container[:, :6].max() == 0.0, "the camera turned, the glass went right"
    with pytest.raises(DataError, match="none of"):
        segmenter.masks(images[1] + np.uint8(1))
