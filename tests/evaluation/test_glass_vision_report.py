"""The judge of glasses finds what is known, and its files say so."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.perception.made_up_glass import ByColour, labelled
from zsdt.errors import DataError
from zsdt.evaluation.glass_vision_judge import LEVEL_SIZE, judge_glass
from zsdt.evaluation.glass_vision_report import judge_glass_videos, judge_glass_vision, milliseconds, verdicts
from zsdt.perception.glass_memory import MemoryOptions
from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_vision_data import LabelledGlasses, no_glasses
from zsdt.perception.region_of_interest import RegionOptions


class Truth:
    """Answers with the truth of one picture, moved down by some rows."""

    def __init__(self, data, down=0):
        self.data, self.down = data, down

    def masks(self, image, window=None):
        k = next(k for k in range(len(self.data)) if self.data.images[k] is image)
        parts = [m[k].astype(np.float32) / 255 for m in (self.data.containers, self.data.liquids)]
        return GlassMasks(parts[0], np.roll(parts[1], self.down, axis=0), window)


def test_the_truth_scores_one_and_a_shift_shows_in_the_level():
    data = labelled(3)
    row = judge_glass(Truth(data), data, 0).row
    assert row["container_iou"] == row["liquid_iou"] == 1 and row["level_px_median"] == 0
    moved = judge_glass(Truth(data, 3), data, 0).row
    assert moved["level_px_bias"] == pytest.approx(3 * LEVEL_SIZE / 160) and moved["liquid_iou"] < 0.97


def test_the_report_holds_every_picture_the_goals_and_the_pictures(tmp_path):
    data = labelled(4) + labelled(1, known=False)
    table = judge_glass_vision(ByColour(160), data, tmp_path, "Plain ones.")
    assert table.summary["images"] == 5 and table.summary["container_iou"] > 0.95
    assert np.isnan(table.rows[-1]["liquid_iou"]) and table.summary["liquid_iou"] > 0.9
    assert verdicts({**table.summary, "liquid_iou": 0.2})[0]["met"] == "NO"
    for name in ("glass_vision.md", "glass_vision.csv", "worst.jpg", "typical.jpg"):
        assert (tmp_path / name).stat().st_size > 100
    assert json.loads((tmp_path / "glass_vision.json").read_text())["images"] == 5
    assert "Plain ones." in (tmp_path / "glass_vision.md").read_text()
    with pytest.raises(DataError, match="no pictures"):
        judge_glass_vision(ByColour(), no_glasses())


def test_what_is_not_there_has_no_iou_but_is_told():
    data = labelled(2)
    empty = LabelledGlasses(
        data.images, data.containers, [np.zeros_like(m) for m in data.liquids], data.names, data.liquid_known
    )
    summary = judge_glass_vision(Truth(empty), empty).summary
    assert np.isnan(summary["liquid_iou"]) and summary["without_liquid"] == summary["without_liquid_clean"] == 2
    told = judge_glass_vision(Truth(data), empty).summary  # sees liquid where there is none
    assert told["without_liquid"] == 2 and told["without_liquid_clean"] == 0 and told["container_iou"] == 1


def test_milliseconds_are_told_for_each_number_of_threads():
    rows = milliseconds(ByColour, labelled(2), threads=(1, 2), rounds=3)
    assert [row["threads"] for row in rows] == [1, 2] and all(row["ms_p95"] >= row["ms_p50"] > 0 for row in rows)


def test_a_video_is_read_whole_and_judged_with_what_is_remembered(tmp_path):
    """Every fourth picture of a glass that stands is judged; vision fails in some of them, and it costs nothing."""

    class Flickers(ByColour):
        def masks(self, image, window=None):
            masks = super().masks(image, window)
            if image[0, 0, 0] in (4, 6, 8):
                masks.container[98:] *= 0.3
                masks.liquid[98:] *= 0.3
            return masks

    clip = sum([labelled(1)] * 12, no_glasses())
    clip = replace(clip, images=[image.copy() for image in clip.images])
    for number, image in enumerate(clip.images):
        image[0, 0, 0] = number
    steady = judge_glass_videos(Flickers(160), [clip, clip], 4, tmp_path, "In order.")
    single = judge_glass_videos(Flickers(160), [clip, clip], 4, region=RegionOptions(memory=MemoryOptions(frames=1)))
    assert steady.summary["images"] == 6 and "In order." in (tmp_path / "glass_vision.md").read_text()
    assert steady.summary["container_iou_worst"] > 0.95 > single.summary["container_iou_worst"]
    assert steady.summary["liquid_iou_worst"] > 0.9 > single.summary["liquid_iou_worst"]
    with pytest.raises(DataError, match="no pictures"):
        judge_glass_videos(ByColour(), [no_glasses()], 1)
