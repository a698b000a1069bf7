"""A clip of a glass shows what its truth says, through a camera and a liquid that differ from what is told."""

from dataclasses import replace

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.fluid.motion import VelocityChange
from zsdt.lab.clip_files import Storage
from zsdt.lab.faults import Fault, FaultySource
from zsdt.lab.glass_clips import GlassClipSet, make_glass_clip, make_glass_clips
from zsdt.lab.glass_faults import GlassFaultOptions, glass_box, plan_glass_faults
from zsdt.lab.glass_lab import Contents, GlassLabOptions, draw_glass_case, plan_glass_clips
from zsdt.lab.glass_shooting import GlassShooting
from zsdt.lab.glass_surface import VolumeBelow
from zsdt.scene import Liquid, VesselFamily

TINY = GlassLabOptions(
    clips=1,
    families=[VesselFamily.tumbler],
    radius=[0.03, 0.031],
    fill=[0.03, 0.031],
    particles=[250, 400],
    lead=[3, 4],
    after=8,
    width=160,
    height=112,
    glass_px=[45.0, 50.0],
    speed=[0.4, 0.5],
    pulse_fraction=0.0,
    sign=1,
    storage=Storage.png,
    seed=5,
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab") / "clips"
    figures = make_glass_clips(TINY, folder)
    assert figures["clips"] == figures["made"] == 1
    clips = GlassClipSet(folder)
    assert len(clips) == 1 and clips.entries[0]["family"] == "tumbler"
    return clips[0]


def test_the_video_covers_the_motion_and_what_comes_after(clip) -> None:
    frames = list(clip.source())
    truth, t0 = clip.truth, clip.t0_frame
    assert len(frames) == truth.frames == len(clip.pose) == len(clip.surface) == t0 + 8
    assert t0 - 1 < clip.hidden["t0_s"] * 60.0 <= t0
    np.testing.assert_allclose(clip.pose[t0:], np.tile([0.0, 0.0, clip.scene.floor], (8, 1)), atol=1e-9)
    speed = np.diff(clip.pose[:, 0]) * 60.0
    assert 0.39 < abs(speed[0]) < 0.51 and speed[0] == pytest.approx(speed[1], rel=1e-6)
    # The liquid rests in the vessel until it brakes, then it climbs to the side to which the vessel went.
    assert np.abs(truth.fields["velocity"][:3]).max() < 0.03
    assert np.abs(truth.fields["velocity"][t0]).max() > 0.05
    centre = truth.fields["position"][:, :, 0].mean(axis=1)
    assert (centre[t0] - centre[0]) * np.sign(speed[0]) > 5e-4
    assert truth.body.motion.times[-1] == 0.0
    np.testing.assert_allclose(truth.body.motion.velocity[0, 0], speed[0], rtol=1e-6)


def test_masks_follow_the_glass(clip) -> None:
    for frame in (0, clip.t0_frame, clip.truth.frames - 1):
        container, liquid = clip.masks(frame)
        assert (liquid <= container).all() and liquid.max() == container.max() == 255
        columns = np.flatnonzero(container.max(axis=0) > 127)
        left, _, right, _ = glass_box(clip, frame)
        assert columns[0] == pytest.approx(left, abs=2.5) and columns[-1] == pytest.approx(right, abs=2.5)
    with pytest.raises(DataError, match="mask_every"):
        clip.masks(999)


def test_the_surface_keeps_the_volume(clip) -> None:
    below = VolumeBelow(clip.truth.body.vessel)
    for frame in (0, clip.t0_frame, -1):
        assert below(clip.surface[frame]) == pytest.approx(clip.hidden["volume"], rel=2e-3)
    assert np.ptp(clip.surface[0]) < 3e-4  # at rest it is flat, also where it meets the wall
    tilt = clip.surface[clip.t0_frame, -1]
    assert np.ptp(tilt) > 2e-3


def test_what_is_told_is_not_what_is(clip) -> None:
    assert clip.scene.liquid == Liquid()
    assert clip.truth.body.liquid.viscosity == pytest.approx(1.2 * Liquid().viscosity)
    assert clip.hidden["factors"] == {"viscosity": pytest.approx(1.2)}
    points = clip.pose + np.array([0.0, 0.0, 0.03])
    gap = np.linalg.norm(clip.camera.project(points) - clip.true_camera.project(points), axis=1)
    assert 0.005 < gap.max() < 3.0


def test_same_seed_same_clip(clip, tmp_path) -> None:
    make_glass_clip(plan_glass_clips(TINY)[0], TINY, tmp_path / "again")
    for path in sorted(p for p in clip.folder.rglob("*") if p.is_file() and p.suffix != ".h5"):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(clip.folder)).read_bytes(), path.name


def test_vessels_and_motions_stay_in_their_ranges() -> None:
    options = GlassLabOptions(clips=10, pulse_fraction=0.5)
    cases = [draw_glass_case(plan, options, 0) for plan in plan_glass_clips(options)]
    for plan, case in zip(plan_glass_clips(options), cases, strict=True):
        assert abs(case.factors["viscosity"] - 1.0) <= 0.2
        assert case.frames - case.t0_frame == options.after
        before = int(np.ceil(case.lead * 60.0))
        assert 12 <= before <= 17
        if plan.family is not VesselFamily.bowl:
            assert 0.06 - 1e-6 <= case.fill <= 0.0675 + 1e-6  # a part of the range that no training data are drawn from
        end = case.excitation.changes[-1]
        assert isinstance(end, VelocityChange) and end.duration >= 0.02
        np.testing.assert_allclose(case.excitation.velocity(case.excitation.duration + 1e-6), 0.0, atol=1e-12)
        # The path is the integral of the velocity.
        step = np.diff(case.places(np.array([0.3, 0.301]) * case.excitation.duration), axis=0)[0]
        speed = case.excitation.velocity(0.3005 * case.excitation.duration)
        np.testing.assert_allclose(step / (0.001 * case.excitation.duration), speed, atol=0.02)
    assert {len(case.excitation.changes) for case in cases} == {1, 2}
    with pytest.raises(OptionError, match="mismatch"):
        GlassLabOptions(mismatch=0.9)


@pytest.mark.parametrize("contents", [Contents.empty, Contents.two_glasses, Contents.no_glass])
def test_other_contents(clip, contents) -> None:
    options = replace(TINY, contents=contents)
    plan = plan_glass_clips(options)[0]
    frame = GlassShooting(plan, options, draw_glass_case(plan, options, 0), clip.truth).shoot(0)
    assert (frame.container_mask.max() > 0) == (contents is not Contents.no_glass)
    assert (frame.liquid_mask.max() > 0) == (contents is Contents.two_glasses)
    if contents is Contents.two_glasses:
        gaps = np.diff((frame.container_mask.max(axis=0) > 127).astype(int))
        assert (gaps == 1).sum() + (frame.container_mask[:, 0].max() > 127) == 2


def test_faults_hide_the_glass_and_take_it_out_of_the_picture(clip) -> None:
    options = GlassFaultOptions(
        dropped=0.2, occlude_start=2, occlude_frames=3, occlude_share=0.5, leave_start=6, leave_frames=2, leave_away=2
    )
    plan = plan_glass_faults(options, clip)
    frames = {f.index: f.image for f in FaultySource(clip.source(), plan)}
    lost = {k for k, faults in plan.of.items() if Fault.dropped in faults}
    assert lost and not lost & set(frames)
    left, top, right, bottom = plan.boxes[3]
    box = glass_box(clip, 3)
    assert left == pytest.approx(0.5 * (box[0] + box[2]), abs=2.0) and right > box[2] and top < box[1] < bottom
    shift, out = plan.shift[8], glass_box(clip, 8)
    assert out[2] + shift < 0 or out[0] + shift > clip.camera.width
    assert (plan.shift[6] == 0.0 and 11 not in plan.shift) or plan.shift.get(12) is None
