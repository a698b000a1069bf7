"""A clip shows what its truth says, through a camera, a material, a mesh and a load that differ from what is told."""

import json
from dataclasses import replace

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.lab.beam_lab import (
    BeamLabOptions,
    ClipPlan,
    Side,
    Storage,
    hidden_material,
    hidden_mesh,
    node_grid,
    plan_clips,
    simulate_hidden,
    slow_noise,
    tip_motion,
    trained_sizes,
)
from zsdt.lab.beam_painter import shaken
from zsdt.lab.clips import ClipSet, make_clip, make_clips, read_clip
from zsdt.perception.camera import ClampSide
from zsdt.perception.depth import look_up, open_depth_maps
from zsdt.scene import BeamShape, Foam
from zsdt.solid.loads import LoadOptions, Regime
from zsdt.solid.sampler import SizeRange, SynthesisOptions, plan

TINY = BeamLabOptions(
    clips=1,
    frames=5,
    width=320,
    height=180,
    sizes=SizeRange([35, 35], [10, 10], [10, 10]),
    hand_fraction=0.0,
    motion=0.0,
    mesh_cm=[5.0],
    storage=Storage.png,
    depth_maps=True,
    mask_every=2,
    seed=3,
)


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab") / "clips"
    figures = make_clips(TINY, folder)
    assert figures["clips"] == figures["made"] == 1
    return ClipSet(folder)


def test_the_video_shows_the_truth(clips) -> None:
    clip = clips[0]
    frames = list(clip.source())
    assert len(frames) == clip.truth.frames == 5 and frames[3].time == pytest.approx(clip.truth.times[3])
    ids = node_grid(clip.truth.body, clip.clamp_side)["near"]
    assert clip.pixels.shape == (5, *ids.shape, 2)
    for frame in range(5):
        camera = shaken(clip.true_camera, np.array(clip.hidden["shake_rad"][frame]))
        expected = camera.project(clip.truth.fields["position"][frame][ids.ravel()]).reshape(*ids.shape, 2)
        np.testing.assert_allclose(clip.pixels[frame], expected, atol=1e-3)  # the truth is kept in single precision
    for frame in (0, 2, 4):
        grid, beam = clip.masks(frame)
        u, v = np.rint(clip.pixels[frame][1:-1, 1:-1]).astype(int).reshape(-1, 2).T
        assert (grid[v, u] > 100).all() and (beam[v, u] == 255).all()
        line = frames[frame].image[grid > 220].mean(axis=0)
        foam = frames[frame].image[(grid < 10) & (beam > 250)].mean(axis=0)
        assert np.abs(line - foam).max() > 15
    with pytest.raises(DataError, match="mask_every"):
        clip.masks(1)


def test_depth_maps_and_pixels_give_the_nodes_back(clips) -> None:
    clip = clips[0]
    assert clip.depth is not None
    maps = open_depth_maps(clip.depth)
    assert maps is not None and len(maps) == 5
    ids = node_grid(clip.truth.body, clip.clamp_side)["near"].ravel()
    for frame in (0, 4):
        camera = shaken(clip.true_camera, np.array(clip.hidden["shake_rad"][frame]))
        pixels, points = clip.pixels[frame].reshape(-1, 2), clip.truth.fields["position"][frame][ids]
        found = look_up(maps.frame(frame), pixels, 9.0, clip.depth)
        assert found.missing == 0
        error = np.linalg.norm(camera.at_depth(pixels, found.depth) - points, axis=1)
        assert np.median(error) < 0.001 and error.max() < 0.005  # noise of 1 mm a pixel


def test_what_is_told_is_not_what_is(clips) -> None:
    clip = clips[0]
    assert clip.scene.material == Foam() and clip.scene.clamp_side == "auto"
    factors = clip.hidden["factors"]
    assert set(factors) == {"young", "g1", "tau", "density"}
    material = clip.truth.body.material
    for name, factor in factors.items():
        assert 0.8 <= factor <= 1.2
        assert getattr(material, name) == pytest.approx(getattr(Foam(), name) * factor)
    assert clip.hidden["mesh"] == pytest.approx(0.05)
    points = clip.truth.fields["position"][0]
    gap = np.linalg.norm(clip.camera.project(points) - clip.true_camera.project(points), axis=1)
    assert 0.01 < gap.max() < 5.0
    ids = node_grid(clip.truth.body, clip.clamp_side)["near"].ravel()
    assert clip.scene.depth == pytest.approx(clip.true_camera.depths(clip.truth.body.points[ids]).mean(), rel=0.01)
    assert clip.truth.meta["virtual_lab"] is True
    # A load that scene.json does not mention, on a beam that hangs at rest in the first frame.
    assert np.abs(clip.truth.load[0]).max() == 0 and np.abs(clip.truth.load).max() > 0.01
    assert np.abs(clip.truth.fields["velocity"][0]).max() < 1e-3 < np.abs(clip.truth.fields["velocity"]).max()
    told = json.loads((clip.folder / "scene.json").read_text())
    assert not {"load", "style", "factors"} & set(told)


def test_same_seed_same_clip(clips, tmp_path) -> None:
    make_clip(plan_clips(TINY)[0], TINY, tmp_path / "again")
    for path in sorted(p for p in clips[0].folder.rglob("*") if p.is_file() and p.suffix != ".h5"):
        again = tmp_path / "again" / path.relative_to(clips[0].folder)
        assert path.read_bytes() == again.read_bytes(), path.name
    truth = read_clip(tmp_path / "again").truth
    np.testing.assert_array_equal(truth.fields["stress"], clips[0].truth.fields["stress"])


def test_a_set_is_resumed_and_never_mixed(clips) -> None:
    assert make_clips(TINY, clips.folder)["made"] == 0
    with pytest.raises(DataError, match="other options"):
        make_clips(replace(TINY, seed=4), clips.folder)


def test_broken_clips_say_so(clips, tmp_path) -> None:
    with pytest.raises(DataError, match="no clips"):
        ClipSet(tmp_path)
    with pytest.raises(DataError, match="no clip"):
        read_clip(tmp_path)
    (tmp_path / "scene.json").write_text('{"schema": "zsdt.clip", "schema_version": 99}')
    with pytest.raises(DataError, match="version 99"):
        read_clip(tmp_path)
    (tmp_path / "scene.json").write_text("not json")
    with pytest.raises(DataError, match="broken"):
        read_clip(tmp_path)
    (tmp_path / "scene.json").write_text((clips[0].folder / "scene.json").read_text().replace('"depth"', '"deep"'))
    with pytest.raises(DataError, match="does not describe"):
        read_clip(tmp_path)


def test_materials_differ_by_at_most_the_mismatch() -> None:
    options = BeamLabOptions(mismatch=0.2)
    drawn = np.array(
        [list(hidden_material(ClipPlan(k, (35, 10, 10), Regime.hand), options)[1].values()) for k in range(200)]
    )
    assert np.abs(drawn - 1).max() <= 0.2 and np.abs(drawn - 1).max() > 0.19
    assert np.abs(drawn.mean(axis=0) - 1).max() < 0.03 and np.abs(np.corrcoef(drawn.T) - np.eye(4)).max() < 0.25
    fixed = hidden_material(ClipPlan(0, (35, 10, 10), Regime.hand), replace(options, signs=[-1, 1, 0, 1]))[1]
    np.testing.assert_allclose(list(fixed.values()), [0.8, 1.2, 1.0, 1.2])


def test_meshes_divide_the_beam_and_stay_affordable() -> None:
    options = BeamLabOptions()
    assert hidden_mesh((35, 10, 10), options) == pytest.approx(0.05 / 3)
    assert hidden_mesh((80, 40, 40), options) == pytest.approx(0.025)
    with pytest.raises(OptionError, match="mesh_cm"):
        hidden_mesh((35, 10, 10), replace(options, mesh_cm=[3.0]))


def test_plans_take_sizes_that_were_not_trained_on() -> None:
    trained = trained_sizes(SynthesisOptions())
    assert len(trained) == len({j.size_cm for j in plan(SynthesisOptions()) if j.split in ("train", "val")})
    plans = plan_clips(BeamLabOptions(clips=20, exclude_cm=trained))
    assert not [p for p in plans if list(p.size_cm) in trained]
    assert len({p.size_cm for p in plans}) == 20
    assert sum(p.regime is Regime.hand for p in plans) == 10
    with pytest.raises(OptionError, match="exclude_cm"):
        plan_clips(replace(TINY, exclude_cm=[[35, 10, 10]]))
    # Beams that no load bends visibly, or that swing too fast for the camera, are not filmed.
    with pytest.raises(OptionError, match="moves visibly"):
        plan_clips(BeamLabOptions(sizes=SizeRange([40, 40], [30, 30], [30, 30])))
    with pytest.raises(OptionError, match="slowly enough"):
        plan_clips(BeamLabOptions(sizes=SizeRange([35, 35], [10, 10], [20, 20]), hand_fraction=0.0))


def test_the_tip_moves_as_beam_theory_says() -> None:
    """A slow load on a beam of the lab, against the estimate by which loads are chosen."""
    options = replace(
        TINY,
        frames=3,
        fps=0.5,
        hand_fraction=1.0,
        mismatch=0.0,
        motion=0.01,
        max_step=1.0,
        sizes=SizeRange([50, 50], [10, 10], [10, 10]),
        mesh_cm=[2.5],
        loads=LoadOptions(demand_limit=0.6),
    )
    truth = simulate_hidden(plan_clips(options)[0], options)
    load = truth.load[..., 2].sum(axis=1)
    lever = float((truth.load[..., 2] * truth.body.points[:, 0]).sum(axis=1)[-1] / load[-1])
    expected = tip_motion(BeamShape(0.5, 0.1, 0.1), Foam(), float(load[-1] - load[0]), lever)
    tip = truth.fields["position"][:, truth.body.points[:, 0] > 0.5 - 1e-9, 2].mean(axis=1)
    assert abs(expected) > 0.01
    assert tip[-1] - tip[0] == pytest.approx(expected, rel=0.3)  # the estimate knows no gravity and no large rotation


def test_the_visible_face_depends_on_the_side_of_the_clamp(clips) -> None:
    body = clips[0].truth.body
    for side, depth in ((ClampSide.left, 0.0), (ClampSide.right, 0.1)):
        grid = node_grid(body, side)
        near = body.points[grid["near"]]
        np.testing.assert_allclose(near[..., 1], depth)
        np.testing.assert_allclose(body.points[grid["far"]][..., 1], 0.1 - depth)
        np.testing.assert_allclose(near[..., 0], np.arange(8)[:, None] * 0.05 + np.zeros(3), atol=1e-12)
        np.testing.assert_allclose(near[..., 2], np.arange(3) * 0.05 + np.zeros((8, 1)), atol=1e-12)
    assert Side(clips[0].clamp_side.value) is not Side.random


def test_shaking_has_the_wanted_size_and_memory() -> None:
    values = slow_noise(np.random.default_rng(0), 20000, 1, memory=0.8)[:, 0]
    assert values.std() == pytest.approx(1.0, abs=0.05)
    assert np.corrcoef(values[1:], values[:-1])[0, 1] == pytest.approx(0.8, abs=0.03)


@pytest.mark.parametrize(
    "wrong",
    [
        {"mismatch": 0.7},
        {"signs": [1, 1]},
        {"shutter": [0.5, 0.1]},
        {"frames": 1},
        {"mesh_cm": []},
        {"jitter_px": -1.0},
    ],
)
def test_options_that_make_no_sense_are_refused(wrong) -> None:
    with pytest.raises(OptionError):
        BeamLabOptions(**wrong)
