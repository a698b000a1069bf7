"""A video that froze is not believed, whether motion is expected or not; a scene that stands still is."""

import numpy as np

from zsdt.perception.frame_quality import EXACT_REPEATS, REPEATS, FrameQuality, QualityJudge

RNG = np.random.default_rng(0)
SCENE = RNG.integers(40, 200, (120, 160)).astype(np.uint8)


def noisy(level=3.0):
    return (SCENE + level * RNG.standard_normal(SCENE.shape)).clip(0, 255).astype(np.uint8)


def started(first, frames):
    judge = QualityJudge(first, first)
    for image in frames:
        assert judge.before(image, 0.0) is FrameQuality.good
        judge.accept()
    return judge


def test_a_noisy_video_that_repeats_a_picture_froze_though_nobody_expects_motion():
    last = noisy()
    judge = started(noisy(), [*(noisy() for _ in range(8)), last])
    assert all(judge.before(last, 0.0) is FrameQuality.frozen for _ in range(3 * REPEATS))
    assert judge.before(noisy(), 0.0) is FrameQuality.good
    judge.accept()


def test_after_a_long_time_it_is_the_scene_that_stands_still():
    last = noisy()
    judge = started(noisy(), [*(noisy() for _ in range(8)), last])
    found = [judge.before(last, 0.0) for _ in range(EXACT_REPEATS + 2)]
    assert found[EXACT_REPEATS - 1] is FrameQuality.frozen and found[-1] is FrameQuality.good


def test_a_drawn_scene_that_stands_still_did_not_freeze():
    judge = started(SCENE, [SCENE] * 9)
    assert all(judge.before(SCENE, 0.0) is FrameQuality.good for _ in range(20))
