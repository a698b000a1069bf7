"""The painter paints what the projection says, and its masks are exact."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from zsdt.lab.beam_painter import BeamPainter, spline_matrix, subframes
from zsdt.lab.stills import StillOptions, bent_faces, painted_still, view_of
from zsdt.lab.styles import PALETTES, Pool, draw_style
from zsdt.perception.camera import Camera, ClampSide

SMALL = StillOptions(width=480, height=270, length_cm=[35.0, 45.0], height_cm=[10.0, 20.0], motion_px=0.0)
PITCH, COLUMNS, ROWS, WIDTH = 0.05, 9, 4, 0.15
BACK = np.array([0.0, 5.0, 0.0])
CLEAN = {"blur": 0.3, "noise": 0.0, "line_wobble": 0.0, "fading": 0.0, "shade": 0.0, "blotch": 0.02}


def flat_faces(side: ClampSide) -> tuple[np.ndarray, np.ndarray]:
    x, z = np.meshgrid(np.arange(COLUMNS) * PITCH, np.arange(ROWS) * PITCH, indexing="ij")
    low, high = (np.stack([x, np.full_like(x, y), z], axis=-1) for y in (0.0, WIDTH))
    return (low, high) if side is ClampSide.left else (high, low)


def painter_of(side: ClampSide, seed: int = 3, distortion=None, **style) -> BeamPainter:
    camera = Camera.facing(
        distance=1.0,
        look_at=(0.2, 0.07),
        focal=500.0,
        beam_width=WIDTH,
        clamp_side=side,
        size=(320, 200),
        distortion=distortion,
    )
    look = replace(draw_style(np.random.default_rng(seed), Pool.train), **{**CLEAN, **style})
    return BeamPainter(look, camera, columns=COLUMNS, rows=ROWS, pitch=PITCH, beam_width=WIDTH, clamp_side=side)


@pytest.mark.parametrize("side", list(ClampSide))
def test_lines_cross_at_the_projected_nodes(side) -> None:
    distortion = np.array([-0.2, 0.05, 0.001, 0.001, 0.0])
    painter = painter_of(side, distortion=distortion, line_width=0.006)
    rng = np.random.default_rng(1)
    face, far = bent_faces(rng, COLUMNS, ROWS, PITCH, WIDTH, side, 0.2)
    mask = painter.paint([(face, far)]).grid_mask.astype(float)
    pixels = painter.node_pixels(face)
    for column in range(1, COLUMNS - 1):
        for row in range(1, ROWS - 1):
            u, v = np.rint(pixels[column, row]).astype(int)
            assert mask[v, u] > 200
            # Midway to the next crossing only the vertical line is there: its middle is the spline between nodes.
            middle = 0.5 * (pixels[column, row] + pixels[column, row - 1])
            left, line = int(middle[0]) - 6, mask[round(middle[1])]
            place = (np.arange(left, left + 13) * line[left : left + 13]).sum() / line[left : left + 13].sum()
            slope = pixels[column, row] - pixels[column, row - 1]
            expected = middle[0] + slope[0] / slope[1] * (round(middle[1]) - middle[1])
            assert place == pytest.approx(expected, abs=0.3)


def test_the_face_mask_is_the_projected_face() -> None:
    painter = painter_of(ClampSide.left)
    face, far = flat_faces(ClampSide.left)
    painted = painter.paint([(face, far)])
    # Focal 500 px at 1 m: 0.40 m x 0.15 m are 200 x 75 px.
    assert painted.beam_mask.sum() / 255.0 == pytest.approx(200.0 * 75.0, rel=0.004)
    columns = painted.beam_mask.max(axis=0) > 127
    corner = painter.node_pixels(face)[0, 0]
    assert np.flatnonzero(columns)[0] == pytest.approx(corner[0], abs=0.6)
    # No line beyond the face; full-width lines inside, half of them on the border.
    assert (painted.grid_mask <= painted.beam_mask.astype(int) + 1).all()
    area = painter.style.line_width * 500.0
    vertical, horizontal = (COLUMNS - 1) * 75.0 * area, (ROWS - 1) * 200.0 * area
    crossings = (COLUMNS - 1) * (ROWS - 1) * area**2
    assert painted.grid_mask.sum() / 255.0 == pytest.approx(vertical + horizontal - crossings, rel=0.1)


@pytest.mark.parametrize("side", list(ClampSide))
def test_the_texture_moves_with_the_nodes(side) -> None:
    painter = painter_of(side)
    face, far = flat_faces(side)
    shift = np.array([0.02 if side is ClampSide.left else -0.02, 0.0, -0.008])  # 10 px right, 4 px down
    first = painter.paint([(face, far)]).image
    second = painter.paint([(face + shift, far + shift)]).image
    u, v = np.rint(painter.node_pixels(face)[COLUMNS // 2, ROWS // 2]).astype(int)
    part = np.s_[v - 32 : v + 32, u - 64 : u + 64]
    grey = [cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)[part].astype(np.float32) for picture in (first, second)]
    moved, _ = cv2.phaseCorrelate(*grey, cv2.createHanningWindow((128, 64), cv2.CV_32F))
    np.testing.assert_allclose(moved, [10.0, 4.0], atol=0.1)


def test_shaking_moves_the_whole_picture_by_the_projected_amount() -> None:
    painter = painter_of(ClampSide.left)
    face, far = flat_faces(ClampSide.left)
    shake = np.array([0.0, 0.008, 0.0])  # 4 px sideways
    still, moved = painter.paint([(face, far)]), painter.paint([(face, far)], shake=shake)
    expected = (painter.node_pixels(face, shake) - painter.node_pixels(face)).reshape(-1, 2).mean(axis=0)
    assert np.hypot(*expected) == pytest.approx(4.0, rel=0.03)
    grey = [cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY).astype(np.float32) for p in (still, moved)]
    found, _ = cv2.phaseCorrelate(*grey, cv2.createHanningWindow((320, 200), cv2.CV_32F))
    np.testing.assert_allclose(found, expected, atol=0.25)


def test_motion_blur_averages_moments_and_noise_stays_out_of_the_masks() -> None:
    painter = painter_of(ClampSide.left, noise=4.0)
    face, far = flat_faces(ClampSide.left)
    step = np.array([0.0, 0.0, 0.004])
    moments = [(face + k * step, far + k * step) for k in (-1, 0, 1)]
    blurred, sharp = painter.paint(moments), painter.paint(moments[1:2])
    assert blurred.grid_mask.sum() == pytest.approx(sharp.grid_mask.sum(), rel=0.03)
    assert np.abs(np.diff(blurred.grid_mask.astype(float), axis=0)).max() < 200
    again, other = painter.paint(moments[1:2]), painter.paint(moments[1:2], noise_seed=1, exposure=1.1)
    np.testing.assert_array_equal(sharp.image, again.image)
    np.testing.assert_array_equal(sharp.grid_mask, other.grid_mask)
    assert (sharp.image != other.image).any()
    assert other.image.mean() / sharp.image.mean() == pytest.approx(1.1, rel=0.03)
    assert subframes(0.0) == 1 and subframes(100.0) > subframes(1.0) > 1


def test_a_beam_outside_the_picture_is_no_error() -> None:
    painter = painter_of(ClampSide.left)
    face, far = flat_faces(ClampSide.left)
    for shift in ([10.0, 0.0, 0.0], [0.0, -5.0, 0.0], [0.25, 0.0, 0.1]):
        painted = painter.paint([(face + shift, far + shift)])
        assert painted.image.shape == (200, 320, 3)
    behind = painter.paint([(face - BACK, far - BACK)])
    assert not behind.grid_mask.any()


def test_side_faces_appear_only_where_they_can_be_seen() -> None:
    style = replace(draw_style(np.random.default_rng(3), Pool.train), **CLEAN)
    face, far = flat_faces(ClampSide.left)

    def covered(height: float) -> int:
        camera = Camera.facing(distance=1.0, look_at=(0.2, height), focal=500.0, beam_width=WIDTH, size=(320, 400))
        painter = BeamPainter(
            style, camera, columns=COLUMNS, rows=ROWS, pitch=PITCH, beam_width=WIDTH, clamp_side=ClampSide.left
        )
        far_away = face + 8.0 * BACK
        empty = painter.paint([(far_away, far_away)]).image.astype(int)
        shown = painter.paint([(face, far)])
        changed = np.abs(shown.image.astype(int) - empty).max(axis=2) > 25
        top = painter.node_pixels(face)[2:-2, -1, 1].mean()
        u = (
            np.rint(painter.node_pixels(face)[2, 0, 0]).astype(int),
            np.rint(painter.node_pixels(face)[-2, 0, 0]).astype(int),
        )
        return int(changed[max(int(top) - 12, 0) : int(top) - 3, u[0] : u[1]].sum())

    assert covered(0.35) > 5 * max(covered(0.07), 1)  # seen from above the top shows, from the middle it does not


def test_splines_go_through_the_nodes() -> None:
    places = np.array([-0.1, 0.0, 0.5, 2.0, 4.0, 4.1])
    matrix = spline_matrix(5, places)
    np.testing.assert_allclose(matrix @ np.arange(5.0), places, atol=1e-12)  # linear fields exactly, also outside
    np.testing.assert_allclose(matrix[[1, 3, 4]], np.eye(5)[[0, 2, 4]], atol=1e-12)
    np.testing.assert_allclose(spline_matrix(2, places) @ [0.0, 1.0], places)


def test_same_seed_same_bytes() -> None:
    first, again, other = (painted_still(seed, Pool.train, SMALL) for seed in (5, 5, 6))
    for name in ("image", "grid_mask", "beam_mask", "node_pixels"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert first.image.shape == (270, 480, 3)
    assert first.image.tobytes() != other.image.tobytes()


@pytest.mark.parametrize("pool", list(Pool))
def test_stills_of_both_pools_show_the_whole_grid(pool) -> None:
    for seed in range(3):
        still = painted_still(seed, pool, SMALL)
        columns, rows = still.node_pixels.shape[:2]
        assert 8 <= columns <= 10 and 3 <= rows <= 5
        u, v = np.rint(still.node_pixels[1:-1, 1:-1]).astype(int).reshape(-1, 2).T
        assert (still.grid_mask[v, u] > 127).all()
        first_column, last_column = still.node_pixels[0, :, 0].mean(), still.node_pixels[-1, :, 0].mean()
        assert (first_column < last_column) == (still.clamp_side is ClampSide.left)
        assert (still.node_pixels[:, 0, 1] > still.node_pixels[:, -1, 1]).all()  # row 0 is below
        on = still.image[still.grid_mask > 250].mean(axis=0)
        off = still.image[(still.grid_mask < 5) & (still.beam_mask > 250)].mean(axis=0)
        assert np.abs(on - off).max() > 15  # lines that nobody can see teach nothing


def test_the_pools_share_no_style() -> None:
    train, unseen = PALETTES[Pool.train], PALETTES[Pool.unseen]
    assert not set(train.backdrops) & set(unseen.backdrops)
    assert not set(train.clutter) & set(unseen.clutter)

    def overlap(a, b) -> bool:
        hue = any(a[0][0] < b[0][1] + turn and b[0][0] + turn < a[0][1] for turn in (-360, 0, 360))
        return hue and all(x[0] < y[1] and y[0] < x[1] for x, y in zip(a[1:], b[1:], strict=True))

    for part in (0, 1):
        for mine in train.pairs:
            for theirs in unseen.pairs:
                assert not overlap(mine[part], theirs[part]), (mine[part], theirs[part])


def test_bending_keeps_the_length_of_the_axis_and_plane_sections() -> None:
    rng = np.random.default_rng(0)
    for side in ClampSide:
        near, far = bent_faces(rng, 12, 5, PITCH, WIDTH, side, 0.2)
        axis = near[:, 2]
        steps = np.linalg.norm(np.diff(axis[:, [0, 2]], axis=0), axis=1)
        np.testing.assert_allclose(steps, PITCH, rtol=0.01)
        np.testing.assert_allclose(np.linalg.norm(np.diff(near, axis=1), axis=2), PITCH, rtol=1e-9)
        np.testing.assert_allclose(near[0, :, 0], 0.0, atol=1e-12)  # clamped upright
        assert (far[..., 1] - near[..., 1] > 0).all() == (side is ClampSide.left)
        camera = view_of(rng, near, side, SMALL)
        assert (camera.depths(far.reshape(-1, 3)) > camera.depths(near.reshape(-1, 3))).mean() > 0.9
