"""What the motion of a vessel leaves in its liquid: fading memories of the pushes that it gave.

In the axes of the vessel its liquid is pushed by `-a`, and by the change of gravity where the vessel tilts (to first
order in the tilt). A push fades within some time constant, which nobody knows beforehand, so several are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.trajectory import VesselMotion

MEMORIES = (0.01, 0.03, 0.1, 0.3)  # s


@dataclass(frozen=True)
class History:
    """pushes [memories, 3] m/s: sum of the pushes, each faded by exp(-age / memory); spent [memories] J/kg: kinetic
    energy that a mass would have lost that follows the pushes and forgets them like that."""

    pushes: Float[np.ndarray, "memories 3"]
    spent: Float[np.ndarray, " memories"]

    @property
    def speed(self) -> float:
        """Scale of the velocity that is left [m/s]: root mean square over the memories."""
        return float(np.sqrt((self.pushes**2).sum(1).mean()))

    @property
    def heat(self) -> float:
        """Scale of the internal energy [J/kg]: energy spent and left, mean over the memories."""
        return float((self.spent + 0.5 * (self.pushes**2).sum(1)).mean())


def history_of(motion: VesselMotion | None, later: float = 0.0) -> History:
    """Memories of a motion at `later` [s] after its last sample; the vessel stands still in between.

    Raises: OptionError where nothing is known of the motion.
    """
    if motion is None:
        raise OptionError("Psi_ini of a liquid needs to know how its vessel moved; this body does not say it.")
    times, memory = motion.times, np.array(MEMORIES)
    steps = np.diff(times)
    tilt = 0.5 * (motion.gravity[1:] + motion.gravity[:-1]) - motion.gravity[-1]
    kicks = -np.diff(motion.velocity, axis=0) + tilt * steps[:, None]
    left, spent = np.zeros((len(memory), 3)), np.zeros(len(memory))

    def fade(duration: float) -> None:
        share = np.exp(-duration / memory)
        spent[:] += 0.5 * (left**2).sum(1) * (1.0 - share**2)
        left[:] *= share[:, None]

    for kick, step in zip(kicks, steps, strict=True):
        fade(0.5 * step)
        left += kick
        fade(0.5 * step)
    fade(later)
    return History(left, spent)
