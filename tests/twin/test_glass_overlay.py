"""The overlay of a liquid: colours that say what the particles do, inside the outline in which the liquid appears."""

from __future__ import annotations

import numpy as np
import pytest

from tests.twin.made_up_glass import FRAMES, LEVEL, RADIUS, SIZE, START, WALL, made_up_glass, picture
from zsdt.errors import DataError, OptionError
from zsdt.twin.field_scale import LiquidName, scale_of
from zsdt.twin.glass_errors import error_curves, rest_time, velocity_at, vertical_velocity_rrmse
from zsdt.twin.glass_overlay import PREDICTED, SEEN, GlassOverlayOptions, splat
from zsdt.twin.glass_plots import glass_summary
from zsdt.twin.glass_recording import record_glass_twin
from zsdt.twin.glass_video import GlassArtist, glass_comparison, glass_frames, moments_of, scale_of_glass
from zsdt.twin.legend import Key, Legend

PICTURES = [(k, picture()) for k in range(FRAMES) if k != START + 8]


@pytest.fixture(scope="module")
def run():
    return made_up_glass()


def test_a_constant_stays_that_constant_everywhere_and_a_gradient_keeps_its_slope():
    rng = np.random.default_rng(0)
    points = rng.uniform([10, 10], [90, 70], (900, 2))
    same = splat(points, np.full(900, 3.7), 4.0, (80, 100))
    assert np.allclose(same, 3.7, atol=1e-5)
    slope = splat(points, points[:, 0], 4.0, (80, 100))
    inside = slope[25:55, 30:70]
    assert np.abs(inside - np.arange(30, 70)).max() < 2.0, "half a spacing"
    assert np.isfinite(slope).all()


def test_the_liquid_is_drawn_between_the_walls_from_the_floor_to_its_level(run):
    closed, _, _ = run
    options = GlassOverlayOptions(level=False, vessel=False, legend=False, status=False, height=1)
    drawn = dict(glass_frames(closed, PICTURES, options))[FRAMES - 1]
    changed = (drawn != picture()).any(axis=2)
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    camera, origin = closed.camera, closed.origin[-1]
    wall = camera.project(origin + np.array([[-RADIUS - WALL, 0, 0.03], [RADIUS + WALL, 0, 0.03]]))[:, 0]
    assert np.abs(columns[[0, -1]] - wall).max() < 2.0
    far = camera.project(origin + np.array([[0.0, RADIUS + WALL, LEVEL]]))[0, 1]
    near = camera.project(origin + np.array([[0.0, -RADIUS - WALL, 0.0]]))[0, 1]
    assert abs(rows[0] - far) < 6.0 and abs(rows[-1] - near) < 2.0


def test_what_rises_is_red_what_falls_is_blue_and_before_t0_nothing_is_coloured(run):
    closed, _, _ = run
    options = GlassOverlayOptions(level=False, vessel=False, legend=False, status=False, height=1)
    drawn = dict(glass_frames(closed, PICTURES, options))
    assert (drawn[START - 1] == picture()).all()
    u, v = closed.camera.project(closed.origin[-1] + np.array([[-0.8 * RADIUS, 0, 0.04], [0.8 * RADIUS, 0, 0.04]])).T
    left, right = (drawn[START + 5][int(y), int(x)].astype(int) for x, y in zip(u, v, strict=True))
    velocity = closed.values(LiquidName.vertical_velocity)[5]
    assert velocity[closed.body.points[:, 0] < -0.02].mean() > 0.02
    assert left[2] - left[0] > 40 and right[0] - right[2] > 40, "BGR"


def test_observed_and_predicted_level_are_lines_on_the_liquid_and_a_lost_frame_has_none_observed(run):
    closed, _, _ = run
    drawn = dict(glass_frames(closed, PICTURES, GlassOverlayOptions(legend=False, status=False)))

    def has(image, colour):
        return (np.abs(image.astype(int) - colour).max(axis=2) < 12).sum()

    assert has(drawn[START + 3], SEEN) > 100 and has(drawn[START + 3], PREDICTED) > 50
    assert has(drawn[START + 6], SEEN) == 0
    assert START + 8 in drawn, "a frame that never came is drawn over the last one that did"


def test_the_truth_sets_the_scale_if_it_moves_more(run):
    closed, opened, truth = run
    options = GlassOverlayOptions()
    assert scale_of_glass(closed, options, truth).palette.high >= scale_of_glass(opened, options).palette.high
    warm = scale_of("internal_energy", np.array([[1.01], [1.09]]))
    assert 1000 <= warm.palette.low <= 1010 and 1090 <= warm.palette.high <= 1110 and warm.unit == "mJ/kg"
    assert len(warm.ticks) <= 7
    with pytest.raises(OptionError, match="opacity"):
        GlassOverlayOptions(opacity=1.5)


def test_keys_make_the_legend_longer():
    scale = scale_of("speed", np.linspace(0, 0.1, 50)[None])
    plain = Legend(scale, 540, outline=False, marks=False)
    more = Legend(scale, 540, outline=False, marks=False, keys=[Key("level, observed", SEEN)])
    assert more.height > plain.height and more.width == plain.width


def test_the_strip_has_the_moments_of_the_seed_and_says_where_a_side_has_no_liquid(run):
    closed, opened, truth = run
    assert moments_of(closed) == [START, START + 7, START + 14]
    shown = {number: image for number, image in PICTURES if number in (START, START + 7)}
    sheet = glass_comparison(shown, [opened, closed, truth])
    assert sheet.shape[0] > 4 * 200 and sheet.std() > 10
    with pytest.raises(DataError, match="no liquid in frame 0"):
        glass_comparison({0: picture()}, [closed])


def test_errors_are_zero_against_oneself_and_the_closed_loop_is_nearer_than_the_open_one(run):
    closed, opened, truth = run
    own = error_curves(truth, truth)
    assert own["level_mm"].max() == 0 and own["centroid_mm"].max() == 0
    assert own["vertical_velocity"].max() < 1e-6, "a spline goes through its own particles"
    assert vertical_velocity_rrmse(closed, truth) < 0.6 * vertical_velocity_rrmse(opened, truth)
    points = truth.positions[0][:20]
    assert np.abs(velocity_at(truth, 0, points) - truth.fields["velocity"][0][:20]).max() < 0.03
    loudest = truth.rise().max()
    assert rest_time(opened, loudest) <= rest_time(closed, loudest), "the open loop rests too early"


def test_plots_and_recording_hold_all_sides(run, tmp_path):
    closed, opened, truth = run
    assert glass_summary(closed, truth, opened)[:4] == b"\x89PNG"
    assert glass_summary(opened)[:4] == b"\x89PNG"
    record_glass_twin(tmp_path / "twin.rrd", closed, PICTURES, truth, opened, config_text="a: 1")
    assert 50_000 < (tmp_path / "twin.rrd").stat().st_size < 6_000_000
    with pytest.raises(DataError, match="different frames"):
        opened.frames = opened.frames + 1
        record_glass_twin(tmp_path / "other.rrd", closed, PICTURES, None, opened)


def test_a_small_picture_is_enlarged_and_a_large_one_is_not(run):
    closed, _, _ = run
    scale = scale_of_glass(closed, GlassOverlayOptions())
    assert GlassArtist(closed, GlassOverlayOptions(), scale).draw(picture(), START + 2).shape == (
        2 * SIZE[0], 2 * SIZE[1], 3
    )  # fmt: skip
