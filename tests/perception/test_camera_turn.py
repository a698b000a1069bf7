"""What moved, the glass or the camera: a textured room tells, by pixels that are known here."""

import cv2
import numpy as np
import pytest

from zsdt.perception.camera_turn import CameraTurn
from zsdt.perception.glass_window import Box

SIZE = (400, 640)
GLASS = Box(280, 120, 380, 330)


def room(seed=0):
    """A background with structure of all sizes."""
    rng = np.random.default_rng(seed)
    whole = sum(
        cv2.resize(rng.normal(0.0, 1.0, (SIZE[0] // k, SIZE[1] // k)), SIZE[::-1], interpolation=cv2.INTER_CUBIC) * k
        for k in (4, 16, 50)
    )
    grey = np.clip(120.0 + 50.0 * whole / whole.std(), 0, 255)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def picture(background, move=0.0, turn=(0.0, 0.0), seed=0):
    """The glass `move` px to the right of where it was, seen by a camera that has turned by `turn` px; with noise."""
    image = background.copy()
    left = GLASS.left + round(move)
    image[GLASS.top : GLASS.bottom, left : left + GLASS.right - GLASS.left] = (200, 190, 180)
    image[220 : GLASS.bottom, left + 6 : left + GLASS.right - GLASS.left - 6] = (90, 120, 160)
    shift = np.array([[1.0, 0.0, turn[0]], [0.0, 1.0, turn[1]]])
    image = cv2.warpAffine(image, shift, SIZE[::-1], borderMode=cv2.BORDER_REPLICATE)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    u, v = round(move + turn[0]), round(turn[1])
    box = Box(max(GLASS.left + u, 0), GLASS.top + v, min(GLASS.right + u, SIZE[1]), GLASS.bottom + v)
    return np.clip(image + noise, 0, 255).astype(np.uint8), box


@pytest.mark.parametrize("turn", [(5.0, 0.0), (-37.0, 4.0), (140.0, -6.0), (-320.0, 0.0)])
def test_a_turned_camera_is_told_to_half_a_pixel(turn):
    background, found = room(), CameraTurn()
    assert not found.update(*picture(background)).any()
    np.testing.assert_allclose(found.update(*picture(background, turn=turn, seed=1)), turn, atol=0.5)
    np.testing.assert_allclose(found.update(*picture(background, turn=(0.0, 0.0), seed=2)), 0.0, atol=0.5)


def test_a_glass_that_moves_before_a_room_that_stays_is_no_turn():
    background, found = room(), CameraTurn()
    for k, move in enumerate((0.0, 3.0, 12.0, 60.0, 200.0)):
        assert not found.update(*picture(background, move, seed=k)).any()
    np.testing.assert_allclose(found.update(*picture(background, 60.0, (25.0, 0.0), 9)), (25.0, 0.0), atol=0.5)


def test_a_plain_wall_and_another_room_tell_nothing():
    plain, found = np.full((*SIZE, 3), 140, np.uint8), CameraTurn()
    found.update(*picture(plain))
    assert not found.update(*picture(plain, turn=(30.0, 0.0), seed=1)).any()
    found = CameraTurn()
    found.update(*picture(room(0)))
    assert not found.update(*picture(room(1), turn=(30.0, 0.0), seed=1)).any()


def test_less_than_a_pixel_is_the_trembling_of_any_camera():
    background, found = room(), CameraTurn()
    found.update(*picture(background))
    assert not found.update(*picture(background, turn=(0.6, -0.4), seed=1)).any()
