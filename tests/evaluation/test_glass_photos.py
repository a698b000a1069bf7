"""Real photos through any weights, and the door by which a user's own photos come in."""

import pytest
import torch

from zsdt.evaluation.glass_photos import FRAME, fine_tune, judge_photos
from zsdt.files import data_root
from zsdt.interop.vessel_photos import FOLDER, read_vessel_photos
from zsdt.perception.glass_segmentation import OUTPUTS, GlassSegmenter
from zsdt.perception.glass_vision_data import no_glasses
from zsdt.perception.unet import UNet, UNetOptions
from zsdt.perception.unet_weights import save_unet, unet_card

pytestmark = pytest.mark.skipif(
    not (data_root() / FOLDER).is_dir() or not (data_root() / FRAME).is_file(),
    reason="the vessel photos are not at hand ($ZSDT_DATA)",
)
SMALL = UNetOptions([4, 8, 8])


@pytest.fixture
def weights(tmp_path):
    torch.manual_seed(0)
    save_unet(tmp_path / "weights", UNet(SMALL, OUTPUTS), SMALL, {"size": 64})
    return tmp_path / "weights"


def test_every_photo_has_a_row_and_unknown_liquid_stays_unknown(weights, tmp_path):
    rows, means = judge_photos(weights, tmp_path / "out", steps=0)
    assert len(rows) == 10 and 0 <= means[0]["container_iou_before"] <= 1
    by_name = {row["image"]: row for row in rows}
    assert by_name["IMG_5510"]["liquid_iou_before"] is None and by_name["IMG_2860"]["liquid_iou_before"] is not None
    for name in ("photos.md", "photos.csv", "photos_before.jpg"):
        assert (tmp_path / "out" / name).stat().st_size > 100
    assert not (tmp_path / "out" / "photos_after.jpg").exists()


def test_fine_tuning_goes_on_from_the_weights_it_is_given(weights, tmp_path):
    segmenter = fine_tune(weights, read_vessel_photos()[:3], no_glasses(), tmp_path / "tuned", steps=2)
    assert isinstance(segmenter, GlassSegmenter)
    card = unet_card(tmp_path / "tuned")
    assert card["options"]["start"] == weights.name and card["steps_done"] == 2
    assert (tmp_path / "tuned/unet.pt").read_bytes() != (weights / "unet.pt").read_bytes()
