"""A painted glass refracts as optics says, and its masks are where the camera sees the true geometry."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from zsdt.lab.glass_painter import GlassPainter
from zsdt.lab.glass_rays import _reflectance
from zsdt.lab.glass_scenery import room_of
from zsdt.lab.glass_shooting import looking_at
from zsdt.lab.glass_styles import GLASS_PALETTES, draw_glass_style
from zsdt.lab.glass_surface import polar_heights
from zsdt.lab.glass_view import Glass, GlassView, outer_profile
from zsdt.lab.styles import Pool
from zsdt.scene import VesselFamily, VesselShape

RADIUS, RIM, LEVEL, WALL, FLOOR = 0.035, 0.11, 0.06, 0.0025, 0.006
SHAPE = VesselShape(VesselFamily.cylinder, [0.0, RIM], [RADIUS, RADIUS])
SIZE = (256, 256)
AIM = np.array([0.0, 0.0, 0.055])
CLEAR = np.ones(3)


def style_of(**changes):
    style = draw_glass_style(np.random.default_rng(3), Pool.train)
    plain = {"blur": 0.0, "gradient": np.zeros(2), "liquid_tint": CLEAR, "glass_tint": CLEAR, "shadow": 0.0}
    return replace(style, **{**plain, **changes})


def camera_of(tilt=0.0):
    return looking_at(AIM, distance=0.6, tilt=tilt, roll=0.0, focal=900.0, size=SIZE)


def glass_of(level=LEVEL, **changes):
    height = None if level is None else polar_heights(SHAPE, lambda at: np.full(len(at), level))
    return Glass(**{"vessel": SHAPE, "wall": WALL, "floor": FLOOR, "origin": np.array([0, 0, FLOOR]), "height": height}
                 | changes)  # fmt: skip


def shot_of(*glasses, tilt=0.0, style=None):
    return GlassPainter()(GlassView(tuple(glasses), style or style_of(), camera_of(tilt)))


def widths(mask):
    return (mask / 255.0).sum(axis=1)


def test_fresnel() -> None:
    assert _reflectance(1.0, 1.0, 1.0, 1.5) == pytest.approx(0.04)
    brewster = np.arctan(1.5)  # p vanishes there: half of s is left
    cos, out = np.cos(brewster), np.sqrt(1.0 - (np.sin(brewster) / 1.5) ** 2)
    assert _reflectance(cos, out, 1.0, 1.5) == pytest.approx(0.5 * ((cos - 1.5 * out) / (cos + 1.5 * out)) ** 2)


def test_a_glass_of_air_is_not_seen() -> None:
    nothing = {"glass_index": 1.0 + 1e-9, "liquid_index": 1.0 + 1e-9}
    style = style_of()
    empty, glass = shot_of(style=style, tilt=0.1), shot_of(glass_of(**nothing), style=style, tilt=0.1)
    assert empty.container_mask.max() == 0 and glass.container_mask.max() == 255
    # But for the table under its foot, which gets less light, and for pixels at the rim of the mask (more samples).
    core = cv2.erode(glass.container_mask, np.ones((5, 5), np.uint8)) == 255
    core[int(np.flatnonzero(core.any(axis=1))[-1]) - 30 :] = False
    core &= glass.liquid_mask % 255 == 0
    assert np.abs(glass.image - empty.image)[core].mean() < 1.0


def test_the_container_is_where_its_silhouette_is() -> None:
    shot, outer = shot_of(glass_of()), RADIUS + WALL
    tangent = 900.0 * outer / np.sqrt(0.6**2 - outer**2)
    rows = widths(shot.container_mask)
    middle = rows[90:166]
    np.testing.assert_allclose(middle, 2.0 * tangent, atol=0.6)
    # The rim and the foot, seen from the level of the aim: their near edges are the outermost rows.
    seen = np.flatnonzero(rows > 0.5)
    near = 900.0 / (0.6 - outer)
    assert 127.5 - seen[0] == pytest.approx(near * (RIM + FLOOR - AIM[2]), abs=1.0)
    assert seen[-1] - 127.5 == pytest.approx(near * AIM[2], abs=1.0)


def test_liquid_fills_a_thick_glass_but_not_one_that_does_not_refract() -> None:
    """In glass of index n the cavity looks n times as wide, at most as wide as the outside."""
    filled = shot_of(glass_of())
    rows = np.s_[140:180]
    gap = widths(filled.container_mask)[rows] - widths(filled.liquid_mask)[rows]
    assert np.abs(gap).max() < 1.0
    bare = shot_of(glass_of(glass_index=1.0 + 1e-9))
    tangent = 900.0 * RADIUS / np.sqrt(0.6**2 - RADIUS**2)
    np.testing.assert_allclose(widths(bare.liquid_mask)[rows], 2.0 * tangent, atol=0.8)


@pytest.mark.parametrize("tilt", [0.0, 0.15])
def test_the_level_is_where_the_camera_sees_the_contact_line(tilt) -> None:
    shot = shot_of(glass_of(glass_index=1.0 + 1e-9), tilt=tilt)
    camera = camera_of(tilt)
    rows = widths(shot.liquid_mask.T)[118:138]  # height of the liquid in columns near the axis
    ends = np.flatnonzero(shot.liquid_mask[:, 128] > 127)
    y = RADIUS if tilt or AIM[2] > LEVEL + FLOOR else -RADIUS
    top = camera.project(np.array([[0.0, y, LEVEL + FLOOR]]))[0, 1]
    assert ends[0] == pytest.approx(top, abs=1.0)
    assert np.ptp(rows) < 2.0


def test_a_full_glass_turns_the_world_round() -> None:
    """A cylinder of liquid is a strong lens: what is far behind it appears mirrored, in an empty glass it does not."""
    painter, style = GlassPainter(), style_of(distance=0.5)
    view = GlassView((glass_of(),), style, camera_of())
    painter(view)
    picture = np.zeros_like(room_of(style).backdrop)
    picture[:, picture.shape[1] // 2 :] = 255  # bright at the right
    painter._room = painter._room._replace(backdrop=picture)
    full = painter(view).image
    empty = painter(GlassView((glass_of(None),), style, view.camera)).image
    rows = np.s_[115:125]  # above the horizon, where the backdrop is seen, and below the level
    left, right = np.s_[rows, 85:115], np.s_[rows, 141:171]
    assert full[left].mean() > 150 > 100 > full[right].mean()
    assert empty[left].mean() < 100 < 150 < empty[right].mean()


def test_masks_of_none_one_and_two_glasses() -> None:
    none, empty = shot_of(), shot_of(glass_of(None))
    assert none.container_mask.max() == none.liquid_mask.max() == 0
    assert empty.liquid_mask.max() == 0 and empty.container_mask.max() == 255
    small = VesselShape(VesselFamily.bowl, [0.0, 0.03, 0.06], [0.012, 0.022, 0.018])
    height = polar_heights(small, lambda at: np.full(len(at), 0.03))
    other = Glass(small, 0.002, 0.005, np.array([0.068, 0.0, 0.005]), height)
    both = shot_of(glass_of(), other, tilt=0.1)
    count, labels = cv2.connectedComponents((both.container_mask > 127).astype(np.uint8))
    assert count == 3
    for k in (1, 2):
        assert both.liquid_mask[labels == k].max() == 255
    assert (both.liquid_mask <= both.container_mask).all()
    assert both.image.min() >= 0 and both.image.max() <= 255 and np.isfinite(both.image).all()


def test_shaking_moves_the_whole_picture() -> None:
    style, camera = style_of(), camera_of()
    painter = GlassPainter()
    still = painter(GlassView((glass_of(),), style, camera))
    moved = painter(GlassView((glass_of(),), style, camera, np.array([0.0, 5.0 / 900.0, 0.0])))
    shift = 5
    assert np.abs(still.image[20:-20, 20:200] - moved.image[20:-20, 20 + shift : 200 + shift]).mean() < 3.0


def test_outer_profile_is_an_offset() -> None:
    shape = VesselShape(VesselFamily.tumbler, [0.0, 0.1], [0.03, 0.045])
    heights, radii = outer_profile(shape, 0.003, 0.008)
    assert heights[0] == -0.008 and heights[-1] == 0.1
    z = np.array([0.03, 0.06, 0.09])
    square = (np.interp(z, heights, radii) - np.interp(z, shape.heights, shape.radii)) / np.hypot(1.0, 0.15)
    np.testing.assert_allclose(square, 0.003, rtol=0.02)


def test_pools_share_no_scenery() -> None:
    train, unseen = GLASS_PALETTES[Pool.train], GLASS_PALETTES[Pool.unseen]
    for name in ("backdrops", "tables", "clutter"):
        assert not set(getattr(train, name)) & set(getattr(unseen, name))
    for palette, pool in ((train, Pool.train), (unseen, Pool.unseen)):
        for backdrop in palette.backdrops:
            for table in palette.tables[:1]:
                style = replace(style_of(), pool=pool, backdrop=backdrop, table=table, clutter=palette.clutter)
                room = room_of(style)
                assert room.backdrop.dtype == np.uint8 and room.backdrop.std() > 0.5
