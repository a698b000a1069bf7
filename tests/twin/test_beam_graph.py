"""From the grid in the picture to the body: extrusion, placement, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from tests.twin.beam_clips import FPS, camera_of, cell_clip, scene_of
from zsdt.errors import DataError, OptionError
from zsdt.perception.camera import Camera, ClampSide
from zsdt.perception.grid_graph import ClampChoice, GridGraph
from zsdt.twin.beam_graph import beam_body, build_beam_graph, front_nodes_of, moved, turn_about_y
from zsdt.twin.twin_scene import BeamTwinScene


def seen_by(camera, body, side):
    front = front_nodes_of(body, side)
    pixels = camera.project(body.points[front.ravel()]).reshape(*front.shape, 2)
    return GridGraph(pixels, np.ones(front.shape, bool), side, 40.0, 0.0, np.ones(1, bool))


@pytest.mark.parametrize("side", list(ClampSide))
def test_the_visible_face_is_where_the_camera_stands_and_comes_back_exactly(side):
    scene = scene_of(width=0.15)
    body = beam_body(8, 4, scene, FPS)
    camera = camera_of(0.35, 0.15, side)
    graph = build_beam_graph(seen_by(camera, body, side), camera, scene, FPS)
    face = graph.body.points[graph.front_nodes]
    assert np.allclose(face[..., 1], 0.0 if side is ClampSide.left else 0.15)
    np.testing.assert_allclose(graph.positions, face, atol=1e-9)
    np.testing.assert_allclose(graph.camera.project(body.points), camera.project(body.points), atol=1e-6)
    assert graph.body.nodes == 8 * 4 * 4 and graph.body.clamped.sum() == 4 * 4
    assert graph.body.mass.sum() == pytest.approx(scene.material.density * 0.35 * 0.15 * 0.15)


def test_a_camera_that_is_turned_shifted_and_too_near_does_not_deform_the_beam():
    scene = scene_of()
    body = beam_body(7, 3, scene, FPS)
    told = camera_of(0.3, 0.1)
    true = moved(told, turn_about_y(0.1), np.array([0.02, 0.0, -0.01]))
    true = replace(true, translation=true.translation + np.array([0.0, 0.0, 0.04]))
    graph = build_beam_graph(seen_by(true, body, ClampSide.left), told, scene, FPS)
    np.testing.assert_allclose(graph.positions, body.points[graph.front_nodes], atol=2e-4)
    assert graph.pitch == pytest.approx(0.05 / 1.04, rel=1e-3)
    assert graph.depth == pytest.approx(1.04, rel=1e-3)


def test_a_camera_without_a_pose_looks_straight_at_the_face():
    scene = scene_of()
    body = beam_body(7, 3, scene, FPS)
    posed = camera_of(0.3, 0.1, ClampSide.right)
    bare = Camera(posed.matrix, posed.distortion, np.eye(3), np.zeros(3), posed.width, posed.height)
    graph = build_beam_graph(seen_by(posed, body, ClampSide.right), bare, scene, FPS)
    np.testing.assert_allclose(graph.positions, body.points[graph.front_nodes], atol=1e-9)


def test_depth_maps_place_nodes_out_of_the_plane():
    scene = scene_of()
    body = beam_body(7, 3, scene, FPS)
    camera = camera_of(0.3, 0.1)
    front = front_nodes_of(body, ClampSide.left)
    bent = body.points[front].copy()
    bent[..., 1] += 0.3 * bent[..., 0] ** 2
    pixels = camera.project(bent.reshape(-1, 3)).reshape(*front.shape, 2)
    depth = np.full((480, 640), np.nan)
    row = np.clip(np.rint(pixels[..., 1]).astype(int), 0, 479)
    column = np.rint(pixels[..., 0]).astype(int)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            depth[row + down, column + right] = camera.depths(bent.reshape(-1, 3)).reshape(front.shape)
    grid = GridGraph(pixels, np.ones(front.shape, bool), ClampSide.left, 40.0, 0.0, np.ones(1, bool))
    graph = build_beam_graph(grid, camera, scene, FPS, depth)
    assert np.abs(graph.positions - bent).max() < 2e-3


def test_wrong_pitch_or_depth_is_named_with_the_mend():
    scene = scene_of()
    body = beam_body(7, 3, scene, FPS)
    camera = camera_of(0.3, 0.1)
    grid = seen_by(camera, body, ClampSide.left)
    with pytest.raises(DataError, match=r"measures 7\.50 cm at a depth of 1\.50 m.*1\.00 m"):
        build_beam_graph(grid, camera, replace(scene, depth=1.5), FPS)
    with pytest.raises(DataError, match="says 10 cm"):
        build_beam_graph(grid, camera, replace(scene, pitch=0.1), FPS)


def test_what_makes_no_beam_is_refused():
    scene = scene_of()
    with pytest.raises(DataError, match="2 columns"):
        beam_body(2, 3, scene, FPS)
    with pytest.raises(DataError, match="multiple of the cells"):
        beam_body(5, 3, replace(scene, width=0.12), FPS)
    with pytest.raises(OptionError, match="unknown field"):
        BeamTwinScene(fields=["von_mises", "temperature"])
    clip = cell_clip(frames=1)
    grid = clip.grid()
    with pytest.raises(DataError, match="clamped at the right"):
        build_beam_graph(grid, clip.camera, replace(scene, clamp_side=ClampChoice.right), FPS)
    hidden = grid.found.copy()
    hidden[0] = False
    with pytest.raises(DataError, match="clamped column"):
        build_beam_graph(replace(grid, found=hidden), clip.camera, scene, FPS)
    with pytest.raises(DataError, match="look along"):
        build_beam_graph(grid, camera_of(0.3, 0.1, ClampSide.right), scene, FPS)


def test_a_planar_graph_is_one_cell_wide():
    body = beam_body(9, 4, scene_of(width=0.3, one_layer=True, planar=True), FPS)
    assert np.ptp(body.points[:, 1]) == pytest.approx(0.05)
    assert body.nodes == 9 * 2 * 4
