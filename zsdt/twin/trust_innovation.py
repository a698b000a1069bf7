"""Innovation statistics: does what is seen scatter about the prediction as the observer expects?

In a consistent Kalman filter the normalised innovation is white, of mean 0 and variance 1 (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4). `zsdt.twin.assimilation`
gives it mode by mode: `Fit.whitened`. Here are its mean, variance and correlation from frame to frame, over the last
frames, so that a biased camera (mean), a wrong material (variance) and a twin that lags behind (correlation) are told
apart from noise.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba as nb
import numpy as np
from jaxtyping import Float

MEMORY = 15  # frames over which the statistics fade
FEWEST = 6  # observations before they are judged


@nb.njit(cache=True)
@no_type_check
def _take(z, mean, before, share):
    """Fades `z` into `mean` and keeps it in `before`; number of modes seen now, and now and before, sums of squares and
    of products with the last ones over these, largest |mean|. A frame in which nothing is seen changes nothing."""
    seen, both, square, product, largest = 0, 0, 0.0, 0.0, 0.0
    for k in range(z.size):
        seen += z[k] == z[k]
    if seen == 0:
        return seen, both, square, product, largest
    for k in range(z.size):
        known = z[k] == z[k]
        if known:
            square += z[k] * z[k]
            if before[k] == before[k]:
                both += 1
                product += z[k] * before[k]
        mean[k] += share * ((z[k] if known else 0.0) - mean[k])
        before[k] = z[k]
        largest = max(largest, abs(mean[k]))
    return seen, both, square, product, largest


@nb.njit(cache=True)
@no_type_check
def sum_of_gaps(distance, taken):
    """Number of distances [m] that are known, of points that are taken, and sum of the squares of the known ones."""
    count, believed, square = 0, 0, 0.0
    for k in range(distance.size):
        believed += taken[k]
        if math.isfinite(distance[k]):
            count += 1
            square += distance[k] * distance[k]
    return count, believed, square


class InnovationStatistics:
    """Feed it the normalised innovation of every frame that was compared.

    Values: variance: mean square over the modes and the last frames (expected 1); bias: largest mean of a mode in units
    of its own expected scatter (expected below 3); lag: correlation of one frame with the next (expected 0).
    """

    def __init__(self, memory: int = MEMORY):
        self.share = 1.0 / memory
        self.again()

    def again(self) -> None:
        """Forgets everything."""
        self._mean = self._before = np.zeros(0)
        self._square = self._product = 0.0
        self._count = self._pairs = 0

    def frame(self, whitened: Float[np.ndarray, " modes"]) -> dict[str, float]:
        """The values now; none before there are observations enough. NaN in `whitened`: a mode that was not seen."""
        if len(self._mean) != len(whitened):
            self.again()
            self._mean, self._before = np.zeros(len(whitened)), np.full(len(whitened), np.nan)
        keep, share = 1.0 - self.share, self.share
        seen, both, square, product, largest = _take(whitened, self._mean, self._before, share)
        if seen == 0:
            return {}
        self._square = keep * self._square + share * square / seen
        if both:
            self._product = keep * self._product + share * product / both
            self._pairs += 1
        self._count += 1
        if self._count < FEWEST:
            return {}
        weight = 1.0 - keep**self._count
        # Of a faded mean of white noise of variance 1.
        sigma = math.sqrt(share / (2.0 - share) * (1.0 - keep ** (2 * self._count)))
        found = {"variance": self._square / weight, "bias": largest / sigma}
        if self._pairs:
            product = self._product / (1.0 - keep**self._pairs)
            found["lag"] = product / max(found["variance"], 1e-12)
        return found
