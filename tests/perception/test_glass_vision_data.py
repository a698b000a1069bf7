"""Labelled glasses from folders, and windows drawn from them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.perception.made_up_glass import GLASS, LIQUID, drawn, labelled
from zsdt.errors import DataError, OptionError
from zsdt.perception.glass_vision_augment import GlassAugmentation, random_window
from zsdt.perception.glass_vision_data import LabelledGlasses, read_glass_folder
from zsdt.perception.yolo_glass import polygons_of, write_yolo_dataset

IMAGE, CONTAINER, WET = drawn()
OFF = "search shift rotation stretch flip permute grey contrast gamma brightness tint blur motion noise texture"
PLAIN = GlassAugmentation(
    near_low=1.5,
    near_high=1.5,
    wide_high=1.5,
    jpeg=100,
    **dict.fromkeys([*OFF.split(), "occlude", "beside"], 0.0),  # type: ignore[arg-type]
)


def write(folder: Path, name: str, picture: np.ndarray) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name), picture)


def check(found: LabelledGlasses) -> None:
    assert (found.containers[0] > 127).sum() == CONTAINER.sum()
    assert (found.liquids[0] > 127).sum() == WET.sum()
    assert found.liquid_known[0]


def test_masks_of_class_numbers_masks_of_each_class_and_polygons_say_the_same(tmp_path):
    write(tmp_path / "a", "images/x.png", IMAGE)
    write(tmp_path / "a", "masks/x.png", (CONTAINER.astype(np.uint8) + WET))
    check(read_glass_folder(tmp_path / "a"))
    write(tmp_path / "b", "frames/x.png", IMAGE)
    write(tmp_path / "b", "frames/unlabelled.png", IMAGE)
    write(tmp_path / "b", "masks/x_container.png", 255 * CONTAINER.astype(np.uint8))
    write(tmp_path / "b", "masks/x_liquid.png", 255 * WET.astype(np.uint8))
    found = read_glass_folder(tmp_path / "b")
    assert len(found) == 1
    check(found)
    write(tmp_path / "c", "x.png", IMAGE)
    corners = {"container": (55, 25, 106, 110), "liquid": (55, 60, 106, 110)}
    notes = [
        {"image_id": 1, "category_id": k, "segmentation": [[left, top, right, top, right, low, left, low]]}
        for k, (left, top, right, low) in enumerate(corners.values())
    ]
    content = {
        "images": [{"id": 1, "file_name": "x.png"}],
        "categories": [{"id": k, "name": name} for k, name in enumerate(corners)],
        "annotations": notes,
    }
    (tmp_path / "c" / "labels.json").write_text(json.dumps(content))
    check(read_glass_folder(tmp_path / "c"))


def test_without_any_mask_of_liquid_its_place_is_unknown(tmp_path):
    write(tmp_path, "images/x.png", IMAGE)
    write(tmp_path, "masks/x_container.png", 255 * CONTAINER.astype(np.uint8))
    assert read_glass_folder(tmp_path).liquid_known == [False]


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "no masks/"),
        ({"images/x.png": IMAGE, "masks/y.png": CONTAINER.astype(np.uint8)}, "belongs to no picture"),
        ({"images/x.png": IMAGE, "masks/x.png": 200 * CONTAINER.astype(np.uint8)}, "class number"),
        ({"images/x.png": IMAGE, "masks/x.png": CONTAINER[:50].astype(np.uint8)}, "export both at one size"),
        ({"images/x.png": IMAGE, "masks/x.png": np.zeros(CONTAINER.shape, np.uint8)}, "No mask"),
        ({"masks/x.png": CONTAINER.astype(np.uint8)}, "neither images/ nor frames/"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(tmp_path, files, message):
    for name, picture in files.items():
        write(tmp_path, name, picture)
    with pytest.raises(DataError, match=message):
        read_glass_folder(tmp_path)


def test_a_plain_window_shows_the_glass_and_its_masks_agree_with_it():
    data = labelled(1)
    window, shares, counts = random_window(data, 0, 96, PLAIN, np.random.default_rng(0))
    colours = (window + 0.5) * 255
    assert np.abs(colours[shares[1] == 1].mean(axis=0) - LIQUID).max() < 5
    assert np.abs(colours[(shares[0] == 1) & (shares[1] == 0)].mean(axis=0) - GLASS).max() < 5
    assert (shares[1] <= shares[0]).all()
    assert 0 < counts.mean() < 1  # the lower part of the window lies beyond the picture


def test_windows_vary_stay_in_range_and_repeat_with_their_seed():
    data = labelled(4)
    options = GlassAugmentation(occlude=1.0, beside=1.0)
    for seed in range(8):
        window, shares, counts = random_window(data, seed % 4, 64, options, np.random.default_rng(seed))
        assert window.shape == (64, 64, 3) and np.abs(window).max() <= 0.5
        assert (shares[1] <= shares[0] + 0.02).all() and set(np.unique(counts)) <= {0.0, 1.0}
        again = random_window(data, seed % 4, 64, options, np.random.default_rng(seed))
        np.testing.assert_array_equal(window, again[0])
    with pytest.raises(OptionError):
        GlassAugmentation(near_low=3.0)


def test_the_data_set_for_yolo_holds_outlines_of_both_classes(tmp_path):
    data = labelled(3)
    listing = write_yolo_dataset(data.pick([0, 1]), data.pick([2]), tmp_path)
    lines = (tmp_path / "labels/train/00000.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1"]
    assert "container" in listing.read_text()
    polygon = polygons_of(data.containers[0])[0] * (160, 120)
    area = cv2.contourArea(polygon.astype(np.float32))
    assert area == pytest.approx((data.containers[0] > 127).sum(), rel=0.05)
    with pytest.raises(DataError, match="liquid labelled"):
        write_yolo_dataset(labelled(2, known=False), data, tmp_path)
