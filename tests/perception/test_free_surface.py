"""The free surface in the picture: where it is, what is refused, and back into the picture."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.evaluation.glass_scenes import GlassScene, masks, side_camera
from zsdt.perception.free_surface import SurfaceOptions, observe_surface, project_surface, seen_wall
from zsdt.perception.glass_geometry import ToldGlass, VesselFit, fit_vessel
from zsdt.perception.mask_edges import read_edges
from zsdt.scene import VesselFamily, VesselShape

FILL, RADIUS = 0.05, 0.035
SHAPE = VesselShape(VesselFamily.cylinder, [0.0, 0.1], [RADIUS, RADIUS])
SCENE = GlassScene(SHAPE, np.array([FILL, 0.2, -1.0]), side_camera())
ACROSS = np.linspace(-0.85, 0.85, 18) * RADIUS


@lru_cache
def picture() -> tuple[np.ndarray, np.ndarray, VesselFit]:
    glass, liquid = masks(SCENE)
    return glass, liquid, fit_vessel([read_edges(glass, liquid)], SCENE.camera, ToldGlass(foot_edge=0.0))


def off(glass: np.ndarray, liquid: np.ndarray) -> tuple[float, int]:
    """Largest error of the surface [m], and how many columns are believed."""
    profile = observe_surface(read_edges(glass, liquid), picture()[2], 0.0)
    return float(np.abs(profile.at(ACROSS) - SCENE.height(ACROSS)).max()), int(profile.seen.sum())


def test_an_askew_surface_is_found_within_a_hundredth_of_the_fill() -> None:
    glass, liquid, fit = picture()
    profile = observe_surface(read_edges(glass, liquid), fit, 0.0)
    assert np.abs(profile.at(ACROSS) - SCENE.height(ACROSS)).max() < 0.01 * FILL
    assert profile.seen.sum() > 100 and profile.spread < 2e-4
    radius = np.hypot(*profile.places[profile.seen].T)
    assert np.allclose(radius, RADIUS, atol=3e-4) and (profile.places[profile.seen, 1] > 0).all()  # the far wall
    assert abs(profile.level - SCENE.height(np.linspace(-0.95, 0.95, 39) * RADIUS).mean()) < 0.01 * FILL


def test_without_the_refraction_of_the_wall_the_level_is_off() -> None:
    glass, liquid, fit = picture()
    air = replace(fit, walls=replace(fit.walls, index=1.0))
    straight = observe_surface(read_edges(glass, liquid), air, 0.0)
    bias = abs(float(np.mean(straight.at(ACROSS) - SCENE.height(ACROSS))))
    ours = abs(float(np.mean(observe_surface(read_edges(glass, liquid), fit, 0.0).at(ACROSS) - SCENE.height(ACROSS))))
    assert bias > 1e-4 and bias > 2.0 * ours


def test_a_camera_that_looks_up_sees_the_near_wall() -> None:
    low = replace(SCENE, camera=side_camera(height=0.02, look_down=-0.06))
    edges = read_edges(*masks(low))
    fit = fit_vessel([edges], low.camera, ToldGlass(foot_edge=0.0))
    profile = observe_surface(edges, fit, 0.0)
    assert (profile.places[profile.seen, 1] < 0).mean() > 0.9
    assert np.abs(profile.at(ACROSS) - SCENE.height(ACROSS)).max() < 0.02 * FILL


def test_flash_drop_and_hand_are_refused() -> None:
    glass, liquid, _ = picture()
    columns = np.flatnonzero(liquid.max(0) > 200)
    middle, top = int(columns.mean()), int(np.flatnonzero(liquid[:, int(columns.mean())] > 127)[0])
    clean, count = off(glass, liquid)
    flash = liquid.copy()
    flash[top - 3 : top + 25, middle - 8 : middle + 6] = 0
    drop = liquid.copy()
    drop[top - 14 : top + 1, middle + 10 : middle + 18] = 255  # hangs together with the liquid
    hand_glass, hand_liquid = glass.copy(), liquid.copy()
    hand_glass[:, middle + 20 : middle + 60] = 0
    hand_liquid[:, middle + 20 : middle + 60] = 0
    hand_glass[top + 12 :, middle + 20 : middle + 60] = glass[top + 12 :, middle + 20 : middle + 60]
    hand_liquid[top + 12 :, middle + 20 : middle + 60] = liquid[top + 12 :, middle + 20 : middle + 60]
    for disturbed_glass, disturbed in ((glass, flash), (glass, drop), (hand_glass, hand_liquid)):
        error, left = off(disturbed_glass, disturbed)
        assert error < clean + 0.012 * FILL and 0.4 * count < left < count


def test_nothing_is_believed_where_there_is_no_liquid() -> None:
    glass, liquid, fit = picture()
    profile = observe_surface(read_edges(glass, np.zeros_like(liquid)), fit, 0.0)
    assert not profile.known and np.isnan(profile.at(ACROSS)).all()
    with pytest.raises(OptionError, match="degree"):
        SurfaceOptions(degree=0)


def test_projecting_is_the_opposite_of_observing() -> None:
    glass, liquid, fit = picture()
    profile = observe_surface(read_edges(glass, liquid), fit, 0.0)
    back = project_surface(fit, 0.0, profile.places, profile.height)
    middle = profile.seen & (np.abs(profile.places[:, 0]) < 0.85 * RADIUS)
    assert np.abs(back - profile.pixels)[middle].max() < 0.1  # px
    height = SCENE.height(ACROSS)
    line = project_surface(fit, 0.0, seen_wall(fit, 0.0, ACROSS, height), height)
    again = observe_surface(read_edges(glass, liquid), fit, 0.0)
    order = np.argsort(again.pixels[again.seen, 0])
    level = np.interp(line[:, 0], again.pixels[again.seen, 0][order], again.pixels[again.seen, 1][order])
    assert np.abs(level - line[:, 1]).max() < 0.6  # px
    assert np.isnan(project_surface(fit, 0.0, np.zeros((1, 2)), np.array([np.nan]))).all()
