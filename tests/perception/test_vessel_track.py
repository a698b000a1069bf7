"""Motion of the vessel and its stop, from edges and from places alone."""

import math

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.evaluation.glass_scenes import side_camera
from zsdt.fluid.motion import Excitation, VelocityChange
from zsdt.perception.mask_edges import MaskEdges
from zsdt.perception.vessel_track import Motion, RestDetector, RestOptions, VesselTracker, told_motion

FPS = 60.0
CAMERA = side_camera(distortion=np.array([-0.05, 0.0, 0.0, 0.0, 0.0]))


def edges_of(x: float, covered: float = 0.0) -> MaskEdges:
    """Edges of an upright tube of radius 37 mm about x [m]; a share of its right rows is covered by a hand."""
    height = np.linspace(0.005, 0.1, 200)
    angle = math.asin(0.037 / math.hypot(0.5, x))
    sides = []
    for sign in (-1, 1):
        bearing = math.atan2(x, 0.5) + sign * angle
        points = np.stack([0.5 * math.tan(bearing) * np.ones(200), np.zeros(200), height], axis=1)
        pixels = CAMERA.project(points)
        rows = np.arange(math.ceil(pixels[:, 1].min()), math.floor(pixels[:, 1].max()) + 1.0)
        order = np.argsort(pixels[:, 1])
        sides.append((rows, np.interp(rows, pixels[order, 1], pixels[order, 0])))
    rows = np.intersect1d(sides[0][0], sides[1][0])
    left, right = (found[np.isin(at, rows)] for at, found in sides)
    right[: int(covered * len(rows))] -= 25.0
    none = np.zeros(0)
    return MaskEdges(rows, left, right, none, none, none, none, none, none, (CAMERA.width, CAMERA.height))


def moved(
    excitation: Excitation, frames: int, lead: int, noise: float = 0.0, late: float = 0.003
) -> tuple[np.ndarray, np.ndarray]:
    """Times after t0 [s] and places [m] of a vessel in the frames of a clip, which begins `lead` frames before."""
    times = (np.arange(frames) - lead) / FPS + late
    fine = np.arange(times[0] - 0.1, times[-1] + 0.1, 2e-4)
    speed = np.array([excitation.velocity(t + excitation.duration)[0] for t in fine])
    way = np.cumsum(speed) * 2e-4
    places = np.interp(times, fine, way - way[-1])
    return times, places + noise * np.random.default_rng(0).normal(size=frames)


def stop(speed: float, ramp: float, pulse: float = 0.0) -> Excitation:
    first = (VelocityChange(0.0, pulse, (speed, 0.0, 0.0)),) if pulse else ()
    before = (0.0, 0.0, 0.0) if pulse else (speed, 0.0, 0.0)
    return Excitation(before, (*first, VelocityChange(pulse, ramp, (-speed, 0.0, 0.0))))


def test_the_axis_is_tracked_far_below_a_pixel_and_through_a_hand() -> None:
    tracker = VesselTracker(CAMERA)
    path = np.linspace(-0.06, 0.08, 40)
    found = [tracker.update(edges_of(x, 0.4 if k > 20 else 0.0)) for k, x in enumerate(path)]
    assert np.abs(np.array(found) - path).max() < 5e-5  # a pixel is half a millimetre
    nothing = np.full(0, np.nan)
    assert math.isnan(tracker.update(MaskEdges(*[nothing] * 9, (CAMERA.width, CAMERA.height))))


@pytest.mark.parametrize("speed", [0.1, -0.35, 0.6])
@pytest.mark.parametrize("ramp", [0.02, 0.08])
@pytest.mark.parametrize("pulse", [0.0, 0.1])
def test_the_stop_is_found_within_a_frame_few_frames_later(speed: float, ramp: float, pulse: float) -> None:
    times, places = moved(stop(speed, ramp, pulse), 40, 20, noise=5e-5)
    detector, told = RestDetector(), None
    for k, (t, x) in enumerate(zip(times, places, strict=True)):
        if detector.update(t, x) is Motion.rest and detector.moved_before and told is None:
            told = k
    true = int(np.argmax(times >= 0.0))
    assert detector.t0_index is not None and detector.stop is not None and told is not None
    assert abs(detector.t0_index - true) <= 1 and told - true <= 6
    assert abs(detector.stop.time) < 0.012
    assert detector.t0 == times[detector.t0_index]


def test_hysteresis_a_shaky_camera_does_not_move_a_glass_and_a_new_push_is_a_new_t0() -> None:
    detector = RestDetector()
    noise = 1.5e-4 * np.random.default_rng(1).normal(size=120)
    states = [detector.update(k / FPS, noise[k]) for k in range(60)]
    assert Motion.moving not in states and detector.t0 == 0.0 and not detector.moved_before
    times, places = moved(stop(0.4, 0.05), 60, 30)
    for k in range(60):
        detector.update(1.0 + k / FPS, places[k] + noise[60 + k])
    assert detector.state is Motion.rest and detector.t0 is not None
    assert abs(detector.t0 - (1.0 + (np.argmax(times >= 0)) / FPS)) < 1.5 / FPS


def test_missing_frames_are_survived_and_no_rest_is_invented() -> None:
    times, places = moved(stop(0.4, 0.05), 40, 20)
    places[[10, 15, 23]] = np.nan
    detector = RestDetector()
    for t, x in zip(times, places, strict=True):
        detector.update(t, x)
    assert detector.t0 is not None and abs(detector.t0) <= 1.5 / FPS
    even = RestDetector()
    assert {even.update(k / FPS, 0.3 * k / FPS) for k in range(40)} == {Motion.unknown, Motion.moving}
    with pytest.raises(OptionError, match="3 frames"):
        RestOptions(hold=2)


def test_the_told_motion_covers_the_way_that_was_seen() -> None:
    for pulse in (0.0, 0.1):
        times, places = moved(stop(0.5, 0.05, pulse), 40, 20)
        detector = RestDetector()
        for t, x in zip(times, places, strict=True):
            detector.update(t, x)
        assert detector.t0 is not None
        motion = told_motion(detector.times, detector.places, detector.stop, detector.t0, 9.81)
        assert motion.times[-1] == 0.0 and motion.velocity[-1, 0] == 0.0 and np.all(motion.gravity[:, 2] == -9.81)
        way = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(motion.times) * (
            motion.velocity[1:, 0] + motion.velocity[:-1, 0]))])  # fmt: skip
        seen = np.interp(motion.times + detector.t0, times, places)
        assert np.abs((way - way[-1]) - (seen - seen[-1])).max() < 3e-3


def test_the_told_motion_stops_when_the_vessel_did_not_when_the_next_frame_came() -> None:
    speed = 0.5
    for late in np.array([0.1, 0.3, 0.5, 0.7, 0.9]) / FPS:  # how long after the stop the first frame comes
        times, places = moved(stop(speed, 0.04), 40, 20, late=late)
        detector = RestDetector()
        for t, x in zip(times, places, strict=True):
            detector.update(t, x)
        assert detector.t0 is not None
        motion = told_motion(detector.times, detector.places, detector.stop, detector.t0, 9.81)
        last = motion.times > -3.0 / FPS
        way = np.trapezoid(motion.velocity[last, 0], motion.times[last])
        true = np.interp(detector.t0, times, places) - np.interp(detector.t0 + motion.times[last][0], times, places)
        assert abs(way - true) < 0.06 * speed / FPS  # moved to t0, the stop would be late by up to a whole frame's way
