"""What a planner can choose really changes the twin, and only that: cells, one layer, cadence, decoded fields."""

from dataclasses import replace

import numpy as np
import pytest

from tests.twin.beam_clips import (
    FPS,
    SIDE,
    DrawnSegmenter,
    DrawnVideo,
    KnowingTracker,
    cell_clip,
    cell_engine,
    rms,
    scene_of,
    twin_on,
)
from tests.twin.glass_films import CAMERA, T0, FilmSegmenter, FilmSource
from tests.twin.liquid_scenes import TOLD, reality
from tests.twin.liquid_scenes import engine as liquid_engine
from zsdt.errors import DataError, OptionError
from zsdt.perception.grid_graph import ClampChoice, GridOptions
from zsdt.planning.choices import BeamChoice, GlassChoice, with_cadence
from zsdt.planning.on_truth import between_nodes
from zsdt.scene import Liquid
from zsdt.tignn.cell_engine import CellEngine
from zsdt.twin.assimilation import AssimilationOptions
from zsdt.twin.beam_graph import beam_body, build_beam_graph, front_nodes_of, thinned
from zsdt.twin.glass_graph import GlassGraphOptions
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.loop import LoopMode, TwinOptions, run_twin

FRAMES = 40
LEFT = GridOptions(clamp_side=ClampChoice.left)
PLANAR = dict(width=0.1, planar=True)


@pytest.fixture(scope="module")
def clip():
    return cell_clip(columns=7, rows=3, frames=FRAMES)


PLAIN = BeamChoice()


def run(clip, choice=PLAIN, fields=("velocity",), width=0.1, **options):
    scene = choice.scene(scene_of(width, planar=True, fields=list(fields)))
    loop = with_cadence(TwinOptions(grid=LEFT, **options), choice)
    pixels = clip.pixels[:, :: scene.stride, :: scene.stride].reshape(clip.frames, -1, 2)
    tracker = KnowingTracker(pixels + 0.05 * np.random.default_rng(3).standard_normal(pixels.shape))
    log = run_twin(
        DrawnVideo(clip.frames), DrawnSegmenter(clip), scene, loop, camera=clip.camera, engine=cell_engine(),
        tracker=tracker,
    )  # fmt: skip
    return log, tracker


def off(clip, log, any_width=False):
    weights = between_nodes(log.body, clip.body.points, any_width)
    moved = np.stack([weights @ (p - log.body.points) for p in log.positions])
    return rms((moved - (clip.position - clip.body.points))[1:, clip.free])


def test_finer_and_coarser_cells_see_the_same_painted_nodes(clip):
    for cells, cell, counts in ((2.0, 0.025, (13, 5, 5)), (0.5, 0.1, (4, 2, 2))):
        scene = BeamChoice(cells).scene(scene_of(**PLANAR))
        grid = thinned(clip.grid(), scene.stride)
        graph = build_beam_graph(grid, clip.camera, scene, FPS)
        assert graph.body.pitch == pytest.approx(cell) and graph.body.nodes == np.prod(counts)
        painted = clip.body.points[clip.front][:: scene.stride, :: scene.stride]
        np.testing.assert_allclose(graph.body.points[graph.front_nodes], painted, atol=1e-9)
        seen = clip.position[0][clip.front][:: scene.stride, :: scene.stride]
        np.testing.assert_allclose(graph.positions, seen, atol=5e-4)
        assert float(graph.body.mass.sum()) == pytest.approx(float(clip.body.mass.sum()))


def test_cells_that_do_not_fit_are_refused(clip):
    with pytest.raises(DataError, match="cannot be cut"):
        thinned(cell_clip(columns=6, rows=3, frames=1).grid(), 2)
    with pytest.raises(OptionError, match="neither a whole part nor a whole multiple"):
        scene_of(cell=0.03)


def test_one_layer_tells_load_and_energy_of_the_whole_width(clip):
    whole, _ = run(clip)
    layer, _ = run(clip, BeamChoice(1.0, one_layer=True))
    slice_, _ = run(clip, BeamChoice(1.0, one_layer=True), width=0.05)
    assert layer.body.nodes * 3 == whole.body.nodes * 2
    np.testing.assert_array_equal(layer.positions, slice_.positions)
    np.testing.assert_allclose(layer.load, 2.0 * slice_.load)
    for name, joules in layer.account.items():
        np.testing.assert_allclose(joules, 2.0 * slice_.account[name])
    assert np.ptp(layer.account["elastic"]) == pytest.approx(np.ptp(whole.account["elastic"]), rel=0.2)
    moved = rms((clip.position - clip.position[0])[1:, clip.free])
    assert off(clip, layer, any_width=True) < 0.1 * moved


def test_one_layer_does_not_fall_over_sideways():
    thin = cell_clip(columns=7, rows=3, width=0.05, frames=2)
    twin = twin_on(thin, AssimilationOptions(), planar=True)
    before = twin.position.copy()
    twin.state.velocity[~twin.body.clamped] += [0.0, 1.0, 0.0]  # somebody blows at it
    for _ in range(5):
        twin.predict()
    assert twin.partner is not None
    middle = 0.5 * (twin.position[:, 1] + twin.position[twin.partner, 1])
    np.testing.assert_allclose(middle, 0.025, atol=1e-12)
    assert np.abs(twin.position - before)[:, [0, 2]].max() < 5e-3
    wide = twin_on(cell_clip(columns=7, rows=3, width=0.1, frames=2), AssimilationOptions(), planar=True)
    assert wide.partner is None


def test_every_third_look_is_enough_to_stay_with_the_beam(clip):
    log, tracker = run(clip, BeamChoice(look_every=3))
    opened, _ = run(clip, BeamChoice(), mode=LoopMode.open)
    assert tracker.calls == len(range(3, FRAMES, 3))
    assert log.status[1:7] == ["unlooked", "unlooked", "corrected"] * 2 and not log.faults()
    assert off(clip, log) < 0.3 * off(clip, opened)
    assert np.isnan(log.innovation[4]).all() and not log.taken[4].any()
    np.testing.assert_array_equal(log.seen[4], log.seen[3])
    assert np.isnan(log.latency["track"][4]) and log.latency["track"][3] > 0
    assert (log.load[10:, 2] != 0).all()  # the estimated load goes on between looks


def test_a_glass_is_segmented_at_every_third_frame_only():
    def seen_by(look_every):
        segmenter = FilmSegmenter()
        choice = GlassChoice(particles=120, look_every=look_every)
        options = with_cadence(GlassTwinOptions(graph=GlassGraphOptions(packing=40)), choice)
        scene = choice.scene(GlassTwinScene(Liquid(viscosity=TOLD), fields=["velocity"]))
        log = run_glass_twin(
            FilmSource(frames=T0 + 13), segmenter, scene, options, camera=CAMERA, engine=liquid_engine()
        )
        return log, segmenter

    every, often = seen_by(1)
    third, rarely = seen_by(3)
    after = np.array(third.status[third.start + 1 :])
    assert rarely.calls < often.calls and not third.faults()
    assert 0.4 < np.mean(after == "unlooked") < 0.7
    assert third.start == every.start and third.count == every.count
    apart = np.abs(third.level - every.level).max()
    assert apart < 0.25 * np.ptp(every.level)


def test_a_softer_liquid_takes_fewer_substeps_and_leaves_its_owner_alone():
    engine = liquid_engine()
    half = GlassChoice(sound=0.5).engine(engine)
    assert half.options.sound_speed == 0.5 * engine.options.sound_speed and half is not engine
    body = reality().body
    engine.prepare(body)
    half.prepare(body)
    assert half.steps == pytest.approx(engine.steps / 2, abs=1)


def test_stress_is_computed_only_where_it_is_wanted(clip, monkeypatch):
    def never(engine, state):
        raise AssertionError("stress was decoded")

    monkeypatch.setattr(CellEngine, "_stress", never)
    log, _ = run(clip, fields=("velocity", "position"), frames=6)
    assert list(log.fields) == ["velocity", "position"]
    with pytest.raises(AssertionError, match="stress was decoded"):
        run(clip, fields=("von_mises",), frames=6)


def test_beam_bodies_of_all_choices_weigh_the_same_per_width():
    for cells in (0.5, 1.0, 2.0):
        for one_layer in (False, True):
            scene = BeamChoice(cells, one_layer).scene(replace(scene_of(width=0.2, planar=True)))
            body = beam_body(4 // scene.stride + 1, 2 // scene.stride + 1, scene, FPS)
            assert scene.copies * body.mass.sum() == pytest.approx(0.2 * 0.2 * 0.1 * scene.material.density)
            front = front_nodes_of(body, SIDE, scene.refinement)
            assert front.shape == (4 // scene.stride + 1, 2 // scene.stride + 1)
