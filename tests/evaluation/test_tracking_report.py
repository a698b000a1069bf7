"""The tracking report: painted scenes are what they say, figures come from known errors, faults are told."""

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.evaluation import tracking_report
from zsdt.evaluation.tracking_report import main, tracking_case
from zsdt.evaluation.tracking_runs import Follow, back_after_occlusion, chain, follow, read_clip, summary
from zsdt.evaluation.tracking_scenes import OCCLUDED, Difficulty, SwingingBeam


@pytest.fixture(scope="module")
def beam():
    return SwingingBeam(1)


def test_painted_frames_show_the_nodes_that_they_name(beam):
    frames = list(beam.frames(Difficulty("plain"), 6))
    images, truth = [image for image, _ in frames], np.stack([nodes for _, nodes in frames])
    assert images[0].shape == (540, 960, 3) and truth.shape[1] == beam.columns * beam.rows
    assert np.linalg.norm(truth[5] - truth[0], axis=1).max() > 10.0
    mine, plain = follow(images, truth, beam.edges), chain(images, truth)
    assert np.median(mine.error[-1]) < 0.15 and mine.seen[-1].mean() > 0.9
    assert np.median(mine.error[-1]) < np.median(plain.error[-1])
    again = next(iter(beam.frames(Difficulty("plain"), 1)))[0]
    assert np.array_equal(again, images[0])


def test_a_twin_that_is_off_is_given_as_asked(beam):
    frames = list(beam.frames(Difficulty("fast", cycles=8.0), 6))
    images, truth = [image for image, _ in frames], np.stack([nodes for _, nodes in frames])
    run = follow(images, truth, beam.edges, twin=0.2)
    assert np.linalg.norm(0.2 * (truth[5] - truth[0]), axis=1).max() > 6.0
    assert run.seen[-1].mean() > 0.9 and np.median(run.error[-1]) < 0.2


def test_figures_of_a_known_run():
    error = np.tile(np.linspace(0.0, 2.0, 21), (70, 1))
    seen = np.ones((70, 21), bool)
    seen[:, -1] = False
    run = Follow(error, seen, np.zeros((70, 21, 2)), np.arange(69.0))
    row = summary(run, np.zeros((70, 21, 2)))
    assert row["median px at the end"] == 1.0 and row["95 % px at the end"] == pytest.approx(1.9)
    assert row["worst px of seen"] == pytest.approx(1.9) and row["kept"] == pytest.approx(20 / 21)
    assert back_after_occlusion(run) == pytest.approx(11 / 21)
    assert OCCLUDED[1] - OCCLUDED[0] == 30


def test_a_report_is_written_and_clips_that_are_none_are_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tracking_report, "FRAMES", 66)
    monkeypatch.setattr(tracking_report, "DIFFICULTIES", (Difficulty("occlusion", light=0.4, occluded=True),))
    monkeypatch.setattr(tracking_report, "JUDGED", ("occlusion",))
    result = tracking_case([1], None)
    assert [verdict.passed for verdict in result.verdicts] == [True, True]
    assert [row["case"] for row in result.rows] == ["occlusion"]
    assert main([str(tmp_path), "--clips", str(tmp_path / "nowhere")]) == 2
    assert "no folder" in capsys.readouterr().err
    with pytest.raises(DataError, match=r"pixels.npy"):
        read_clip(tmp_path)
