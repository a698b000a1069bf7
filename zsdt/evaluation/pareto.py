"""Which methods nobody beats in error and time at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def pareto_front(costs: Float[np.ndarray, "methods criteria"]) -> Bool[np.ndarray, " methods"]:
    """True for each row of `costs` [methods, criteria] (less is better, any units) that no other row dominates.

    A row dominates another if it is nowhere worse and somewhere better; of equal rows all stay. A row with a number
    that is not finite (a method that diverged) is never on the front.
    """
    costs = np.asarray(costs, np.float64)
    finite = np.isfinite(costs).all(axis=1)
    no_worse = (costs[:, None, :] <= costs[None, :, :]).all(axis=2)
    better = (costs[:, None, :] < costs[None, :, :]).any(axis=2)
    dominated = (no_worse & better & finite[:, None]).any(axis=0)
    return finite & ~dominated
