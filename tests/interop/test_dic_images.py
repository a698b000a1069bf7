"""Real images of a specimen: the reader, its complaints, and tracking that agrees with the referee."""

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.evaluation.tracking_runs import follow_specimen
from zsdt.files import data_root
from zsdt.interop.dic_images import neighbour_edges, read_dic_images

have_images = pytest.mark.skipif(
    not (data_root() / "dic_images").is_dir(), reason="no data folder with dic_images beside the repository"
)


@have_images
def test_real_images_are_tracked_as_the_referee_does():
    series = read_dic_images()
    assert series.images.shape == (6, 1040, 400) and series.displacement.shape == (5, 230, 2)
    assert np.linalg.norm(series.displacement[-1], axis=1).max() > 5.0
    run, rows = follow_specimen(series)
    assert np.median(run.error[1:]) < 0.03
    assert all(row["median px"] < 0.05 and row["seen"] > 0.97 for row in rows)


def test_edges_of_a_lattice_with_a_hole():
    points = np.array([[x, y] for x in range(4) for y in range(3) if (x, y) != (1, 1)], float) * 35.0
    edges = neighbour_edges(points)
    assert len(edges) == 17 - 4
    assert np.allclose(np.abs(points[edges[:, 0]] - points[edges[:, 1]]).sum(axis=1), 35.0)


def test_missing_and_broken_files_are_named(tmp_path):
    with pytest.raises(DataError, match=r"oht_cfrp_00.tiff is missing"):
        read_dic_images(tmp_path)
    for step in range(6):
        cv2.imwrite(str(tmp_path / f"oht_cfrp_{step:02d}.tiff"), np.zeros((40, 30), np.uint8))
    (tmp_path / "gold").mkdir()
    (tmp_path / "gold" / "DICe_solution_01.txt").write_text("*** remark\nCOORDINATE_X,COORDINATE_Y\n1,2\n")
    with pytest.raises(DataError, match="DISPLACEMENT_X"):
        read_dic_images(tmp_path)
