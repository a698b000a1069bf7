"""Tracking against a motion known in closed form: changing light, obstacles, bad frames, wrong predictions."""

import cv2
import numpy as np
import pytest

from tests.perception.bending_grid import BendingGrid, grey, swing
from zsdt.errors import DataError, OptionError, ZsdtError
from zsdt.perception.frame_quality import FrameQuality
from zsdt.perception.optical_flow import GridTracker, TrackerOptions

FRAMES = 101


class Film:
    """Pictures of a swinging strip with its exact crossings; `change(frame, image)` disturbs a picture."""

    def __init__(self, seed=0, frames=FRAMES, cycles=2.5, **strip):
        self.strip = BendingGrid(seed, **strip)
        self.curvatures = swing(frames, cycles=cycles)
        self.truth = np.stack([self.strip.nodes(k) for k in self.curvatures])

    def run(self, change=None, predict=None, noise=3.0, frames=None, options=None):
        """(error [frames, nodes], seen, qualities, tracks) from frame 1 on; `change` may give None for no frame."""
        tracker = GridTracker(options)
        tracker.start(grey(self.strip.picture(self.curvatures[0], noise)), self.truth[0], self.strip.edges)
        tracks = []
        for frame, curvature in list(enumerate(self.curvatures))[1:frames]:
            image = self.strip.picture(curvature, noise)
            image = image if change is None else change(frame, image)
            tracks.append(
                tracker.track(
                    None if image is None else grey(image), None if predict is None else predict(frame, self.truth)
                )
            )
        pixels = np.stack([t.pixels for t in tracks])
        error = np.linalg.norm(pixels - self.truth[1 : len(tracks) + 1], axis=2)
        return error, np.stack([t.seen for t in tracks]), [t.quality for t in tracks], tracks


@pytest.fixture(scope="module")
def film():
    return Film()


def _passing_shadow(frame, image):
    middle = 60 + 9.0 * (frame % 60)
    apart = np.abs(np.arange(image.shape[1]) - middle)
    return image * (1.0 - 0.5 / (1.0 + np.exp((apart - 50.0) / 7.0))) * (1.0 + 0.4 * np.sin(2 * np.pi * frame / 30))


def test_a_hundred_frames_under_shadow_and_swinging_light_leave_no_drift(film):
    error, seen, _, tracks = film.run(_passing_shadow)
    assert np.median(error[-1]) < 0.1 and np.quantile(error[-1], 0.95) < 0.5
    assert error[-20:][seen[-20:]].mean() < 1.5 * error[:20][seen[:20]].mean() + 0.02
    assert seen.mean() > 0.97 and error[seen].max() < 1.0
    assert (
        np.isfinite(tracks[-1].error_px[tracks[-1].seen]).all()
        and np.isinf(tracks[-1].error_px[~tracks[-1].seen]).all()
    )


def test_silhouette_nodes_hold_in_noise_before_clutter(film):
    error, seen, _, _ = film.run(noise=10.0)
    outer = np.ones((15, 4), bool)
    outer[1:-1, 1:-1] = False
    assert np.median(error[-1][outer.ravel()]) < 0.3 and np.quantile(error[-1], 0.95) < 1.0
    assert seen[-1].mean() > 0.95


def test_nodes_behind_a_passing_bar_are_lost_not_mistaken_and_come_back(film):
    board = grey(120 + 30 * film.strip.rng.standard_normal((360, 110)))
    board = cv2.GaussianBlur(board, (0, 0), 1.5)
    board[::32] = board[:, ::32] = 40

    def bar(frame, image):
        if 30 <= frame < 60:
            left = 130 + 8 * (frame - 30)
            image[:, left : left + 110] = board
        return image

    error, seen, _, _ = film.run(bar, frames=70)
    during = slice(29, 59)
    # A node just behind the bar's edge may still be told from the part of its window that is free.
    left = 130 + 8 * (np.arange(30, 60) - 30)[:, None] + 6
    behind = (film.truth[30:60, :, 0] > left) & (film.truth[30:60, :, 0] < left + 98)
    assert behind.mean() > 0.15 and not (seen[during] & behind).any()
    assert error[during][seen[during]].max() < 1.5 and np.quantile(error[during][seen[during]], 0.99) < 0.6
    assert error[during][~seen[during]].max() < 30.0
    assert (seen[62] & (error[62] < 1.0)).mean() >= 0.95


def test_half_of_the_beam_hidden_with_a_wrong_twin_comes_back(film):
    def hide(frame, image):
        if 20 <= frame < 50:
            image[:, 300:] = 128.0 + 40.0 * np.sin(np.arange(340) / 5.0)
        return image

    error, seen, _, tracks = film.run(hide, predict=lambda f, truth: truth[f] - 0.2 * (truth[f] - truth[0]), frames=56)
    during = slice(19, 49)
    assert 0.3 < seen[during].mean() < 0.6 and error[during][seen[during]].max() < 1.0
    expected = film.truth[40] - 0.2 * (film.truth[40] - film.truth[0])
    assert np.allclose(tracks[39].pixels[~seen[39]], expected[~seen[39]])
    assert (seen[52] & (error[52] < 1.0)).mean() >= 0.95


def test_bad_frames_are_named_and_survived(film):
    faults = {20: "missing", 21: "missing", 32: "dark", 33: "dark", 45: "frozen", 55: "bright"}
    kept = {}

    def fault(frame, image):
        kept[frame] = image
        return {
            "missing": None,
            "dark": 0.03 * image,
            "frozen": kept.get(frame - 1),
            "bright": np.full_like(image, 255.0),
        }.get(faults.get(frame, ""), image)

    error, seen, quality, _ = film.run(fault, frames=70)
    for frame, fault_name in faults.items():
        assert quality[frame - 1] == fault_name and not seen[frame - 1].any()
    good = [q is FrameQuality.good for q in quality]
    assert sum(good) == len(good) - len(faults)
    for frame in (22, 34, 46, 56):
        assert seen[frame - 1].mean() > 0.9 and seen[frame].mean() > 0.95 and np.median(error[frame - 1]) < 0.15
    assert error[20].max() < 12.0


def test_blurred_frames_are_named_or_tracked_and_survived(film):
    """A lens out of focus: what can still be told is right, where nothing can the frame is called blurred."""
    for width in (5.0, 14.0):
        smear = lambda frame, image, w=width: cv2.GaussianBlur(image, (0, 0), w) if frame in (10, 11) else image  # noqa: E731
        error, seen, quality, _ = film.run(smear, noise=1.0, frames=16)
        assert (quality[9] == quality[10] == FrameQuality.blurred) == (width > 10.0)
        assert not seen[9:11][error[9:11] > 1.5].any()
        assert quality[11] is FrameQuality.good and seen[11].mean() > 0.9 and np.median(error[11]) < 0.15


def test_wrong_predictions_are_survived(film):
    """A twin that is 15 px off in one frame, and one that bends ever more wrongly (a wrong material, open loop)."""
    sudden = lambda f, truth: truth[f] + ([10.6, -10.6] if f == 15 else [0.0, 0.0])  # noqa: E731
    error, seen, _, _ = film.run(predict=sudden, frames=30)
    assert error[seen].max() < 1.0 and seen[14].mean() > 0.9 and seen[-5:].mean() > 0.97
    soft = lambda f, truth: truth[f] + 0.25 * (truth[f] - truth[0])  # noqa: E731
    error, seen, _, _ = film.run(predict=soft, frames=60)
    assert np.linalg.norm(0.25 * (film.truth[:60] - film.truth[0]), axis=2).max() > 25.0
    assert error[seen].max() < 1.0 and seen.mean() > 0.97


def test_fast_motion_with_a_prediction_and_without():
    film, rng = Film(seed=4, frames=40, cycles=4.0), np.random.default_rng(0)
    assert np.linalg.norm(np.diff(film.truth, axis=0), axis=2).max() > 1.5 * film.strip.pitch
    error, seen, _, _ = film.run(predict=lambda f, truth: truth[f] + rng.normal(0, 3.0, 2))
    assert np.median(error[-1]) < 0.15 and seen.mean() > 0.95 and error[seen].max() < 1.5
    film = Film(seed=4, frames=40, cycles=2.0)
    assert np.linalg.norm(np.diff(film.truth, axis=0), axis=2).max() > 0.75 * film.strip.pitch
    error, seen, _, _ = film.run()
    assert np.median(error[-1]) < 0.15 and seen.mean() > 0.95 and error[seen].max() < 1.5


def test_unseen_nodes_carry_the_prediction(film):
    hide = lambda frame, image: np.full_like(image, 128.0) if frame == 5 else image  # noqa: E731
    tracker_says = film.run(hide, predict=lambda f, truth: truth[f] + 2.0, frames=8)
    assert not tracker_says[1][4].any()
    assert np.allclose(tracker_says[3][4].pixels, film.truth[5] + 2.0)


def test_colour_and_grey_give_the_same_and_runs_repeat(film):
    def tracks(colour):
        tracker, result = GridTracker(), []
        film.strip.rng = np.random.default_rng(9)
        for frame in range(6):
            image = grey(film.strip.picture(film.curvatures[frame], 2.0))
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if colour else image
            if frame == 0:
                tracker.start(image, film.truth[0], film.strip.edges)
            else:
                result.append(tracker.track(image).pixels)
        return np.stack(result)

    assert np.array_equal(tracks(True), tracks(False))
    assert np.array_equal(tracks(True), tracks(True))


def test_what_cannot_be_tracked_is_refused(film):
    image = grey(film.strip.picture(film.curvatures[0]))
    tracker = GridTracker()
    with pytest.raises(ZsdtError, match="call start"):
        tracker.track(image)
    with pytest.raises(DataError, match="outside"):
        tracker.start(image, film.truth[0] + 400.0, film.strip.edges)
    with pytest.raises(DataError, match="contrast"):
        tracker.start(np.full_like(image, 90), film.truth[0], film.strip.edges)
    with pytest.raises(DataError, match="edge"):
        tracker.start(image, film.truth[0], film.strip.edges + 1)
    for wrong in ({"window": 20}, {"least_score": 0.3}, {"reach": 0.0}, {"flow_levels": 9}):
        with pytest.raises(OptionError):
            TrackerOptions(**wrong)
