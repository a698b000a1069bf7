"""Calibration finds the camera that rendered the boards."""

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.perception.calibration import BoardKind, BoardOptions, calibrate, calibrate_folder, charuco_board
from zsdt.perception.camera import Camera

SIZE = (640, 400)
TRUE = Camera(
    np.array([[610.0, 0, 325.0], [0, 613.0, 196.0], [0, 0, 1]]),
    np.array([-0.11, 0.03, 0.0005, -0.0004, 0.0]),
    np.eye(3),
    np.zeros(3),
    *SIZE,
)
SCALE = 2000.0  # pixels of the printed board per m


def printed(board: BoardOptions) -> np.ndarray:
    """The board as a picture, without a border."""
    cell = round(board.square * SCALE)
    if board.kind is BoardKind.charuco:
        return charuco_board(board).generateImage((board.columns * cell, board.rows * cell))
    squares = np.indices((board.rows, board.columns)).sum(axis=0) % 2
    return np.kron(255 * squares, np.ones((cell, cell))).astype(np.uint8)


@pytest.fixture(scope="module")
def rays() -> np.ndarray:
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    flat = TRUE.normalise(np.column_stack([u.ravel(), v.ravel()]))
    return np.column_stack([flat, np.ones(len(flat))])


def photograph(board: BoardOptions, rays: np.ndarray, turn, place) -> np.ndarray:
    """The board as the true camera sees it: each pixel's ray cut with the plane of the board."""
    rotation = cv2.Rodrigues(np.asarray(turn, float))[0]
    middle = 0.5 * board.square * np.array([board.columns, board.rows, 0])
    shift = np.asarray(place, float) - rotation @ middle
    directions = rays @ rotation
    origin = -rotation.T @ shift
    points = origin + directions * (-origin[2] / directions[:, 2])[:, None]
    places = (points[:, :2] * SCALE - 0.5).astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
    sharp = cv2.remap(printed(board), places[..., 0], places[..., 1], cv2.INTER_AREA, borderValue=235)
    noisy = cv2.GaussianBlur(sharp, (0, 0), 0.8) * 0.8 + np.random.default_rng(0).normal(20, 1.5, sharp.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


VIEWS = [
    ([0.5, 0.0, 0.05], [0.0, 0.0, 0.33]),
    ([-0.5, 0.1, 0.0], [0.02, 0.01, 0.35]),
    ([0.0, 0.55, 0.1], [-0.03, 0.0, 0.34]),
    ([0.1, -0.55, 0.0], [0.03, -0.01, 0.34]),
    ([0.4, 0.4, 0.2], [0.04, 0.02, 0.38]),
    ([-0.35, 0.4, -0.2], [-0.05, -0.02, 0.38]),
    ([0.0, 0.1, 1.5], [0.0, 0.0, 0.4]),
]


@pytest.mark.parametrize("kind", list(BoardKind))
def test_the_camera_is_found_again(kind, rays) -> None:
    board = BoardOptions(kind=kind)
    pictures = [photograph(board, rays, *view) for view in VIEWS]
    empty = np.full((SIZE[1], SIZE[0]), 128, np.uint8)
    result = calibrate([*pictures, empty], board, [*(f"view {k}" for k in range(len(VIEWS))), "wall"])
    found = result.camera.matrix
    np.testing.assert_allclose(np.diag(found)[:2], np.diag(TRUE.matrix)[:2], rtol=0.005)
    np.testing.assert_allclose(found[:2, 2], TRUE.matrix[:2, 2], atol=4.0)
    assert result.rms_px < 0.3 and result.focal_std_px < 3.0
    assert list(result.rejected) == ["wall"] and len(result.used) == len(VIEWS)
    # What counts in the end: rays through the whole picture.
    pixels = np.array([[10.0, 10.0], [630.0, 10.0], [10.0, 390.0], [630.0, 390.0], [320.0, 200.0]])
    assert np.abs(result.camera.normalise(pixels) - TRUE.normalise(pixels)).max() * 610 < 4.0


def test_too_few_pictures_and_broken_ones_are_named(tmp_path, rays) -> None:
    board = BoardOptions()
    for k, view in enumerate(VIEWS[:4]):
        cv2.imwrite(str(tmp_path / f"photo_{k}.png"), photograph(board, rays, *view))
    (tmp_path / "torn.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"at least 6 pictures and found it in 4 of 4.*torn\.png"):
        calibrate_folder(tmp_path, board)
    with pytest.raises(DataError, match="There is no folder"):
        calibrate_folder(tmp_path / "nowhere", board)
    (tmp_path / "bare").mkdir()
    with pytest.raises(DataError, match="holds no pictures"):
        calibrate_folder(tmp_path / "bare", board)


def test_boards_that_all_face_the_camera_fix_no_focal_length(rays) -> None:
    board = BoardOptions(kind=BoardKind.chessboard)
    straight = [([0.0, 0.0, 0.01 * k], [0.002 * k, 0.0, 0.33]) for k in range(6)]
    with pytest.raises(DataError, match="tilt the board"):
        calibrate([photograph(board, rays, *view) for view in straight], board)


def test_impossible_boards_are_refused() -> None:
    with pytest.raises(OptionError, match="smaller than its square"):
        BoardOptions(marker=0.03)
    with pytest.raises(OptionError, match="dictionary"):
        BoardOptions(dictionary="DICT_UNHEARD_OF")
