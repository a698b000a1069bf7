"""The loop of the glass over a film: where it begins, what it does with each frame, and what it survives."""

from dataclasses import replace

import numpy as np
import pytest

from tests.twin.glass_films import CAMERA, COUNT, RAMP_FRAMES, T0, FilmSegmenter, FilmSource, film
from tests.twin.liquid_scenes import FPS, LEVEL, RADIUS, SHAPE, SPEED, TOLD, engine, reality
from zsdt.errors import DataError
from zsdt.fluid.coarsening import interpolate
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid
from zsdt.twin.glass_graph import GlassGraphOptions
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.liquid_assimilation import LiquidAssimilationOptions
from zsdt.twin.liquid_history import FirstState
from zsdt.twin.loop_common import Clock, LoopMode

SHARE = 0.4


class WrongStart:
    """A Psi_ini that thinks too little of the motion."""

    def infer_fields(self, body, positions):
        true = reality()
        velocity = interpolate(positions, true.position[0], true.velocity[0], true.body.pitch)[0]
        self.motion = body.motion
        return {"velocity": SHARE * velocity, "internal_energy": np.zeros((len(positions), 1))}


def choices(**more):
    """What is seen is good, and Psi_ini is told to be doubtful."""
    trust = LiquidAssimilationOptions(noise=1e-3, steep_noise=0.1, first_rate=0.5)
    more = {"first_state": FirstState.psi_ini, **more}
    return GlassTwinOptions(assimilation=trust, graph=GlassGraphOptions(packing=40), **more)


def run(source=None, spoil=None, psi_ini=None, options=None, scene=None, **more):
    segmenter = FilmSegmenter(spoil)
    log = run_glass_twin(
        source or FilmSource(), segmenter,
        scene or GlassTwinScene(Liquid(viscosity=TOLD), particles=250, fields=["velocity"]),
        options or choices(), camera=CAMERA, engine=engine(), psi_ini=psi_ini or WrongStart(), **more,
    )  # fmt: skip
    return log, segmenter


def off(log):
    """Vertical velocity error at the true particles, and surface error [m] by frame."""
    true, wrong, whole, level = reality(), 0.0, 0.0, []
    for row in range(log.count - log.start):
        k = int(log.frames[log.start + row]) - T0
        if not 0 < k < len(true.position):
            continue
        ours = interpolate(
            true.position[k],
            log.positions[row].astype(float),
            log.fields["velocity"][row].astype(float),
            log.body.pitch,
        )[0]
        wrong += float(((ours - true.velocity[k])[:, 2] ** 2).sum())
        whole += float((true.velocity[k][:, 2] ** 2).sum())
        height = np.interp(log.places[:, 0], true.places[:, 0], true.height[k])
        level.append(float(np.sqrt(np.mean((log.level[row] - height) ** 2))))
    return np.sqrt(wrong / whole), np.array(level)


@pytest.fixture(scope="module")
def closed():
    psi_ini = WrongStart()
    return (*run(psi_ini=psi_ini), psi_ini)


@pytest.fixture(scope="module")
def opened():
    return run(options=choices(mode=LoopMode.open))


def test_it_begins_where_the_glass_stops_and_catches_up(closed, opened):
    log, segmenter, psi_ini = closed
    assert abs(int(log.frames[log.start]) - T0) <= 1 and segmenter.calls >= COUNT
    assert log.status[log.start] == "started" and set(log.status[log.start + 1 :]) == {"corrected"}
    assert {"moving"} <= set(log.status[: log.start]) <= {"waiting", "moving"}
    assert opened[0].status[-1] == "open_loop" and opened[1].calls < segmenter.calls  # nobody looks in vain
    assert abs(np.abs(psi_ini.motion.velocity[:, 0]).max() - SPEED) < 0.05 * SPEED
    assert float(log.body.mass.sum()) / 1261.0 == pytest.approx(Vessel(SHAPE).volume(LEVEL), rel=0.02)
    assert RAMP_FRAMES < T0


def test_what_is_seen_mends_what_is_not(closed, opened):
    with_eyes, blind = off(closed[0]), off(opened[0])
    assert with_eyes[0] < 0.7 * blind[0]
    assert np.sqrt((with_eyes[1][3:] ** 2).mean()) < 0.02 * LEVEL
    assert 0.8 < closed[0].viscosity[-1] < 1.4


def test_the_log_says_everything_of_every_frame(closed):
    log, shown = closed[0], []
    again, _ = run(options=choices(beside=False), sink=lambda r, image: shown.append((r.index, image is not None)))
    assert shown == [(k, True) for k in range(COUNT)]
    np.testing.assert_array_equal(again.positions, log.positions)  # the same to the last bit, threads or not
    rows = log.count - log.start
    assert log.positions.shape == (rows, log.body.nodes, 3) and log.positions.dtype == np.float32
    assert log.level.shape == log.seen_level.shape == (rows, len(log.places)) and log.seen_px.shape[2] == 2
    assert np.isfinite(log.seen_level).mean() > 0.9 and np.nanmax(np.abs(log.innovation[3:])) < 0.01
    assert len(log.outline) == len(log.origin) == log.count and log.outline[-1].shape[1] == 2
    assert np.abs(log.origin[log.start :, 0]).max() < 2e-3 and log.origin[0, 0] < -0.04
    assert {"predict", "segment", "observe", "correct", "decode", "total"} <= set(log.latency_table())
    assert set(log.start_ms) == {"fit", "graph", "prepare", "begin", "catch_up"}
    assert np.ptp(log.volume) < 0.05 * log.volume[0]
    account = log.account
    balance = account["kinetic"] + account["potential"] + account["internal"]
    balance = balance - account["work_of_ports"] - account["integrator"]
    assert np.ptp(balance) < 1e-8 * np.abs(account["potential"]).max()


def test_bad_frames_are_predicted_over_and_named_and_of_two_glasses_the_larger_is_followed(closed):
    lost, dark = [T0 + 7, T0 + 8, 3], [T0 + 10, T0 + 11]

    def other(frame, container, liquid):
        container[150:200, 8:40] = 255
        liquid[170:200, 12:36] = 255

    log, _ = run(FilmSource(lost=lost, dark=dark), other)
    assert log.count == COUNT and log.frames.tolist() == list(range(COUNT))
    assert [k for k, s in enumerate(log.status) if s == "missing"] == sorted(lost)
    assert [k for k, s in enumerate(log.status) if s == "dark"] == dark
    assert log.faults() == {"missing": 3, "dark": 2}
    assert off(log)[0] < 1.6 * off(closed[0])[0]
    assert log.status[-1] == "corrected" and np.abs(log.origin[log.start :, 0]).max() < 2e-3


def test_a_hand_costs_places_and_a_vanished_glass_costs_frames(closed):
    def hand(frame, container, liquid):
        if T0 + 8 <= frame < T0 + 13:
            middle = int(np.flatnonzero(container.max(axis=0)).mean())
            container[:, middle + 10 :] = 0
            liquid[:, middle + 10 :] = 0
        if T0 + 15 <= frame < T0 + 18:
            container[:], liquid[:] = 0, 0
        if frame == T0 + 19:
            liquid[:] = 0

    log, _ = run(spoil=hand)
    status = log.status
    assert all(status[T0 + k] == "no_glass" for k in (15, 16, 17)) and status[T0 + 19] == "empty"
    assert status[-1] == "corrected" and np.isfinite(log.positions).all()
    assert off(log)[0] < 2.0 * off(closed[0])[0]
    away = log.positions.reshape(-1, 3).astype(float)
    assert Vessel(log.body.vessel).distance(away).min() > -1e-4


@pytest.mark.parametrize(
    ("kind", "words"),
    [("none", "No glass was seen"), ("empty", "is empty"), ("still", "never moved"), ("on", "comes to rest")],
)  # fmt: skip
def test_films_without_a_beginning_are_told_in_words(kind, words):
    def spoil(frame, container, liquid):
        if kind == "none":
            container[:] = 0
        if kind in ("none", "empty"):
            liquid[:] = 0
        if kind == "still":
            container[:], liquid[:] = film()[-1]

    with pytest.raises(DataError, match=words):
        run(FilmSource(frames=T0 - 1 if kind == "on" else COUNT), spoil)


def test_a_glass_that_stands_may_begin_at_rest():
    def spoil(frame, container, liquid):
        container[:], liquid[:] = film()[-1]

    class Rest:
        def infer_fields(self, body, positions):
            return {"velocity": np.zeros_like(positions), "internal_energy": np.zeros((len(positions), 1))}

    log, _ = run(FilmSource(frames=14), spoil, Rest(), choices(still_start=6, keep_fields=False))
    assert log.fields == {}
    assert 4 <= log.start <= 7 and np.abs(log.level - log.level[0]).max() < 4e-3


class SlowClock(Clock):
    """Every look at the clock takes time."""

    def __init__(self, step):
        self.time, self.step = 0.0, step

    def now(self):
        self.time += self.step
        return self.time

    def wait(self, seconds):
        self.time += max(seconds, 0.0)


def test_late_frames_are_predicted_but_not_corrected():
    options = choices(realtime=True, beside=False)
    log, segmenter = run(FilmSource(frames=T0 + 14), options=options, clock=SlowClock(0.004))
    assert log.status.count("deadline") > 3 and log.count == T0 + 14 and segmenter.calls < T0 + 14
    assert replace(options).realtime
    assert FPS == 60.0 and RADIUS < LEVEL
