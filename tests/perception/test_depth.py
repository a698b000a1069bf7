"""Depth maps replace the constant depth where they have a value."""

import cv2
import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.perception.camera import Camera
from zsdt.perception.depth import DepthOptions, look_up, open_depth_maps, read_depth_map


def test_depth_is_read_between_pixels_and_missing_areas_fall_back_to_the_constant() -> None:
    v, u = np.indices((40, 60))
    depth_map = 1.0 + 0.002 * u + 0.003 * v
    depth_map[10, 20] = np.nan  # a pixel
    depth_map[24:33, 24:33] = 0.0  # an area
    pixels = np.array([[5.5, 7.25], [20.0, 10.0], [59.0, 39.0], [28.0, 28.0], [-3.0, 5.0], [np.nan, 3.0]])
    result = look_up(depth_map, pixels, 2.5)
    expected = 1.0 + 0.002 * pixels[:3, 0] + 0.003 * pixels[:3, 1]
    np.testing.assert_allclose(result.depth[:3], expected, rtol=1e-5)  # one missing pixel is bridged
    np.testing.assert_array_equal(result.depth[3:], 2.5)
    assert result.missing == 3
    assert look_up(None, pixels, 2.5).missing == len(pixels)
    assert look_up(depth_map, pixels[:1], 2.5, DepthOptions(furthest=1.01)).missing == 1


def test_a_node_on_the_edge_of_the_beam_gets_the_depth_of_the_beam() -> None:
    u = np.indices((40, 60))[1]
    sloped = 1.0 + 0.002 * u
    depth_map = np.where(u < 30, sloped, 1.4)  # the wall behind
    pixels = np.array([[29.0, 20.0], [29.4, 20.3], [29.9, 11.5], [30.3, 20.0]])
    found, expected = look_up(depth_map, pixels, 9.0).depth, 1.0 + 0.002 * pixels[:, 0]
    np.testing.assert_allclose(found[:2], expected[:2], atol=2e-4)
    np.testing.assert_allclose(found[2:], expected[2:], atol=3e-3)  # one column of the beam fixes no slope across it
    assert look_up(depth_map, np.array([[33.0, 20.0]]), 9.0).depth[0] == 1.4


def test_a_depth_map_sees_a_beam_that_leaves_its_plane() -> None:
    camera = Camera.facing(distance=1.0, look_at=(0.3, 0.1), focal=500.0, beam_width=0.2, size=(320, 200))
    points = np.array([[0.25, 0.0, 0.1], [0.3, 0.06, 0.12], [0.35, -0.05, 0.05]])
    pixels = camera.project(points)
    depth_map = np.full((200, 320), np.nan)
    for point, pixel in zip(points, pixels, strict=True):
        u, v = np.rint(pixel).astype(int)
        depth_map[v - 2 : v + 3, u - 2 : u + 3] = camera.depths(point[None])[0]
    found = camera.at_depth(pixels, look_up(depth_map, pixels, 1.0).depth)
    np.testing.assert_allclose(found, points, atol=1e-9)
    assert np.abs(camera.at_depth(pixels, 1.0) - points).max() > 0.04


def test_maps_are_read_in_metres(tmp_path) -> None:
    values = np.array([[0.5, 0.0], [np.nan, 2.0]])
    np.save(tmp_path / "0.npy", values)
    cv2.imwrite(str(tmp_path / "1.png"), np.nan_to_num(values * 1000).astype(np.uint16))
    maps = open_depth_maps(DepthOptions(folder=str(tmp_path)))
    assert maps is not None and len(maps) == 2
    expected = np.array([[0.5, np.nan], [np.nan, 2.0]])
    np.testing.assert_allclose(maps.frame(0), expected)
    np.testing.assert_allclose(maps.frame(1), expected)
    assert maps.frame(2) is None
    assert open_depth_maps(DepthOptions()) is None


def test_broken_maps_say_so(tmp_path) -> None:
    (tmp_path / "broken.npy").write_bytes(b"no array")
    np.save(tmp_path / "cube.npy", np.zeros((2, 2, 2)))
    cv2.imwrite(str(tmp_path / "eight_bits.png"), np.zeros((4, 4), np.uint8))
    for name, message in (("broken.npy", "broken"), ("cube.npy", "one number"), ("eight_bits.png", "16 bits")):
        with pytest.raises(DataError, match=message):
            read_depth_map(tmp_path / name)
    with pytest.raises(DataError, match="There is no depth map"):
        read_depth_map(tmp_path / "nowhere.npy")
    with pytest.raises(DataError, match="holds no depth maps"):
        open_depth_maps(DepthOptions(folder=str(tmp_path / "nowhere")))
