"""Training learns what it is shown, the same way every time, and goes on from given weights."""

import csv

import numpy as np
import pytest
import torch

from tests.perception.painted_grid import Face
from zsdt.errors import DataError, OptionError
from zsdt.perception.segmentation import load_segmenter
from zsdt.perception.unet import UNetOptions
from zsdt.perception.unet_weights import unet_card
from zsdt.perception.vision_augment import Augmentation
from zsdt.perception.vision_data import LabelledImages, labelled
from zsdt.perception.vision_train import (
    VisionOptions,
    iou_against_images,
    iou_of,
    mean_iou,
    segmentation_loss,
    train_segmenter,
)

torch.set_num_threads(1)
TINY = {"crop": 64, "batch": 4, "network": UNetOptions([8, 8]), "held_out": 0.3, "check_every": 20}
MILD = Augmentation(
    scale_low=0.9, scale_high=1.1, permute=0.0, invert=0.0, contrast=0.1, brightness=0.05, tint=0.05, strangers=0.3
)


@pytest.fixture(scope="module")
def faces() -> LabelledImages:
    """Small pictures of bent faces, dark lines on light foam."""
    drawn = [
        Face(cells=(5, 3), pitch=20.0, clamp=(30.0 + 2 * k, 30.0), bend=0.1 + 0.1 * k, size=(160, 128))
        for k in range(6)
    ]
    paints = [face.coverage(width=5.0, cut=True) for face in drawn]
    return labelled((face.picture(paint), paint) for face, paint in zip(drawn, paints, strict=True))


def options(**changes: object) -> VisionOptions:
    return VisionOptions(**{**TINY, "augmentation": MILD, "steps": 80, "learning_rate": 1e-2, "seed": 1, **changes})


def test_it_learns_where_the_paint_is(faces, tmp_path):
    card = train_segmenter(faces, options(), tmp_path)
    assert card["iou_held_out"] > 0.75
    assert card["iou_held_out"] == pytest.approx(mean_iou(load_segmenter(tmp_path), faces.held_out(0.3, 1)[1]))
    stored = unet_card(tmp_path)
    assert stored["pictures"] == 4 and stored["options"]["steps"] == 80
    with (tmp_path / "training.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    assert [int(row["step"]) for row in rows] == [20, 40, 60, 80]
    assert float(rows[-1]["loss"]) < float(rows[0]["loss"])
    # Going on from weights starts where they are, and not anew.
    on = train_segmenter(faces, options(start=str(tmp_path), steps=2, learning_rate=1e-5), tmp_path / "on")
    assert on["iou_held_out"] == pytest.approx(card["iou_held_out"], abs=0.1)
    with pytest.raises(DataError, match="widths"):
        train_segmenter(faces, options(start=str(tmp_path), network=UNetOptions([8, 16])), tmp_path / "other")


def test_the_same_seed_gives_the_same_weights(faces, tmp_path):
    for name in ("a", "b"):
        train_segmenter(faces, options(steps=4), tmp_path / name)
    train_segmenter(faces, options(steps=4, seed=2), tmp_path / "c")
    a, b, c = ((tmp_path / name / "unet.pt").read_bytes() for name in "abc")
    first, second, third = (torch.load(tmp_path / name / "unet.pt", weights_only=True) for name in "abc")
    assert all(torch.equal(first[k], second[k]) for k in first) and a == b
    assert not all(torch.equal(first[k], third[k]) for k in first) and a != c


def test_iou_against_the_number_of_images(faces, tmp_path):
    rows = iou_against_images(faces, faces.pick([5]), [2, 4], options(steps=3), tmp_path)
    assert [row["images"] for row in rows] == [2, 4]
    assert all(0 <= row["iou_worst"] <= row["iou"] <= 1 for row in rows)
    assert (tmp_path / "iou_against_images.csv").is_file()
    with pytest.raises(DataError, match="there are 6"):
        iou_against_images(faces, faces, [10], options(), tmp_path)


def test_iou_of_a_shifted_bar_is_that_of_the_overlap():
    mask = np.zeros((20, 20), np.uint8)
    mask[5:15, 4:14] = 255
    seen = np.roll(mask, 5, axis=1) / np.float32(255)
    assert iou_of(seen, mask) == pytest.approx(50 / 150)
    assert iou_of(mask / np.float32(255), mask) == 1.0
    assert iou_of(np.zeros((20, 20), np.float32), np.zeros((20, 20), np.uint8)) == 1.0


def test_the_loss_is_small_only_for_the_truth():
    paint = (torch.rand(1, 1, 32, 32) > 0.8).float()
    right, wrong = segmentation_loss(20 * paint - 10, paint), segmentation_loss(10 - 20 * paint, paint)
    assert right < 0.01 < 1.0 < wrong


def test_options_refuse_nonsense():
    for changes, words in (
        ({"images": 0}, "Nothing to learn"),
        ({"steps": 0}, "steps"),
        ({"crop": 50}, "crop"),
        ({"held_out": 1.0}, "held_out"),
    ):
        with pytest.raises(OptionError, match=words):
            VisionOptions(**changes)
