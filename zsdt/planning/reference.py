"""How fast this machine is, by one short piece of work that is always the same."""

from __future__ import annotations

import time

import cv2
import numpy as np

PICTURE = (270, 480)
ROUNDS = 15


def reference_ms(rounds: int = ROUNDS) -> float:
    """Median time [ms] of a piece of work like a twin's: gathering, scattering, filtering a picture.

    In milliseconds of the processor; takes some 10 ms a round on one thread. What a twin takes on another machine is in
    proportion to it.
    """
    rng = np.random.default_rng(0)
    index = rng.integers(0, 20_000, (40_000, 2))
    values = rng.standard_normal((20_000, 3))
    picture = rng.integers(0, 255, PICTURE).astype(np.uint8)
    times = []
    for _ in range(rounds + 1):
        began = time.process_time()
        step = values[index[:, 1]] - values[index[:, 0]]
        force = step / (1.0 + np.sqrt((step**2).sum(axis=1, keepdims=True)))
        total = np.zeros_like(values)
        for axis in range(3):
            total[:, axis] = np.bincount(index[:, 0], force[:, axis], len(values))
        smooth = cv2.GaussianBlur(picture, (0, 0), 2.0)
        cv2.goodFeaturesToTrack(smooth, 200, 0.01, 5.0)
        times.append(1e3 * (time.process_time() - began))
    return float(np.median(times[1:]))
