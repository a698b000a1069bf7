"""Outlines become masks, and real photos a folder to train on."""

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.files import data_root
from zsdt.interop.vessel_photos import FOLDER, filled, read_vessel_photos, write_training_folder
from zsdt.perception.glass_vision_data import read_glass_folder


def test_an_outline_with_a_small_gap_is_filled_and_an_open_one_refused():
    line = np.zeros((60, 50), np.uint8)
    cv2.rectangle(line, (10, 5), (39, 49), 1, 1)
    assert (filled(line > 0, "x") > 0).sum() == 30 * 45
    line[20:22, 10] = 0
    assert (filled(line > 0, "x") > 0).sum() == pytest.approx(30 * 45, rel=0.02)
    line[:, 10] = 0
    with pytest.raises(DataError, match="not closed"):
        filled(line > 0, "x")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DataError, match="no outlines"):
        read_vessel_photos(tmp_path)
    cv2.imwrite(str(tmp_path / "a_BORDERS.tif"), np.zeros((20, 20), np.uint8))
    with pytest.raises(DataError, match="missing or broken"):
        read_vessel_photos(tmp_path)


@pytest.mark.skipif(not (data_root() / FOLDER).is_dir(), reason="the vessel photos are not at hand ($ZSDT_DATA)")
def test_the_photos_become_a_folder_that_training_reads(tmp_path):
    photos = read_vessel_photos()
    assert len(photos) == 9 and all(photo.image.shape[:2] == photo.container.shape for photo in photos)
    assert all(0.05 < (photo.container > 0).mean() < 0.7 for photo in photos)
    write_training_folder(photos, tmp_path)
    data = read_glass_folder(tmp_path)
    assert len(data) == 8 and all(data.liquid_known)
    wet = [(a > 0).sum() / (b > 0).sum() for a, b in zip(data.liquids, data.containers, strict=True)]
    assert all(0.05 < share < 0.8 for share in wet)
