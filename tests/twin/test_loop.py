"""The loop over a video: what is done with each frame, what is measured, and what is not done."""

from dataclasses import replace

import numpy as np
import pytest

from tests.twin.beam_clips import (
    FPS,
    DrawnSegmenter,
    DrawnVideo,
    KnowingTracker,
    cell_clip,
    cell_engine,
    rms,
    scene_of,
)
from zsdt.errors import DataError, OptionError
from zsdt.perception.grid_graph import ClampChoice, GridOptions
from zsdt.scene import Foam
from zsdt.twin.beam_twin import BeamTwin
from zsdt.twin.loop import Clock, LoopMode, TwinOptions, run_twin

FRAMES = 40
LEFT = GridOptions(clamp_side=ClampChoice.left)  # nothing but lines is drawn, so no clamp can be found
TOLD = Foam(young=4.5e4 * 1.2)


@pytest.fixture(scope="module")
def clip():
    return cell_clip(columns=7, rows=3, frames=FRAMES)


def run(clip, options=None, scene=None, lost=(), faults=None, **more):
    options = replace(options or TwinOptions(), grid=LEFT)
    tracker = KnowingTracker(clip.tracked(0.05), faults)
    log = run_twin(
        DrawnVideo(clip.frames, lost), DrawnSegmenter(clip),
        scene or scene_of(material=TOLD, fields=["stress"]), options,
        camera=clip.camera, engine=cell_engine(), tracker=tracker, **more,
    )  # fmt: skip
    return log, tracker


def off(clip, log):
    return rms((log.positions - clip.position[: log.count])[1:, clip.free])


def test_closed_loop_from_a_drawn_grid_finds_the_beam_and_its_stress(clip):
    closed, tracker = run(clip)
    opened, idle = run(clip, TwinOptions(mode=LoopMode.open))
    assert closed.status == ["started"] + ["corrected"] * (FRAMES - 1) and opened.status[1:] == ["open_loop"] * (
        FRAMES - 1
    )
    assert tracker.calls == FRAMES - 1 and idle.calls == 0  # nothing is tracked that nobody asked for
    assert off(clip, closed) < 0.1 * off(clip, opened)
    error = [rms((log.fields["stress"] - clip.stress)[1:, clip.free]) for log in (closed, opened)]
    assert error[0] < error[1] / 3
    assert closed.load[25, 2] == pytest.approx(clip.load[25, :, 2].sum(), rel=0.3)


def test_the_log_says_everything_of_every_frame(clip):
    shown = []
    log, _ = run(clip, sink=lambda record, image: shown.append((record.index, image is not None)))
    assert shown == [(k, True) for k in range(FRAMES)]
    assert log.positions.shape == (FRAMES, log.body.nodes, 3) and list(log.fields) == ["stress"]
    assert log.predicted_px.shape == log.observed_px.shape == (FRAMES, 21, 2)
    assert np.nanmax(np.linalg.norm(log.observed_px[1:] - log.predicted_px[1:], axis=2)) < 2.0
    assert set(log.latency_table()) == {"capture", "predict", "track", "correct", "decode", "trust", "total"}
    assert set(log.start_ms) == {"segment", "graph", "begin", "tracker"}
    account = log.account
    balance = account["kinetic"] + account["elastic"] + account["dissipated"] - account["work_of_ports"]
    assert np.ptp(balance) < 0.02 * np.ptp(account["elastic"])
    assert (log.dissipated_power() >= 0).all()


def test_nothing_is_decoded_that_nobody_asked_for(clip, monkeypatch):
    asked = []
    plain = BeamTwin.fields
    monkeypatch.setattr(BeamTwin, "fields", lambda twin, names: asked.append(list(names)) or plain(twin, names))
    log, _ = run(clip, TwinOptions(frames=5), scene_of(material=TOLD, fields=[]))
    assert log.count == 5 and log.fields == {} and asked == [[]] * 5
    kept, _ = run(clip, TwinOptions(frames=5, keep_fields=False))
    assert kept.fields == {} and asked[-1] == ["stress"]


def test_lost_frames_are_predicted_over_and_named(clip):
    lost = [5, 6, 7, 20]
    log, _ = run(clip, lost=lost)
    assert log.count == FRAMES and log.frames.tolist() == list(range(FRAMES))
    np.testing.assert_allclose(log.times, np.arange(FRAMES) / FPS, atol=1e-9)
    assert [k for k, s in enumerate(log.status) if s == "missing"] == lost
    assert log.faults() == {"missing": 4}
    clean, _ = run(clip)
    assert off(clip, log) < 3 * off(clip, clean)


def test_bad_frames_are_named_and_survived(clip):
    def nothing(pixels, seen):
        return pixels, seen & False

    def half(pixels, seen):
        seen[: len(seen) // 2] = False
        return pixels, seen

    faults = {8: "dark", 9: "bright", 10: "blurred", 15: "frozen", 20: nothing, **{k: half for k in range(24, 34)}}
    log, _ = run(clip, faults=faults)
    assert log.faults() == {"occluded": 1, "dark": 1, "bright": 1, "frozen": 1, "blurred": 1}
    assert log.seen[26].sum() == 11 and log.status[26] == "corrected"
    assert not log.taken[8].any() and np.isnan(log.innovation[8]).all()
    clean, _ = run(clip)
    assert off(clip, log) < 4 * off(clip, clean)


def test_a_grid_that_shows_late_begins_late_and_one_that_never_shows_is_an_error(clip):
    class Late(DrawnSegmenter):
        tried = 0

        def probability(self, image):
            self.tried += 1
            drawn = super().probability(image)
            return drawn if self.tried > 3 else np.zeros_like(drawn)

    def begin(search):
        return run_twin(
            DrawnVideo(10), Late(clip), scene_of(material=TOLD), TwinOptions(search=search, grid=LEFT),
            camera=clip.camera, engine=cell_engine(), tracker=KnowingTracker(clip.tracked()),
        )  # fmt: skip

    assert begin(10).frames[0] == 3
    with pytest.raises(DataError, match="grid"):
        begin(2)
    with pytest.raises(DataError, match="no frame"):
        run_twin(
            DrawnVideo(0), DrawnSegmenter(clip), scene_of(), TwinOptions(), camera=clip.camera, engine=cell_engine()
        )


class Ticking(Clock):
    """A clock on which every look takes a little, and some frames' tracking takes long."""

    def __init__(self, tick):
        self.time, self.tick = 0.0, tick

    def now(self):
        self.time += self.tick
        return self.time

    def wait(self, seconds):
        self.time += seconds


def test_a_late_frame_is_predicted_but_not_corrected(clip):
    clock = Ticking(1e-4)

    def slow(pixels, seen):
        clock.time += 0.1  # six frames
        return pixels, seen

    log, tracker = run(clip, TwinOptions(realtime=True), faults={10: slow}, clock=clock)
    late = [k for k, s in enumerate(log.status) if s == "deadline"]
    assert late == [11, 12, 13, 14, 15]  # until the predictions have caught up with the video
    assert tracker.calls == FRAMES - 1 - len(late)
    assert np.isfinite(log.latency["predict"][1:]).all() and np.isnan(log.latency["track"][late]).all()
    assert clock.time > (FRAMES - 1) / FPS  # it never runs ahead of the video
    relaxed, _ = run(clip, TwinOptions(realtime=True, deadline=1.0), faults={10: slow}, clock=Ticking(1e-4))
    assert "deadline" not in relaxed.status


def test_a_video_that_stops_for_long_is_refused(clip):
    class Jump(DrawnVideo):
        def __iter__(self):
            for frame in super().__iter__():
                yield replace(frame, time=frame.time + (100.0 if frame.index > 3 else 0.0))

    with pytest.raises(DataError, match="after the one before"):
        run_twin(
            Jump(6), DrawnSegmenter(clip), scene_of(), TwinOptions(grid=LEFT), camera=clip.camera,
            engine=cell_engine(), tracker=KnowingTracker(clip.tracked()),
        )  # fmt: skip


def test_options_are_checked():
    with pytest.raises(OptionError):
        TwinOptions(search=0)
