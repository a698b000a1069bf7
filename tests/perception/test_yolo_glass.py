"""YOLO behind the same interface: a clear message where its packages are absent, the same masks where they are not."""

import importlib.util
import json

import numpy as np
import pytest

from tests.perception.made_up_glass import labelled
from zsdt.errors import DataError, OptionError
from zsdt.perception.glass_segmentation import YOLO_CARD, load_glass_segmenter
from zsdt.perception.yolo_glass import YoloOptions, train_yolo

AT_HAND = importlib.util.find_spec("ultralytics") is not None and importlib.util.find_spec("torchvision") is not None


@pytest.mark.skipif(AT_HAND, reason="ultralytics is installed")
def test_without_its_packages_it_says_what_to_install(tmp_path):
    (tmp_path / YOLO_CARD).write_text(json.dumps({"size": 768, "confidence": 0.25}))
    (tmp_path / "yolo.pt").write_bytes(b"x")
    with pytest.raises(OptionError, match="pip install zsdt"):
        load_glass_segmenter(tmp_path)
    with pytest.raises(OptionError, match="AGPL"):
        train_yolo(labelled(2), YoloOptions(), tmp_path, tmp_path)


def test_a_folder_without_weights_is_named(tmp_path):
    (tmp_path / YOLO_CARD).write_text("{}")
    with pytest.raises(DataError, match="No trained YOLO"):
        load_glass_segmenter(tmp_path)
    with pytest.raises(OptionError, match="multiple of 32"):
        YoloOptions(size=100)


@pytest.mark.skipif(not AT_HAND, reason="ultralytics and torchvision are not installed (extra yolo)")
def test_it_trains_and_segments_behind_the_same_interface(tmp_path):
    options = YoloOptions(model="yolo11n-seg.yaml", epochs=1, size=64, batch=2, held_out=0.3)
    card = train_yolo(labelled(4), options, tmp_path / "weights", tmp_path / "scratch")
    assert card["kind"] == "yolo_seg"
    masks = load_glass_segmenter(tmp_path / "weights").masks(labelled(1).images[0])
    assert masks.container.shape == (120, 160) and (masks.liquid <= masks.container).all()
    assert masks.container.dtype == np.float32
