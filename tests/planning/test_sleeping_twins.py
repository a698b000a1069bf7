"""Twins of bodies at rest sleep: they stay where they are seen, wake in the frame in which they are not, and hide no
more than they may."""

import numpy as np
import pytest

from tests.planning.test_choices_in_twins import LEFT
from tests.twin.beam_clips import FPS, DrawnSegmenter, DrawnVideo, KnowingTracker, cell_clip, cell_engine, scene_of
from zsdt.tignn.sleep import Sleeper, SleepOptions
from zsdt.twin.loop import LoopMode, TwinOptions, run_twin

REST, AGAIN, FRAMES = 30, 110, 130
SLEEP = SleepOptions(still=3e-4, calm=0.3, wake=1e-3)


def two_pushes(times):
    """Up and down again within half a second, and once more much later."""

    def push(start):
        return np.where((times > start) & (times < start + 0.5), np.sin(np.pi * (times - start) / 0.5) ** 2, 0.0)

    return push(0.0) + push(AGAIN / FPS)


@pytest.fixture(scope="module")
def clip():
    return cell_clip(columns=7, rows=3, frames=FRAMES, history=two_pushes)


def run(clip, sleep, **options):
    loop = TwinOptions(grid=LEFT, sleep=sleep, **options)
    tracker = KnowingTracker(clip.tracked(0.05))
    scene = scene_of(planar=True, fields=["velocity"])
    return run_twin(
        DrawnVideo(clip.frames), DrawnSegmenter(clip), scene, loop, camera=clip.camera, engine=cell_engine(),
        tracker=tracker,
    )  # fmt: skip


def test_a_beam_twin_sleeps_between_two_pushes_and_wakes_with_the_second(clip):
    awake, slept = run(clip, SleepOptions()), run(clip, SLEEP)
    status = np.array(slept.status)
    assert "asleep" not in awake.status and not slept.faults()
    assert (status[:REST] == "corrected").sum() == REST - 1  # not while it swings
    assert (status[REST:AGAIN] == "asleep").sum() > 30
    apart = np.abs(slept.positions - awake.positions).max(axis=(1, 2))
    assert apart[:AGAIN].max() < SLEEP.wake
    moved = np.abs(clip.position - clip.position[AGAIN - 1]).max(axis=(1, 2))
    late = AGAIN + int(np.flatnonzero(moved[AGAIN:] > 2 * SLEEP.wake + SLEEP.still)[0])
    assert (status[late:] == "corrected").all()  # in the very frame in which it can be seen
    assert apart[late + 5 :].max() < SLEEP.wake
    asleep = np.flatnonzero(status == "asleep")
    assert np.isnan(slept.latency["predict"][asleep]).all() and (slept.latency["track"][asleep] > 0).all()
    assert (slept.fields["velocity"][asleep] == 0).all()


def test_the_account_closes_over_a_sleep(clip):
    account = run(clip, SLEEP).account
    balance = account["kinetic"] + account["elastic"] + account["dissipated"] - account["work_of_ports"]
    assert np.ptp(balance) < 0.02 * np.ptp(account["elastic"])


def test_an_open_loop_sleeps_once_it_rests(clip):
    log = run(clip, SLEEP, mode=LoopMode.open)
    assert set(log.status[1:]) == {"open_loop"}
    assert np.isnan(log.latency["predict"][-60:]).all()  # it knows of no push
    assert np.ptp(log.positions, axis=0).max() < SLEEP.still


def test_what_is_seen_elsewhere_wakes():
    sleeper = Sleeper(SleepOptions(still=1e-3, calm=0.1, wake=1e-3), 0.1)
    far = np.array([2e-3, np.nan, 2e-3])  # a camera that is a bit off all the time
    place = np.zeros((3, 3))
    while not sleeper.asleep:
        sleeper.note(place, far)
    assert not sleeper.is_disturbed(far) and not sleeper.is_disturbed(np.full(3, np.nan))
    assert not sleeper.is_disturbed(far + 0.9e-3) and sleeper.is_disturbed(far + 1.1e-3)
