"""Training on plain pictures: it learns them, goes on where it was interrupted, learns only what was labelled."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.perception.made_up_glass import labelled
from zsdt.errors import DataError, OptionError
from zsdt.perception.glass_segmentation import load_glass_segmenter
from zsdt.perception.glass_vision_augment import GlassAugmentation
from zsdt.perception.glass_vision_score import level_errors, mean_ious, top_edge
from zsdt.perception.glass_vision_train import GlassVisionOptions, glass_loss, train_glass_segmenter
from zsdt.perception.unet import UNetOptions

torch.set_num_threads(1)
TINY = GlassVisionOptions(
    images=1, steps=60, size=64, batch=4, check_every=30, held_out=0.3, mixed=False, learning_rate=1e-2,
    network=UNetOptions([6, 12, 16]), augmentation=GlassAugmentation(permute=0.0, grey=0.0, occlude=0.0, wide_high=2.0),
)  # fmt: skip


def test_it_learns_plain_glasses_and_says_so_on_its_card(tmp_path):
    card = train_glass_segmenter([labelled(6)], replace(TINY, steps=120), tmp_path)
    assert card["finished"] and card["steps_done"] == 120
    assert card["container_iou_held_out"] > 0.85 and card["liquid_iou_held_out"] > 0.85
    assert (tmp_path / "training.csv").is_file()
    container, liquid = mean_ious(load_glass_segmenter(tmp_path), labelled(3))
    assert min(container, liquid) > 0.85


def test_an_interrupted_training_goes_on_to_the_same_weights(tmp_path):
    data = [labelled(4)]
    whole = train_glass_segmenter(data, TINY, tmp_path / "whole")
    first = train_glass_segmenter(data, TINY, tmp_path / "parts", tmp_path / "scratch", minutes=0.0)
    assert whole["finished"] and not first["finished"] and first["steps_done"] == 30
    second = train_glass_segmenter(data, TINY, tmp_path / "parts", tmp_path / "scratch")
    assert second["finished"]
    assert (tmp_path / "whole/unet.pt").read_bytes() == (tmp_path / "parts/unet.pt").read_bytes()
    with pytest.raises(DataError, match="other options"):
        train_glass_segmenter(data, replace(TINY, seed=1), tmp_path / "parts", tmp_path / "scratch")


def test_what_does_not_count_has_no_gradient():
    logit = torch.randn(2, 2, 8, 8, requires_grad=True)
    count = torch.ones(2, 2, 8, 8)
    count[:, 1] = 0  # liquid unknown
    count[0, 0, :4] = 0  # beyond the picture
    glass_loss(logit, torch.rand(2, 2, 8, 8).round(), count, 2 * count).backward()
    assert logit.grad is not None
    assert logit.grad[:, 1].abs().max() == 0 and logit.grad[0, 0, :4].abs().max() == 0
    assert logit.grad[0, 0, 4:].abs().min() > 0


def test_pictures_without_liquid_labels_train_the_container_alone(tmp_path):
    card = train_glass_segmenter([labelled(3, known=False)], replace(TINY, steps=10, check_every=10), tmp_path)
    assert np.isnan(card["liquid_iou_held_out"]) and card["container_iou_held_out"] >= 0


def test_nothing_to_learn_from_is_an_error(tmp_path):
    with pytest.raises(OptionError, match="Nothing to learn"):
        GlassVisionOptions(images=0)
    with pytest.raises(DataError, match="no labelled pictures"):
        train_glass_segmenter([], TINY, tmp_path)


@pytest.mark.parametrize("level", [20.0, 20.3, 20.75])
def test_the_level_is_read_between_the_pixels(level):
    """A pixel's share of liquid tells where in it the surface runs (row centres at integers)."""
    rows = np.arange(64)[:, None] + np.zeros((1, 40))
    share = np.clip(rows + 0.5 - level, 0, 1).astype(np.float32)
    np.testing.assert_allclose(top_edge(share), level, atol=0.51)
    blurred = (1 / (1 + np.exp(-(rows - level) / 1.5))).astype(np.float32)
    np.testing.assert_allclose(top_edge(blurred), level, atol=0.02)


def test_errors_of_the_level_know_their_sign_and_leave_out_the_sides():
    truth, seen = np.zeros((60, 50), np.float32), np.zeros((60, 50), np.float32)
    truth[30:50, 5:45], seen[32:50, 5:45] = 1, 1
    errors = level_errors(seen, truth)
    np.testing.assert_allclose(errors, 2)
    assert 30 <= len(errors) < 40
    assert len(level_errors(seen, np.zeros_like(truth))) == 0
