"""The energy and entropy account of a run, checked in every frame: is energy made, is heat lost?

GENERIC with ports (seed, Eq. 3; DESIGN 4.1) leaves `e.z' = 0` and `s.z' >= 0` for all that is no port. So between two
frames the energy of the body may change by the work of the ports and of the corrections alone, and heat may not fall.
What is left over is the error of the time step, or a fault. Energies and works are those of `Engine.account`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsdt.evaluation.ledger import LEARNED_ENERGY, LEARNED_ENTROPY, LEARNED_WORK, LIQUID_ENERGIES, SOLID_ENERGIES, WORK
from zsdt.trajectory import Body

_HEATS = ("dissipated", "heat", LEARNED_ENTROPY)
FLOOR = 1e-12  # J, or the learned unit: below, there is nothing to be shared
LIFT = 1e-3  # of a pitch: to lift the body by that is the least energy against which a leak is held


class EnergyAudit:
    """Feed it the account of every frame; `again` after a restart, when the account begins anew.

    Values of a frame, all over the largest change of any energy, heat or work so far (`zsdt.evaluation.ledger`):
    leak: what energy changed by beyond the works since the last frame; leak_total: the same since the beginning, both
    without sign; chill: by how much heat fell since the last frame, 0 where it grew. guarded: particles put back at a
    wall since the last frame, where the engine counts them.
    """

    def __init__(self, body: Body | None = None):
        """body: gives the least scale, so that a body at rest is not judged by its rounding errors."""
        self._floor = FLOOR if body is None else max(FLOOR, LIFT * 9.81 * body.pitch * float(body.mass.sum()))
        self.again()

    def again(self) -> None:
        """Begins a new account."""
        self._names: tuple[str, ...] = ()
        self._first: list[float] = []
        self._gap = self._heat = self._guarded = 0.0
        self._scale = FLOOR  # of an account in joules: see `_begin`

    def frame(self, account: Mapping[str, float]) -> dict[str, float]:
        """The values of this frame; none for an engine without an account, zeros in the first frame."""
        work_name = LEARNED_WORK if LEARNED_ENERGY in account else WORK
        if work_name not in account:
            return {}
        if not self._names:
            return self._begin(account, work_name)
        now = [float(account[name]) for name in self._names]
        changes = [value - first for value, first in zip(now, self._first, strict=True)]
        self._scale = max(self._scale, *(abs(c) for c in changes)) if all(map(math.isfinite, now)) else math.nan
        gap = math.fsum(changes[:-1]) - changes[-1]
        heat = float(account[self._heat_name]) if self._heat_name else 0.0
        found = {
            "leak": abs(gap - self._gap) / self._scale,
            "leak_total": abs(gap) / self._scale,
            "chill": max(self._heat - heat, 0.0) / self._scale,
        }
        if "guarded" in account:
            found["guarded"] = float(account["guarded"]) - self._guarded
            self._guarded = float(account["guarded"])
        self._gap, self._heat = gap, heat
        return found

    def _begin(self, account: Mapping[str, float], work_name: str) -> dict[str, float]:
        if LEARNED_ENERGY in account:
            names: tuple[str, ...] = (LEARNED_ENERGY,)
        else:
            names = LIQUID_ENERGIES if "internal" in account else SOLID_ENERGIES
        self._names = (*(n for n in names if n in account), work_name)
        self._first = [float(account[name]) for name in self._names]
        self._scale = FLOOR if LEARNED_ENERGY in account else self._floor
        self._heat_name = next((name for name in _HEATS if name in account), "")
        self._heat = float(account[self._heat_name]) if self._heat_name else 0.0
        self._guarded = float(account.get("guarded", 0.0))
        return {"leak": 0.0, "leak_total": 0.0, "chill": 0.0}
