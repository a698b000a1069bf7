"""Colours on the picture are those of the field, at the nodes, between them, and in the legend."""

import cv2
import numpy as np
import pytest

from tests.twin.made_up_face import bending_stress, bent_face, picture
from zsdt.errors import DataError, OptionError
from zsdt.twin.face_raster import face_map
from zsdt.twin.field_scale import LOOKS, round_limit, scale_of
from zsdt.twin.legend import LOST, Legend, Status, draw_status, free_corner
from zsdt.twin.overlay import Overlay, OverlayOptions, dashes_of, draw_overlay, rim_of

PLAIN = OverlayOptions(opacity=1.0, lost_opacity=0.0, texture=0.0, marks=False)


def skewed(columns=4, rows=3, seed=1):
    """A face whose cells are all general quadrilaterals, its inner nodes on whole pixels."""
    random = np.random.default_rng(seed)
    u, v = np.meshgrid(60.0 + 80.0 * np.arange(columns), 250.0 - 70.0 * np.arange(rows), indexing="ij")
    return np.rint(np.stack([u, v], axis=2) + random.uniform(-14, 14, (columns, rows, 2)))


def test_a_node_has_the_colour_of_its_value():
    pixels = skewed()
    values = np.random.default_rng(0).uniform(0.0, 4000.0, pixels.shape[:2])
    scale = scale_of("von_mises", values[None])
    drawn = draw_overlay(np.full((320, 400, 3), 90, np.uint8), pixels, values, scale, PLAIN)
    inner = pixels[1:-1, 1:-1].astype(int).reshape(-1, 2)  # at the rim half of the pixel is background
    expected = scale.palette.colours(scale.factor * values[1:-1, 1:-1]).reshape(-1, 4)[:, 2::-1]
    np.testing.assert_array_equal(drawn[inner[:, 1], inner[:, 0]], expected)


def test_a_field_that_is_linear_in_the_picture_stays_linear_between_the_nodes():
    pixels = skewed()  # a bilinear map holds linear fields exactly, whatever the shape of the cells
    field = lambda u, v: 3.0 * u - 2.0 * v + 700.0  # noqa: E731
    face = face_map(pixels, field(*np.moveaxis(pixels, 2, 0)), None, 320, 400)
    rows, columns = np.nonzero(face.cover >= 1.0)
    truth = field(columns + face.left, rows + face.top)
    np.testing.assert_allclose(face.value[rows, columns], truth, atol=1e-3)
    values = field(*np.moveaxis(pixels, 2, 0))
    scale = scale_of("von_mises", values[None])
    drawn = draw_overlay(np.zeros((320, 400, 3), np.uint8), pixels, values, scale, PLAIN)
    expected = scale.palette.colours(scale.factor * truth)[:, 2::-1].astype(int)
    neighbour = np.abs(np.diff(scale.palette.table[:, :3].astype(int), axis=0)).max()
    assert np.abs(drawn[rows + face.top, columns + face.left] - expected).max() <= neighbour


def test_a_bilinear_field_has_its_closed_form_inside_a_parallelogram():
    corner, along, up = np.array([40.0, 200.0]), np.array([120.0, 24.0]), np.array([-30.0, -90.0])
    pixels = np.stack([[corner, corner + up], [corner + along, corner + along + up]])
    values = np.array([[1.0, 4.0], [2.0, -3.0]])
    face = face_map(pixels, values, None, 300, 300)
    rows, columns = np.nonzero(face.cover >= 1.0)
    s, t = np.linalg.solve(
        np.stack([along, up], axis=1), (np.stack([columns + face.left, rows + face.top]) - corner[:, None])
    )
    expected = (1 - s) * (1 - t) * 1.0 + (1 - s) * t * 4.0 + s * (1 - t) * 2.0 + s * t * -3.0
    np.testing.assert_allclose(face.value[rows, columns], expected, atol=1e-5)


def test_the_face_is_covered_once_and_to_its_area():
    for pixels in (skewed(), skewed()[:, ::-1], bent_face()):  # seen from either side
        face = face_map(pixels, np.ones(pixels.shape[:2]), None, 540, 960)
        rim = rim_of(pixels)
        area = 0.5 * abs(np.sum(rim[:-1, 0] * rim[1:, 1] - rim[1:, 0] * rim[:-1, 1]))
        assert face.cover.sum() == pytest.approx(area, rel=3e-4)
        assert np.allclose(face.value[face.cover > 0], 1.0)
    inside = np.zeros((540, 960), np.uint8)
    cv2.fillPoly(inside, [np.rint(rim).astype(np.int32)], 1)
    core = cv2.erode(inside, np.ones((5, 5), np.uint8))[face.window]
    assert (face.cover[core > 0] == 1.0).all()  # no seams between the cells


def test_parts_outside_of_the_picture_and_broken_nodes_are_left_out():
    pixels, values = bent_face(), bending_stress()
    image = picture(pixels)
    scale = scale_of("von_mises", values[None])
    moved = draw_overlay(image, pixels - [400.0, -300.0], values, scale)
    assert moved.shape == image.shape and (moved != image).any()
    assert (draw_overlay(image, pixels + 5000.0, values, scale) == image).all()
    broken = pixels.copy()
    broken[5, 1] = np.nan
    drawn = draw_overlay(image, broken, values, scale)
    middle = pixels[4:6, 0:2].reshape(-1, 2).mean(axis=0).astype(int)
    assert (drawn[middle[1], middle[0]] == image[middle[1], middle[0]]).all()
    assert (draw_overlay(image, np.full_like(pixels, np.nan), values, scale) == image).all()
    unknown = draw_overlay(image, pixels, np.full_like(values, np.nan), scale, PLAIN)
    assert (unknown[middle[1], middle[0]] == 128).all()
    with pytest.raises(DataError, match="no cells"):
        face_map(pixels[:1], values[:1], None, 540, 960)


def test_light_and_dark_of_the_picture_stay_in_the_colour():
    pixels, values = bent_face(), np.full((13, 4), 2000.0)
    image = np.full((540, 960, 3), 160, np.uint8)
    image[:, 400] = 60  # a dark line across the face
    scale = scale_of("von_mises", values[None])
    drawn = draw_overlay(image, pixels, values, scale, OverlayOptions(texture=1.0, opacity=1.0))
    row = int(pixels[:, :, 1].mean())
    assert drawn[row, 400].sum() < 0.5 * drawn[row, 380].sum()
    flat = draw_overlay(image, pixels, values, scale, OverlayOptions(texture=0.0, opacity=1.0))
    assert (flat[row, 400] == flat[row, 380]).all()


def test_nodes_that_are_not_seen_are_marked_and_fade():
    pixels, values = bent_face(), bending_stress()
    image = np.full((540, 960, 3), 128, np.uint8)
    scale = scale_of("von_mises", values[None])
    seen = np.ones((13, 4), bool)
    seen[6, 1] = seen[7, 2] = False
    with_marks = draw_overlay(image, pixels, values, scale, OverlayOptions(lost_opacity=0.0), seen)
    without = draw_overlay(image, pixels, values, scale, OverlayOptions(lost_opacity=0.0, marks=False), seen)
    changed = np.argwhere((with_marks != without).any(axis=2))[:, ::-1]
    far = np.linalg.norm(changed[:, None] - pixels[~seen][None], axis=2)
    assert far.min(axis=1).max() < 10.0 and (far.min(axis=0) < 6.0).all()  # rings at both lost nodes, nowhere else
    red = with_marks[..., 2].astype(int) - with_marks[..., :2].max(axis=2)
    assert red.max() > 0.6 * (LOST[2] - LOST[0])
    u, v = np.rint(pixels[6, 1]).astype(int)
    assert np.abs(without[v, u].astype(int) - 128).max() <= 25  # at a lost node the picture shows


def test_the_legend_says_the_scale():
    scale = scale_of("von_mises", np.linspace(0.0, 3300.0, 500)[None])
    assert (scale.unit, scale.palette.low, scale.palette.high) == ("kPa", 0.0, 4.0)
    legend = Legend(scale, 540)
    assert tuple(value for _, value in legend.ticks) == scale.ticks == (0.0, 1.0, 2.0, 3.0, 4.0)
    image = np.zeros((legend.height, legend.width, 3), np.uint8)
    legend.lay(image, 0, 0)
    bar = image[legend.bar]
    left = legend.bar[1].start
    for column, value in legend.ticks:
        expected = scale.palette.colours(np.array(value))[2::-1]
        # A tick stands on a whole pixel, so its colour is that of its value or of the next row of the map.
        np.testing.assert_allclose(bar[bar.shape[0] // 2, column - left], expected.astype(int), atol=4)


def test_scales_are_round_hold_a_clip_and_can_be_fixed():
    assert [round_limit(v)[0] for v in (0.99, 1.0, 1.01, 27.0, 0.047)] == [1.0, 1.0, 1.2, 30.0, 0.05]
    for value in np.geomspace(1e-4, 1e6, 57):
        top, step = round_limit(value)
        assert value <= top * (1 + 1e-9) <= 1.6 * value and round(top / step) == pytest.approx(top / step)
    calm = np.concatenate([np.full((9, 200), 10.0), np.full((1, 200), 900.0)])
    calm[3, 0] = 1e6  # one corner of one frame
    calm[4, 1] = np.nan
    assert scale_of("von_mises", calm).palette.high == 1000.0
    assert scale_of("von_mises", calm, top=2500.0).ticks[-1] == 2.5
    signed = scale_of("axial_stress", -calm[4:])
    assert signed.ticks == (-1000.0, -500.0, 0.0, 500.0, 1000.0)
    for name in LOOKS:
        assert scale_of(name, np.zeros((2, 3))).palette.high > 0
    with pytest.raises(DataError, match="no picture for the field colour"):
        scale_of("colour", calm)


def test_outline_trace_and_legend_stay_out_of_the_way():
    rest, pixels, values = bent_face(0.0), bent_face(), bending_stress()
    image = picture(pixels)
    scale = scale_of("von_mises", values[None])
    overlay = Overlay(scale, (540, 960), OverlayOptions(), rest, pixels.reshape(-1, 2))
    trace = np.stack([bent_face(d)[-1].mean(axis=0) for d in np.linspace(0.02, 0.18, 20)])
    status = Status(12, 0.2, closed=True, seen=52, nodes=52, milliseconds=6.0)
    drawn = overlay.draw(image, pixels, values, np.ones((13, 4), bool), trace, status)
    top, left = overlay.corner
    hidden = (pixels[..., 0] > left) & (pixels[..., 1] > top)
    hidden &= (pixels[..., 0] < left + overlay.legend.width) & (pixels[..., 1] < top + overlay.legend.height)
    assert not hidden.any()
    u, v = np.rint(trace[-1]).astype(int)
    assert drawn[v, u].min() > 200  # the tip's dot
    for place in (rest[6, -1], rest[6, 0]):
        u, v = np.rint(place).astype(int)
        line = drawn[v - 1 : v + 2, u - 20 : u + 20].astype(int) - image[v - 1 : v + 2, u - 20 : u + 20]
        assert line.max() > 40  # a white dash


def test_a_panel_goes_to_the_corner_that_hides_least():
    everywhere = np.stack(np.meshgrid(np.arange(0.0, 960.0, 20), np.arange(0.0, 540.0, 20)), axis=2).reshape(-1, 2)
    lower_left = (everywhere[:, 0] < 300) & (everywhere[:, 1] > 400)
    top, left = free_corner((100, 250), (540, 960), everywhere[~lower_left], 14, 28)
    assert (top, left) == (540 - 28 - 14 - 100, 14)
    assert free_corner((100, 250), (540, 960), np.zeros((0, 2)), 14, 28) == (14, 960 - 14 - 250)


def test_dashes_follow_the_line_and_leave_gaps():
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 7.0]])
    parts = dashes_of(line, 6.0, 2.0)
    assert [np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in parts] == pytest.approx([6.0, 6.0, 1.0])
    np.testing.assert_allclose(parts[1], [[8.0, 0.0], [10.0, 0.0], [10.0, 4.0]])  # around the corner


def test_the_status_line_says_what_is_wrong():
    calm, alone = (np.zeros((540, 960, 3), np.uint8) for _ in range(2))
    draw_status(calm, Status(7, 0.1, closed=True, seen=52, nodes=52))
    draw_status(alone, Status(7, 0.1, closed=True, seen=0, nodes=52, fault="occluded"))
    assert (calm[:500] == 0).all() and (calm[500:] != alone[500:]).any()


def test_options_that_make_no_sense():
    with pytest.raises(OptionError, match="opacity"):
        OverlayOptions(opacity=1.2)
    with pytest.raises(OptionError, match="trace"):
        OverlayOptions(trace=-1.0)
