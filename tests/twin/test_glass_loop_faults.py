"""Faults in front of the glass twin, and what it makes of them: each is put into a film whose truth is known."""

import numpy as np
import pytest

from tests.twin.glass_films import CAMERA, T0, FilmSegmenter, FilmSource
from tests.twin.liquid_scenes import FPS, FRAMES, LEVEL, NUDGE, TOLD, engine, reality
from zsdt.fluid.coarsening import interpolate
from zsdt.scene import Liquid
from zsdt.twin.glass_graph import GlassGraphOptions
from zsdt.twin.glass_loop import GlassTwinOptions, _Run, run_glass_twin
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.loop_common import LoopMode

TURN = {T0 + 8 + k: turn for k, turn in enumerate((6, 18, 30, 36, 36, 36, 30, 18, 6))}


def run(source=None, segmenter=None, viscosity=TOLD, **options):
    return run_glass_twin(
        source or FilmSource(), segmenter or FilmSegmenter(),
        GlassTwinScene(Liquid(viscosity=viscosity), particles=250, fields=["velocity"]),
        GlassTwinOptions(graph=GlassGraphOptions(packing=40), **options), camera=CAMERA, engine=engine(),
    )  # fmt: skip


def off(log, again=False, since=1):
    """Vertical velocity error over the truth, and root mean square error of the surface [m], from t0 + `since` on."""
    true, wrong, whole, level = reality(again=again), 0.0, 0.0, []
    for row in range(log.count - log.start):
        k = int(log.frames[log.start + row]) - T0
        if not since <= k < FRAMES:
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
    return np.sqrt(wrong / whole), float(np.sqrt(np.mean(np.square(level))))


@pytest.fixture(scope="module")
def closed():
    return run()


def test_the_carried_liquid_begins_right_and_is_not_spoilt_by_what_is_seen(closed):
    blind = off(run(mode=LoopMode.open))
    seeing = off(closed)
    assert blind[0] < 0.35 and blind[1] < 0.03 * LEVEL  # nothing but the vessel's motion was told
    assert seeing[0] < 1.05 * blind[0] and seeing[1] < 0.02 * LEVEL


def test_a_liquid_twice_as_thick_as_told_is_found_out():
    told = 2.0 * TOLD
    blind, seeing = run(viscosity=told, mode=LoopMode.open), run(viscosity=told)
    assert off(seeing)[0] < 0.85 * off(blind)[0] and off(seeing)[1] < 0.8 * off(blind)[1]
    assert seeing.viscosity[-1] < 0.9


def test_a_camera_that_turns_moves_no_liquid(closed):
    def spoil(frame, container, liquid):
        for part in (container, liquid):
            part[:] = np.roll(part, TURN.get(frame, 0), axis=1)

    log = run(FilmSource(turned=TURN), FilmSegmenter(spoil))
    assert "moved" not in log.status and log.faults() == {}
    assert np.abs(log.origin[log.start :, 0]).max() < 3e-3  # the picture went 36 px aside, a glass's half width
    assert off(log)[0] < 1.15 * off(closed)[0] and off(log)[1] < 0.02 * LEVEL


def test_a_glass_that_is_moved_again_takes_its_liquid_along(monkeypatch):
    log = run(segmenter=FilmSegmenter(again=True))
    assert "moved" in log.status
    told = off(log, again=True, since=NUDGE + 4)  # it is seen two frames late
    monkeypatch.setattr(_Run, "_acceleration", lambda self: None)
    deaf = off(run(segmenter=FilmSegmenter(again=True)), again=True, since=NUDGE + 4)
    assert told[0] < 0.9 * deaf[0] and told[1] < 0.5 * deaf[1]


def test_pushes_of_a_moved_glass_add_up_to_nothing_once_it_stands_again(monkeypatch):
    pushes, own = [], _Run._acceleration

    def heard(self):
        found = own(self)
        pushes.append(0.0 if found is None else float(found[0]))
        return found

    monkeypatch.setattr(_Run, "_acceleration", heard)
    run(segmenter=FilmSegmenter(again=True))
    assert max(pushes) > 1.0 and abs(sum(pushes)) / FPS < 1e-9


def test_frozen_frames_are_named_and_not_taken_for_the_liquid(closed):
    frozen = [T0 + 5, T0 + 6, T0 + 7]
    log = run(FilmSource(frozen=frozen))
    assert [k for k, s in enumerate(log.status) if s == "frozen"] == frozen
    assert off(log)[0] < 1.15 * off(closed)[0] and off(log)[1] < 1.3 * off(closed)[1]
