"""The ray tracer for glasses against closed forms of optics and against Mitsuba's own path tracer."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.lab.glass_painter import GlassPainter
from zsdt.lab.glass_shooting import looking_at
from zsdt.lab.glass_styles import draw_glass_style
from zsdt.lab.glass_view import Glass, GlassView
from zsdt.lab.raytrace import RayTracer, to_radiance
from zsdt.lab.raytrace_caster import load_mitsuba
from zsdt.lab.raytrace_options import RaytraceOptions, RayVariant
from zsdt.lab.styles import Pool
from zsdt.perception.camera import Camera
from zsdt.scene import VesselFamily, VesselShape

FLOOR = 0.006


def camera(distance: float = 0.5, height: float = 0.05, focal: float = 500.0, size: int = 96) -> Camera:
    """A level camera that looks along y."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    middle = 0.5 * (size - 1)
    return Camera(
        np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]]),
        np.zeros(5),
        rotation,
        -rotation @ np.array([0.0, -distance, height]),
        size,
        size,
    )


def glass(radius: float = 0.03, wall: float = 0.003, level: float | None = 0.05, rim: float = 0.09) -> Glass:
    """A cylinder with liquid up to a level."""
    shape = VesselShape(VesselFamily.cylinder, [0.0, rim], [radius, radius])
    height = None if level is None else np.full((6, 24), level)
    return Glass(shape, wall, FLOOR, np.array([0.0, 0.0, FLOOR]), height)


def view(*glasses: Glass, camera: Camera, seed: int = 3) -> GlassView:
    return GlassView(glasses, draw_glass_style(np.random.default_rng(seed), Pool.train), camera)


@pytest.fixture(scope="module")
def tracer() -> RayTracer:
    pytest.importorskip("mitsuba", reason="the extra zsdt[raytrace] is not installed")
    return RayTracer()


def test_a_thick_wall_magnifies_the_bore_by_its_index(tracer: RayTracer) -> None:
    """A thermometer: from far away the liquid thread looks n times as wide as it is."""
    far = camera(distance=60.0, height=0.05, focal=50000.0)
    seen = tracer(view(glass(radius=0.02, wall=0.028), camera=far))
    row = seen.liquid_mask[60].astype(float).sum() / 255.0
    metre = 50000.0 / 60.0
    assert row / metre == pytest.approx(2 * 1.5 * 0.02, rel=0.02)
    assert seen.container_mask[60].astype(float).sum() / 255.0 / metre == pytest.approx(2 * 0.048, rel=0.01)


def test_the_level_is_where_a_level_line_of_sight_meets_it(tracer: RayTracer) -> None:
    """A camera at the height of the surface sees it edge on, through whatever wall."""
    for level in (0.035, 0.05):
        level_camera = camera(height=FLOOR + level)
        cover = tracer(view(glass(level=level), camera=level_camera)).liquid_mask[:, 48].astype(float) / 255.0
        top = level_camera.height - cover.sum() - (cover[::-1] == 0).argmin()
        assert top - 0.5 == pytest.approx(47.5, abs=0.5)


def test_masks_agree_with_the_painters(tracer: RayTracer) -> None:
    """Two tracers that share no code: meshes with all reflections, and frustums with one line of sight."""
    tilted = 0.045 + 0.008 * np.linspace(0, 1, 6)[:, None] * np.cos(2 * np.pi * np.arange(24) / 24)
    above = looking_at(
        np.array([0.0, 0.0, 0.05]), distance=0.45, tilt=0.17, roll=0.0, focal=330.0, size=(96, 96), distortion=-0.05
    )
    scene = view(replace(glass(), height=tilted), camera=above)
    traced, painted = tracer(scene), GlassPainter()(scene)
    for name, limit in (("container_mask", 0.985), ("liquid_mask", 0.97)):
        a, b = (getattr(shot, name) > 127 for shot in (traced, painted))
        assert (a & b).sum() / (a | b).sum() > limit, name
    assert (traced.liquid_mask <= traced.container_mask).all()


def test_the_same_view_gives_the_same_bytes(tracer: RayTracer) -> None:
    scene = view(glass(), camera=camera(size=64, focal=330.0))
    first, second = tracer(scene), RayTracer()(scene)
    assert first.image.tobytes() == second.image.tobytes()
    assert first.liquid_mask.tobytes() == second.liquid_mask.tobytes()


def test_two_glasses_an_empty_one_none_and_one_out_of_sight(tracer: RayTracer) -> None:
    wide = camera(focal=250.0)
    beside = replace(glass(level=None), origin=np.array([0.075, 0.0, FLOOR]))
    away = replace(glass(), origin=np.array([3.0, 0.0, FLOOR]))
    both, empty, none, gone = (tracer(view(*some, camera=wide)) for some in ((glass(), beside), (beside,), (), (away,)))
    assert both.container_mask[:, :45].any() and both.container_mask[:, 75:].any()
    assert both.liquid_mask[:, :60].any() and not both.liquid_mask[:, 75:].any()
    assert empty.container_mask.any() and not empty.liquid_mask.any()
    assert not none.container_mask.any() and none.image.std() > 1.0
    assert not gone.container_mask.any()


def test_without_llvm_the_picture_is_the_same(tracer: RayTracer) -> None:
    scene = view(glass(), camera=camera(size=40, focal=200.0))
    fast = tracer(scene)
    slow = RayTracer(RaytraceOptions(variant=RayVariant.scalar))(scene)
    assert np.abs(fast.image - slow.image).mean() < 0.5
    assert np.abs(fast.liquid_mask.astype(int) - slow.liquid_mask).mean() < 1.0


def test_the_tree_of_reflections_is_what_a_path_tracer_finds(tracer: RayTracer) -> None:
    """The same nested dielectrics in Mitsuba's path tracer, lit by the sky of the style: equal up to its noise."""
    size, scene = 24, view(glass(), camera=camera(size=24, focal=120.0, distance=0.5))
    clear = replace(scene.style, glass_tint=np.ones(3), liquid_tint=np.ones(3))
    scene = replace(scene, style=clear)
    mi = load_mitsuba()
    interfaces, outline = tracer._interfaces(scene, scene.camera)
    bright = lambda d: 0.6 + 0.4 * d[..., 2:] + 0.3 * d[..., :1]  # noqa: E731  # smooth light from all around
    lines = tracer._lines_of_sight(scene.camera)
    from zsdt.lab.raytrace import directions_of
    from zsdt.lab.raytrace_caster import MitsubaCaster
    from zsdt.lab.raytrace_light import follow, joined_surfaces

    mesh, surfaces = joined_surfaces(interfaces)
    offsets = (np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2) - 1.5) / 4.0 / 120.0
    ways = directions_of(scene.camera, lines.reshape(-1, 2), offsets)
    ours = follow(
        surfaces,
        MitsubaCaster(mesh).cast,
        lambda o, d: np.repeat(bright(d), 3, axis=1),
        np.broadcast_to(scene.camera.center, ways.shape),
        ways,
        turn=np.zeros(len(ways), int),
        turns=1,
        depth=16,
        dim=np.full(3, 0.6),
    ).radiance.reshape(size, size, 16, 3)
    found = _path_traced(mi, interfaces, scene.camera, bright)
    outside = outline == 0
    picture = ours.mean(axis=2)[..., 0]
    assert np.abs(picture - found)[outside].max() < 0.02
    difference = (picture - found)[~outside]
    assert abs(difference.mean()) < 0.006
    assert np.abs(difference).mean() < 0.015


def _path_traced(mi, interfaces, camera: Camera, bright) -> np.ndarray:
    """The grey picture of the interfaces by Mitsuba's path tracer with 256 samples."""
    polar, turn = np.meshgrid(
        (np.arange(64) + 0.5) / 64 * np.pi, (np.arange(128) + 0.5) / 128 * 2 * np.pi, indexing="ij"
    )
    # Mitsuba's sky: y is up, its first column looks along +z; turned so that z is up, see `to_world`.
    local = np.stack([np.sin(turn) * np.sin(polar), np.cos(polar), -np.cos(turn) * np.sin(polar)], axis=-1)
    turned = np.stack([local[..., 0], -local[..., 2], local[..., 1]], axis=-1)
    sky = np.repeat(bright(turned), 3, axis=-1).astype(np.float32)
    transform = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 24, "rr_depth": 24},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": transform().rotate([1, 0, 0], 90)},
    }
    for number, interface in enumerate(interfaces):
        settings = mi.Properties()
        settings["bsdf"] = mi.load_dict(
            {"type": "dielectric", "int_ior": interface.inside.refraction, "ext_ior": interface.outside.refraction}
        )
        mesh = mi.Mesh(
            f"m{number}",
            len(interface.mesh.vertices),
            len(interface.mesh.faces),
            has_vertex_normals=True,
            props=settings,
        )
        values = mi.traverse(mesh)
        values["vertex_positions"] = interface.mesh.vertices.astype(np.float32).ravel()
        values["vertex_normals"] = interface.mesh.normals.astype(np.float32).ravel()
        values["faces"] = interface.mesh.faces.astype(np.uint32).ravel()
        values.update()
        scene[f"m{number}"] = mesh
    center = camera.center.tolist()
    scene["sensor"] = {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.matrix[0, 0]))),
        "to_world": transform().look_at(origin=center, target=[0.0, 0.0, center[2]], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 256},
    }
    return np.array(mi.render(mi.load_dict(scene), seed=1))[..., 0]


def test_light_is_linear_where_the_display_is_not() -> None:
    np.testing.assert_allclose(to_radiance(np.array([0.0, 255.0])), [0.0, 1.0])
    assert to_radiance(np.array([128.0]))[0] == pytest.approx(0.22, abs=0.01)


def test_a_clear_message_without_mitsuba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(OptionError, match=r"zsdt\[raytrace\]"):
        load_mitsuba()


def test_options_without_sense_are_refused() -> None:
    with pytest.raises(OptionError, match="sample"):
        RaytraceOptions(samples=0)
