"""The judge of vision: a perfect eye scores full marks, a blind one none, and a wrong one is found out."""

import json
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from tests.perception.painted_grid import Face
from zsdt.errors import DataError
from zsdt.evaluation.vision_judge import in_order, match_nodes
from zsdt.evaluation.vision_report import judge_vision
from zsdt.perception.camera import ClampSide
from zsdt.perception.grid_graph import ClampChoice, GridOptions, extract_grid

cv2.setNumThreads(1)


@dataclass(frozen=True)
class Still:
    """What `zsdt.lab.stills.Still` looks like to the judge."""

    image: np.ndarray
    grid_mask: np.ndarray
    node_pixels: np.ndarray
    clamp_side: ClampSide


def still(face: Face, clamp_block: bool = True) -> Still:
    paint = face.coverage(cut=True)
    side = ClampSide.right if face.mirrored else ClampSide.left
    return Still(face.picture(paint, clamp_block), np.rint(255 * paint).astype(np.uint8), face.nodes, side)


class Eye:
    """Sees in a picture what it was told beforehand."""

    def __init__(self, stills, what=lambda mask: mask.astype(np.float32) / 255):
        self.known = {s.image.tobytes(): what(s.grid_mask) for s in stills}

    def probability(self, image):
        return self.known[image.tobytes()]


@pytest.fixture(scope="module")
def stills():
    small = {"cells": (7, 3), "pitch": 30.0, "clamp": (90.0, 100.0), "size": (400, 300)}
    return [
        still(Face(bend=0.4, **small)),
        still(Face(bend=0.5, mirrored=True, **small)),
        still(Face(bend=1e-6, **small), clamp_block=False),
    ]


def test_a_perfect_eye_finds_every_node(stills, tmp_path):
    table = judge_vision(Eye(stills), stills, tmp_path)
    summary = table.summary
    assert summary["iou"] == summary["node_precision"] == summary["node_recall"] == 1.0
    assert summary["iou_of_face"] > 0.99
    assert summary["error_px_median"] < 0.3 and summary["in_order"] == 3 and summary["no_grid"] == 0
    assert [row["clamp"] for row in table.rows] == ["right", "right", "asked"]  # the straight one has no clamp in sight
    assert json.loads((tmp_path / "vision.json").read_text())["images"] == 3
    assert "node_recall" in (tmp_path / "vision.md").read_text()
    for name in ("worst", "typical"):
        assert cv2.imread(str(tmp_path / f"{name}.png")).shape == (3 * 300, 800, 3)


def test_a_blind_eye_is_told_so(stills, tmp_path):
    table = judge_vision(Eye(stills, lambda mask: np.zeros(mask.shape, np.float32)), stills, tmp_path)
    assert table.summary["node_recall"] == 0.0 and table.summary["no_grid"] == 3 and table.summary["iou"] == 0.0
    assert all("No paint" in row["failure"] for row in table.rows)


def test_what_is_erased_lowers_recall_but_not_precision(stills):
    def erased(mask):
        seen = mask.astype(np.float32) / 255
        seen[:, 195:225] = 0
        return seen

    summary = judge_vision(Eye(stills[:1], erased), stills[:1]).summary
    assert 0.6 < summary["node_recall"] < 0.95
    assert summary["node_precision"] == 1.0 and summary["in_order"] == 1


def test_matching_is_one_to_one_and_near():
    truth = Face(cells=(4, 2)).nodes
    seen = truth + np.array([3.0, 4.0])
    found = np.ones(truth.shape[:2], bool)
    found[2, 1] = False
    errors, number = match_nodes(seen, found, truth)
    assert number == truth.shape[0] * truth.shape[1] - 1 == len(errors)
    np.testing.assert_allclose(errors, 5.0)
    errors, _ = match_nodes(truth + np.array([11.0, 0.0]), found, truth)  # farther than a quarter of 40 px
    assert len(errors) == 0


def test_a_grid_from_the_wrong_end_is_out_of_order():
    face = Face(cells=(5, 2))
    paint = face.coverage()
    right = extract_grid(paint, None, GridOptions(clamp_side=ClampChoice.left))
    wrong = extract_grid(paint, None, GridOptions(clamp_side=ClampChoice.right))
    assert in_order(right, face.nodes) and not in_order(wrong, face.nodes)
    assert not in_order(right, face.nodes[1:])


def test_without_pictures_there_is_no_verdict():
    with pytest.raises(DataError, match="no pictures"):
        judge_vision(Eye([]), [])
