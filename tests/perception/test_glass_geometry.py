"""A glass from its silhouette: exact masks of known glasses give their cavities back; bias is there and is removed."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from zsdt.errors import DataError
from zsdt.evaluation.glass_scenes import GlassScene, masks, side_camera
from zsdt.fluid.families import draw_shape
from zsdt.fluid.vessel import Vessel
from zsdt.perception.camera import Camera
from zsdt.perception.free_surface import observe_surface
from zsdt.perception.glass_geometry import ToldGlass, axis_of, fit_vessel
from zsdt.perception.glass_pose import turned_camera
from zsdt.perception.mask_edges import MaskEdges, read_edges
from zsdt.scene import VesselFamily, VesselShape

FILL = 0.05
CAMERA = side_camera(distortion=np.array([-0.05, 0.0, 0.0, 0.0, 0.0]))


@lru_cache
def seen(family: VesselFamily) -> tuple[VesselShape, GlassScene, MaskEdges]:
    """A glass of the family off the middle of the picture, its surface askew."""
    shape = draw_shape(family, 0.035, FILL, 0.05, np.random.default_rng(2))
    scene = GlassScene(shape, np.array([FILL, 0.12, -0.6]), CAMERA, x=0.02)
    return shape, scene, read_edges(*masks(scene))


def told_of(shape: VesselShape) -> ToldGlass:
    return ToldGlass(wall=0.002, floor=0.006, aspect=shape.aspect, exponent=shape.exponent, foot_edge=0.0)


@pytest.mark.parametrize("family", list(VesselFamily))
def test_cavity_axis_and_surface_are_recovered(family: VesselFamily) -> None:
    shape, scene, edges = seen(family)
    fit = fit_vessel([edges], CAMERA, told_of(shape))
    heights = np.linspace(0.012, 0.09, 14)
    found, true = Vessel(fit.shape), Vessel(shape)
    assert abs(fit.x - scene.x) < 1e-4
    assert np.abs(np.asarray(found.radius(heights)) - np.asarray(true.radius(heights))).max() < 6e-4
    assert abs(found.volume(FILL) / true.volume(FILL) - 1) < 0.02
    assert abs(fit.shape.rim - shape.rim) < 1e-3 and fit.shape.is_round == shape.is_round
    profile = observe_surface(edges, fit, fit.x)
    across = np.linspace(-0.8, 0.8, 17) * profile.scale
    assert np.abs(profile.at(across) - scene.height(across)).max() < 0.02 * FILL


def test_the_silhouette_of_a_slope_is_not_its_profile() -> None:
    """What a silhouette says without the correction is off by more than what is left after it, several times."""
    shape, scene, edges = seen(VesselFamily.tumbler)
    fit = fit_vessel([edges], CAMERA, told_of(shape))
    row = len(edges.rows) // 2
    middle = edges.rows[np.isfinite(edges.left)]
    row = int(np.flatnonzero(edges.rows == middle[len(middle) // 2])[0])
    straight = CAMERA.on_plane(
        np.array([[edges.left[row], edges.rows[row]], [edges.right[row], edges.rows[row]]]),
        np.zeros(3),
        np.array([0.0, 1.0, 0.0]),
    )
    height = straight[:, 2].mean() - scene.floor
    naive = 0.5 * (straight[1, 0] - straight[0, 0]) - 0.002
    true = float(np.interp(height, shape.heights, shape.radii))
    ours = float(np.interp(height, fit.shape.heights, fit.shape.radii))
    assert abs(naive - true) > 1.5e-4 and abs(ours - true) < 5e-5


def test_a_camera_told_askew_is_mended_by_foot_and_rim() -> None:
    shape, scene, edges = seen(VesselFamily.cylinder)
    askew = turned_camera(CAMERA, 0.006, -0.006, 0.0)
    fit = fit_vessel([edges], askew, told_of(shape))
    assert abs(fit.notes["roll"] - 0.006) < 0.002
    across = np.linspace(-0.8, 0.8, 17) * 0.035
    mended = observe_surface(edges, fit, axis_of(edges, fit.camera)).at(across) - scene.height(across)
    assert np.abs(mended).max() < 0.03 * FILL  # 6 mrad are 3 mm at half a metre, 6 % of the fill


def test_glasses_that_are_cut_off_or_missing_are_refused() -> None:
    nothing = np.zeros((400, 640), np.uint8)
    with pytest.raises(DataError, match="whole glass"):
        fit_vessel([read_edges(nothing, nothing)], CAMERA, ToldGlass(foot_edge=0.0))
    shape, scene, _ = seen(VesselFamily.cylinder)
    left = masks(GlassScene(shape, scene.surface, CAMERA, x=-0.14))
    with pytest.raises(DataError, match="whole glass"):
        fit_vessel([read_edges(*left)], CAMERA, ToldGlass(foot_edge=0.0))
    with pytest.raises(DataError, match="thicker"):
        fit_vessel([seen(VesselFamily.cylinder)[2]], CAMERA, ToldGlass(wall=0.05))


def test_an_outline_that_does_not_stand_on_the_table_is_refused() -> None:
    shape, scene, _ = seen(VesselFamily.cylinder)
    glass, liquid = (mask.copy() for mask in masks(scene))
    foot = int(np.flatnonzero(glass.max(axis=1))[-1])
    glass[foot - 70 :] = liquid[foot - 70 :] = 0  # somebody stands a book in front of it
    with pytest.raises(DataError, match="table"):
        fit_vessel([read_edges(glass, liquid)], CAMERA, told_of(shape))


def test_pictures_elsewhere_tell_the_shape_though_not_the_size() -> None:
    """A glass carried askew was farther away before: a hundredth of the distance is three of the volume."""
    shape, scene, edges = seen(VesselFamily.tumbler)
    far = replace(scene, camera=moved_back(CAMERA, 0.01), x=-0.03)
    before = read_edges(*masks(far))
    fit = fit_vessel([before, before, edges, edges, edges, edges], CAMERA, told_of(shape))
    assert abs(Vessel(fit.shape).volume(FILL) / Vessel(shape).volume(FILL) - 1) < 0.01 and abs(fit.x - scene.x) < 1e-4


def moved_back(camera: Camera, by: float) -> Camera:
    """The camera farther away by some m."""
    return replace(camera, translation=camera.translation - camera.rotation @ np.array([0.0, -by, 0.0]))
