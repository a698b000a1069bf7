"""Particles under a surface that is not level: volume, centroid, walls, masses, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.evaluation.glass_scenes import GlassScene, masks, side_camera
from zsdt.fluid.families import draw_shape
from zsdt.fluid.vessel import Vessel
from zsdt.perception.free_surface import SurfaceProfile
from zsdt.perception.glass_geometry import ToldGlass, fit_vessel
from zsdt.perception.mask_edges import read_edges
from zsdt.scene import Liquid, VesselFamily, VesselShape
from zsdt.trajectory import VesselMotion
from zsdt.twin.glass_graph import (
    GlassGraphOptions,
    LiquidSurface,
    carried_evenly,
    fill_below,
    mean_volume,
    rest_volume,
    surface_of_volume,
    volume_below,
)

RADIUS, FILL = 0.035, 0.05
CYLINDER = VesselShape(VesselFamily.cylinder, [0.0, 0.1], [RADIUS, RADIUS])
MOTION = VesselMotion(np.array([-0.1, 0.0]), np.zeros((2, 3)), np.tile([0.0, 0.0, -9.81], (2, 1)))


def plane(slope: float, fill: float = FILL, scale: float = RADIUS) -> SurfaceProfile:
    """A seen profile z = fill + slope x on the far wall."""
    x = np.linspace(-0.9, 0.9, 60) * scale
    places = np.stack([x, np.sqrt(scale**2 - x**2)], axis=1)
    return SurfaceProfile(places, fill + slope * x, np.ones(60, bool), np.zeros((60, 2)), 5, scale, 0.0)


def filled(shape: VesselShape, profile: SurfaceProfile, **options: object):
    chosen = GlassGraphOptions(particles=500, packing=60, **options)  # type: ignore[arg-type]
    return fill_below(shape, LiquidSurface(profile, shape), liquid=Liquid(), motion=MOTION, fps=60.0,
                      gravity=9.81, options=chosen)  # fmt: skip


def test_volume_under_a_plane_is_that_of_its_middle() -> None:
    for shape in (CYLINDER, VesselShape(VesselFamily.jar, [0.0, 0.1], [RADIUS, RADIUS], 0.7, 4.0)):
        surface = LiquidSurface(plane(0.25), shape)
        top = surface.highest(Vessel(shape))
        assert abs(volume_below(surface, shape, top) / Vessel(shape).volume(FILL) - 1) < 2e-3


def test_particles_fill_the_wedge_and_carry_its_mass_and_centroid() -> None:
    slope = 0.25
    graph = filled(CYLINDER, plane(slope))
    body, points = graph.body, graph.body.points
    assert abs(body.nodes / 500 - 1) < 0.15 and body.frame_dt == 1 / 60 and body.motion is MOTION
    assert np.isclose(body.mass.sum(), Liquid().density * np.pi * RADIUS**2 * FILL, rtol=2e-3)
    assert np.isclose(body.pitch**3 * body.nodes, graph.volume) and abs(graph.level - FILL) < 1e-4
    assert Vessel(CYLINDER).distance(points).min() > 0
    assert (points[:, 2] < FILL + slope * points[:, 0]).all()
    # First moment of a cylinder cut by a plane: slope R^2 / (4 h) off the axis.
    assert abs(points[:, 0].mean() - slope * RADIUS**2 / (4 * FILL)) < 4e-4
    assert (
        abs(points[:, 1].mean()) < 4e-4
        and abs(points[:, 2].mean() - (FILL / 2 + slope**2 * RADIUS**2 / 8 / FILL)) < 5e-4
    )
    again = filled(CYLINDER, plane(slope))
    assert np.array_equal(points, again.body.points)


@pytest.mark.parametrize("family", [VesselFamily.bowl, VesselFamily.jar])
def test_other_vessels_are_filled_without_leaks(family: VesselFamily) -> None:
    shape = draw_shape(family, RADIUS, FILL, 0.05, np.random.default_rng(3))
    half = float(np.interp(FILL, shape.heights, shape.radii))
    graph = filled(shape, plane(-0.15, scale=half))
    assert Vessel(shape).distance(graph.body.points).min() > 0
    assert abs(graph.volume / Vessel(shape).volume(FILL) - 1) < 0.02


@pytest.mark.parametrize("shape", [CYLINDER, VesselShape(VesselFamily.jar, [0.0, 0.1], [RADIUS, RADIUS], 0.7, 4.0)])
def test_a_known_volume_tells_how_hollow_the_surface_is(shape: VesselShape) -> None:
    """A paraboloid of depth d over a disk holds half of d less than its rim says; the wall stays as seen."""
    area, hollow = Vessel(shape).base_area, 0.003
    missing = 0.5 * hollow if shape.is_round else None
    level = Vessel(shape).volume(FILL)
    told = LiquidSurface(plane(0.2), shape, hollow)
    volume = volume_below(told, shape, told.highest(Vessel(shape)))
    if missing is not None:
        assert abs((level - volume) / area - missing) < 5e-5
    surface = surface_of_volume(plane(0.2), shape, volume)
    assert abs(surface.hollow - hollow) < 5e-5
    wall = np.array([[RADIUS, 0.0], [-RADIUS, 0.0], [0.0, RADIUS * shape.aspect]])
    assert np.allclose(surface.height(wall), FILL + 0.2 * wall[:, 0], atol=1e-4)
    assert surface_of_volume(plane(0.2), shape, None).hollow == 0.0
    assert surface_of_volume(plane(0.2), shape, 0.5 * level).hollow < 0.13 * FILL  # nonsense is limited


def test_the_volume_at_rest_is_read_from_pictures_with_a_level_surface() -> None:
    level = GlassScene(CYLINDER, np.array([FILL]), side_camera(), x=-0.02)
    askew = replace(level, surface=np.array([FILL, 0.2]), x=0.0)
    edges = [read_edges(*masks(scene)) for scene in (level, askew)]
    fit = fit_vessel(edges, level.camera, ToldGlass(foot_edge=0.0))
    volume = rest_volume(fit, [(edges[0], level.x), (edges[0], level.x), (edges[1], 0.0)])
    assert volume is not None and abs(volume / Vessel(CYLINDER).volume(FILL) - 1) < 0.02
    assert rest_volume(fit, [(edges[1], 0.0)] * 3) is None
    # Masks that bend a surface of which the glass says that it is level still tell its mean height.
    bent = [(edges[1], 0.0)] * 6
    assert rest_volume(fit, bent) is None
    volume = rest_volume(fit, bent, even=True)
    assert volume is not None and abs(volume / Vessel(CYLINDER).volume(FILL) - 1) < 0.03


def test_a_swinging_surface_tells_the_volume_when_the_first_masks_are_wrong() -> None:
    """Surfaces askew to either side keep the mean height, and outvote three first pictures, 8 mm too high."""
    high = GlassScene(CYLINDER, np.array([FILL + 0.008]), side_camera())
    swings = [replace(high, surface=np.array([FILL, slope])) for slope in (0.2, -0.2, 0.1, -0.15, 0.05)]
    wrong, fair = read_edges(*masks(high)), [read_edges(*masks(scene)) for scene in swings]
    fit = fit_vessel([wrong, *fair], high.camera, ToldGlass(foot_edge=0.0))
    seen = [(edges, 0.0) for edges in [wrong] * 3 + fair]
    true = Vessel(CYLINDER).volume(FILL)
    assert abs(mean_volume(fit, seen) / true - 1) < 0.03
    first = rest_volume(fit, seen[:4])
    assert first is not None and first / true - 1 > 0.1, "the first pictures alone are wrong"
    with pytest.raises(DataError, match="No picture shows"):
        mean_volume(fit, [])


def test_only_a_glass_that_is_neither_pushed_nor_shaken_is_carried_evenly() -> None:
    times, rng = np.arange(8) / 60.0, np.random.default_rng(0)
    seen = rng.normal(0.0, 1e-4, 8)  # how well a silhouette tells the place
    assert carried_evenly(times, seen)
    assert carried_evenly(times, 0.5 * times + seen)
    assert not carried_evenly(times, 0.5 * times + 0.5 * 1.5 * times**2 + seen), "a push tilts the surface"
    assert not carried_evenly(times, 0.005 * np.sin(2 * np.pi * 20.0 * times) + seen), "shaken"
    assert not carried_evenly(times[:4], seen[:4]), "too few to know"
    assert not carried_evenly(times, np.where(np.arange(8) < 5, np.nan, seen)), "nor are these enough"


def test_what_cannot_be_filled_is_said() -> None:
    with pytest.raises(DataError, match="too little"):
        filled(CYLINDER, plane(0.0, 0.004))
    with pytest.raises(RunRejected, match="rim"):
        filled(CYLINDER, plane(0.3, 0.095))
    with pytest.raises(OptionError, match="50 particles"):
        GlassGraphOptions(particles=10)
