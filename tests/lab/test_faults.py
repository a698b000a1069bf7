"""Faults fall where the plan says and nowhere else."""

from collections.abc import Iterator

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.lab.faults import Fault, FaultOptions, FaultySource, hiding_box, plan_faults
from zsdt.perception.video import VideoFrame

FRAMES = 100


class Stills:
    """A source in memory: every frame has its own pattern and a brightness near 120."""

    name, fps, size, count = "stills", 60.0, (80, 60), FRAMES

    def __init__(self) -> None:
        self.missing: list[int] = []
        rng = np.random.default_rng(0)
        self.images = list(rng.integers(80, 160, (FRAMES, 60, 80, 3), dtype=np.uint8))

    def __iter__(self) -> Iterator[VideoFrame]:
        for k, image in enumerate(self.images):
            yield VideoFrame(k, k / 60.0, image)


def node_pixels(clamp_left: bool = True) -> np.ndarray:
    """A straight grid of 9 x 3 nodes in every frame, moving down."""
    column, row = np.meshgrid(np.arange(9), np.arange(3), indexing="ij")
    u = 8 + 7.5 * column if clamp_left else 72 - 7.5 * column
    return np.stack([np.stack([u, 40.0 - 8 * row + 0.1 * k], axis=-1) for k in range(FRAMES)])


def test_without_options_nothing_happens() -> None:
    source = Stills()
    for frame, image in zip(FaultySource(source, plan_faults(FaultOptions(), FRAMES)), source.images, strict=True):
        assert frame.image is image


def test_each_fault_does_what_it_is_called() -> None:
    source = Stills()
    shares = FaultOptions(dropped=0.1, doubled=0.1, dark=0.1, blurred=0.1, seed=4)
    plan = plan_faults(shares, FRAMES)
    of = {kind: {k for k, faults in plan.of.items() if kind in faults} for kind in Fault}
    faulty = FaultySource(source, plan)
    frames = {frame.index: frame for frame in faulty}
    assert faulty.missing == sorted(of[Fault.dropped])
    assert set(frames) == set(range(FRAMES)) - of[Fault.dropped]
    assert all(frame.time == index / 60.0 for index, frame in frames.items())
    for index, frame in frames.items():
        if index in of[Fault.doubled]:
            before = max(k for k in frames if k < index)
            if before not in of[Fault.dark] | of[Fault.blurred] | of[Fault.doubled]:
                np.testing.assert_array_equal(frame.image, frames[before].image)
        elif index in of[Fault.dark]:
            assert frame.image.mean() < 12
        elif index in of[Fault.blurred]:
            assert frame.image.std() < 0.2 * source.images[index].std()
        else:
            assert frame.image is source.images[index]
    assert all(2 <= len(of[kind]) <= 20 for kind in (Fault.dropped, Fault.doubled, Fault.dark, Fault.blurred))
    assert min(plan.of) >= 2  # the twin must see its beam once
    assert plan_faults(shares, FRAMES) == plan


@pytest.mark.parametrize("clamp_left", [True, False])
@pytest.mark.parametrize("from_clamp", [True, False])
def test_an_occluder_hides_the_wanted_nodes_and_no_others(clamp_left, from_clamp) -> None:
    pixels = node_pixels(clamp_left)
    options = FaultOptions(occlude_share=0.5, occlude_start=20, occlude_frames=30, occlude_clamp=from_clamp)
    plan = plan_faults(options, FRAMES, pixels)
    assert sorted(plan.boxes) == list(range(20, 50))
    for frame in (20, 49):
        left, top, right, bottom = plan.boxes[frame]
        u, v = pixels[frame, ..., 0], pixels[frame, ..., 1]
        hidden = (u >= left) & (u < right) & (v >= top) & (v < bottom)
        expected = np.zeros((9, 3), bool)
        expected[: 4 if from_clamp else None] = from_clamp
        if not from_clamp:
            expected[5:] = True
        np.testing.assert_array_equal(hidden, expected)
    source = Stills()
    for frame in FaultySource(source, plan):
        changed = (frame.image != source.images[frame.index]).any(axis=2).mean()
        assert (changed > 0.2) == (20 <= frame.index < 50)
    assert (
        hiding_box(pixels[0], 1.0)[0]
        < pixels[0, ..., 0].min()
        < pixels[0, ..., 0].max()
        < hiding_box(pixels[0], 1.0)[2]
    )


def test_light_changes_gradually_and_stays() -> None:
    source = Stills()
    plan = plan_faults(FaultOptions(light_start=40, light_frames=10, light_factor=0.5), FRAMES)
    bright = np.array([frame.image.mean() for frame in FaultySource(source, plan)])
    np.testing.assert_allclose(bright[:40], 119.5, atol=1.0)
    np.testing.assert_allclose(bright[49:], 0.5 * 119.5, atol=1.5)
    assert (np.diff(bright[39:50]) < 0).all()


def test_impossible_faults_are_refused() -> None:
    with pytest.raises(OptionError, match="Shares"):
        FaultOptions(dropped=0.7, dark=0.7)
    with pytest.raises(OptionError, match="pixels"):
        plan_faults(FaultOptions(occlude_share=0.5), FRAMES)
