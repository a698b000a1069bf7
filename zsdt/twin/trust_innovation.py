"""Innovation statistics: does what is seen scatter about the prediction as the observer expects?

In a consistent Kalman filter the normalised innovation is white, of mean 0 and variance 1 (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4). `zsdt.twin.assimilation`
gives it mode by mode: `Fit.whitened`. Here are its mean, variance and correlation from frame to frame, over the last
frames, so that a biased camera (mean), a wrong material (variance) and a twin that lags behind (correlation) are told
apart from noise.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

MEMORY = 15  # frames over which the statistics fade
FEWEST = 6  # observations before they are judged


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
        z = np.nan_to_num(whitened)
        seen = int(np.count_nonzero(z))
        if seen == 0:
            return {}
        if len(self._mean) != len(z):
            self.again()
            self._mean = self._before = np.zeros(len(z))
        keep, share = 1.0 - self.share, self.share
        both = int(np.count_nonzero(z * self._before))
        self._mean = keep * self._mean + share * z
        self._square = keep * self._square + share * float(z @ z) / seen
        if both:
            self._product = keep * self._product + share * float(z @ self._before) / both
            self._pairs += 1
        self._before = z
        self._count += 1
        if self._count < FEWEST:
            return {}
        weight = 1.0 - keep**self._count
        # Of a faded mean of white noise of variance 1.
        sigma = math.sqrt(share / (2.0 - share) * (1.0 - keep ** (2 * self._count)))
        found = {"variance": self._square / weight, "bias": float(np.abs(self._mean).max()) / sigma}
        if self._pairs:
            product = self._product / (1.0 - keep**self._pairs)
            found["lag"] = product / max(found["variance"], 1e-12)
        return found
