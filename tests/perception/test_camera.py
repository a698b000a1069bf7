"""Projection and back-projection against closed forms."""

import json

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import Camera, ClampSide, load_camera, save_camera

DISTORTION = np.array([-0.15, 0.04, 0.0012, -0.0008, 0.01])


def tilted(distortion=DISTORTION) -> Camera:
    """A camera with distortion that looks at the beam askew."""
    side = ClampSide.left
    turn, nod = 0.2, -0.1
    yaw = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    pitch = np.array([[1, 0, 0], [0, np.cos(nod), -np.sin(nod)], [0, np.sin(nod), np.cos(nod)]])
    rotation = pitch @ yaw @ side.axes
    center = np.array([0.2, -1.0, 0.15])
    matrix = np.array([[820.0, 0, 470.0], [0, 835.0, 280.0], [0, 0, 1]])
    return Camera(matrix, distortion, rotation, -rotation @ center, 960, 540)


def picture_points() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 959, 25), np.linspace(0, 539, 15))
    return np.column_stack([u.ravel(), v.ravel()])


def test_a_facing_camera_projects_as_a_ruler_would() -> None:
    left = Camera.facing(distance=2.0, look_at=(0.3, 0.1), focal=800.0, beam_width=0.2, clamp_side="left")
    points = np.array([[0.3, 0.0, 0.1], [0.4, 0.0, 0.1], [0.3, 0.0, 0.2], [0.4, 2.0, 0.1]])
    # 0.1 m at 2 m are 40 px, at 4 m 20 px; up in the room is up in the picture.
    expected = np.array([479.5, 269.5]) + np.array([[0, 0], [40, 0], [0, -40], [20, 0]])
    np.testing.assert_allclose(left.project(points), expected, atol=1e-9)
    # From the other side the beam grows to the left, and its face y = width is the near one.
    right = Camera.facing(distance=2.0, look_at=(0.3, 0.1), focal=800.0, beam_width=0.2, clamp_side="right")
    points = np.array([[0.3, 0.2, 0.1], [0.4, 0.2, 0.1], [0.3, 0.2, 0.2], [0.4, -1.8, 0.1]])
    expected = np.array([479.5, 269.5]) + np.array([[0, 0], [-40, 0], [0, -40], [-20, 0]])
    np.testing.assert_allclose(right.project(points), expected, atol=1e-9)
    assert ClampSide.left.front_layer == "low_y" and ClampSide.right.front_layer == "high_y"
    assert np.linalg.det(right.rotation) == pytest.approx(1.0)


def test_distortion_is_that_of_brown_and_conrady() -> None:
    camera = tilted()
    point = camera.at_depth(np.array([[800.0, 100.0]]), 1.3)
    seen = camera.rotation @ point[0] + camera.translation
    x, y = seen[:2] / seen[2]
    k1, k2, p1, p2, k3 = DISTORTION
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    assert seen[2] == pytest.approx(1.3, abs=1e-12)
    np.testing.assert_allclose([820 * u + 470, 835 * v + 280], [800.0, 100.0], atol=1e-8)


def test_back_projection_undoes_projection() -> None:
    camera, pixels = tilted(), picture_points()
    depth = np.linspace(0.5, 3.0, len(pixels))
    points = camera.at_depth(pixels, depth)
    np.testing.assert_allclose(camera.depths(points), depth, rtol=1e-12)
    np.testing.assert_allclose(camera.project(points), pixels, atol=1e-7)
    on_plane = camera.on_plane(pixels, np.zeros(3), np.array([0.0, 1.0, 0.1]))
    np.testing.assert_allclose(on_plane @ [0.0, 1.0, 0.1], 0.0, atol=1e-12)
    np.testing.assert_allclose(camera.project(on_plane), pixels, atol=1e-7)


def test_constant_depth_and_plane_agree_only_for_a_facing_camera() -> None:
    pixels = picture_points()
    for side, front in ((ClampSide.left, 0.0), (ClampSide.right, 0.2)):
        facing = Camera.facing(
            distance=1.4, look_at=(0.3, 0.1), focal=900.0, beam_width=0.2, clamp_side=side, distortion=DISTORTION
        )
        plane = facing.on_plane(pixels, np.array([0.0, front, 0.0]), np.array([0.0, 1.0, 0.0]))
        np.testing.assert_allclose(facing.at_depth(pixels, 1.4), plane, atol=1e-9)
    askew = tilted()
    plane = askew.on_plane(pixels, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    assert np.abs(askew.at_depth(pixels, float(askew.depths(plane).mean())) - plane).max() > 0.02


def test_what_is_behind_the_camera_has_no_pixel() -> None:
    camera = tilted()
    points = np.stack([camera.center + camera.rotation[2], camera.center - camera.rotation[2]])
    pixels = camera.project(points)
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1]).all()
    away = camera.on_plane(pixels[:1], camera.center - camera.rotation[2], camera.rotation[2])
    assert np.isnan(away).all()
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)


def test_a_camera_comes_back_from_its_file(tmp_path) -> None:
    camera = tilted()
    save_camera(tmp_path / "camera.json", camera)
    again = load_camera(tmp_path / "camera.json")
    for name in ("matrix", "distortion", "rotation", "translation", "width", "height"):
        np.testing.assert_array_equal(getattr(again, name), getattr(camera, name))


@pytest.mark.parametrize(
    "content",
    ["", "[1, 2]", "{}", '{"schema": "other"}', '{"matrix": [[1]], "distortion": [], "width": 1, "height": 1}'],
)
def test_a_broken_camera_file_says_so(tmp_path, content) -> None:
    (tmp_path / "camera.json").write_text(content)
    with pytest.raises(DataError, match=r"camera"):
        load_camera(tmp_path / "camera.json")
    with pytest.raises(DataError, match="There is no camera file"):
        load_camera(tmp_path / "nowhere.json")


def test_a_mirror_is_no_camera(tmp_path) -> None:
    card = tilted().describe()
    card["rotation"] = (np.diag([1.0, 1.0, -1.0]) @ np.array(card["rotation"])).tolist()
    (tmp_path / "camera.json").write_text(json.dumps(card))
    with pytest.raises(DataError, match="right-handed"):
        load_camera(tmp_path / "camera.json")
    with pytest.raises(OptionError, match="matrix"):
        Camera(np.full((3, 3), np.nan), DISTORTION, np.eye(3), np.zeros(3), 10, 10)
