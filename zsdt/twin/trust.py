"""Trust at run time: is this frame one that the twin can be believed in?

    monitor = TrustMonitor(load_limits(folder), body)
    reading = monitor.frame(position, velocity, account=engine.account(state), load=load)
    if reading.flags: print(reading.words)

Three questions a frame, each with a number and a limit: is the state where the network was trained (`trust_gauges`),
does the energy account close and heat grow (`trust_audit`), does what is seen scatter about the prediction as it should
(`trust_innovation`)? Limits come from the training data and from normal runs (`trust_limits`). A flag says "outside of
what was tested", not "wrong"; that there is none proves nothing either where nobody looks (an open loop whose load is
not the one that it was told).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.trust_audit import EnergyAudit
from zsdt.twin.trust_gauges import gauge_of
from zsdt.twin.trust_innovation import InnovationStatistics, sum_of_gaps
from zsdt.twin.trust_limits import KINDS, PHYSICS, Flag, TrustLimits, load_limits, scale_of

__all__ = ["Flag", "Seen", "TrustLimits", "TrustMonitor", "TrustReading", "TrustSeries", "audit_rollout", "load_limits"]

SECOND = ("stress", "pressure")  # fields that are judged where they are there


@runtime_checkable
class Seen(Protocol):
    """What an observation said (`Innovation`, `SurfaceInnovation`)."""

    @property
    def distance(self) -> Float[np.ndarray, " points"]: ...

    @property
    def taken(self) -> Bool[np.ndarray, " points"]: ...

    @property
    def scatter(self) -> float: ...

    @property
    def whitened(self) -> Float[np.ndarray, " modes"]: ...


@dataclass(frozen=True)
class TrustReading:
    """One frame. flags: in the order of `Flag`, none for a frame that is trusted; values: all that was measured;
    broken: value -> the limit that it passed; shares: flag -> how far its worst value is on the way from what is
    expected (0) to its limit (1)."""

    flags: tuple[Flag, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    broken: Mapping[str, float] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The flags in one word each, empty where there is none."""
        return " ".join(self.flags)

    @property
    def words(self) -> str:
        """The flags with their reasons: ``range: stretch_low 0.41 (limit 0.74)``."""
        said = []
        for flag in self.flags:
            of = [n for n in self.broken if KINDS[n].flag is flag]
            why = ", ".join(f"{n} {self.values[n]:.3g} (limit {self.broken[n]:.3g})" for n in of)
            said.append(f"{flag}: {why}" if why else flag.value)
        return "; ".join(said)


class TrustMonitor:
    """Judges one run, frame by frame; `card` are the values that do not change."""

    def __init__(
        self,
        limits: TrustLimits | None,
        body: Body,
        found: Mapping[str, float] | None = None,
        alone: bool = False,
    ):
        """limits: None for physics alone (finite numbers, energy, heat). found: what a twin found out about its body,
        over what it was told: stiffness_found, density_found, viscosity_found. alone: nobody corrects the engine."""
        known = (limits or PHYSICS).within(alone)
        self.limits = {name: (*ends, *scale_of(name, *ends)) for name, ends in known.items()}
        self.gauge, self.audit = gauge_of(body), EnergyAudit(body)
        self.statistics = InnovationStatistics()
        self.card = {**self.gauge.card, **(found or {})}
        self._pitch = body.pitch
        self._weight = float(body.mass.sum()) * 9.81 or math.nan
        self._corrected = False  # before its first correction an observer doubts far more than ever after
        self._card_shares: dict[str, float] = {}
        self._card_broken = self._judged(self.card, self._card_shares)

    def _judged(self, values: Mapping[str, float], shares: dict[str, float]) -> dict[str, float]:
        """Which values are outside of their limits, and the limit; `shares` (see `TrustReading`) are filled in."""
        broken: dict[str, float] = {}
        for name, value in values.items():
            known = self.limits.get(name)
            if known is None or math.isnan(value):
                continue
            low, high, middle, down, up = known
            share = (value - middle) * (up if value > middle else down)
            flag = KINDS[name].flag
            if share > shares.get(flag, 0.0):
                shares[flag] = share
            if not low <= value <= high:
                broken[name] = low if value < low else high
        return broken

    def frame(
        self,
        position: Float[np.ndarray, "nodes 3"],
        velocity: Float[np.ndarray, "nodes 3"],
        *,
        account: Mapping[str, float] | None = None,
        load: Float[np.ndarray, "nodes 3"] | None = None,
        second: Float[np.ndarray, "nodes _"] | None = None,
        seen: Seen | None = None,
        doubt: float = math.nan,
        found: Mapping[str, float] | None = None,
        restarted: bool = False,
    ) -> TrustReading:
        """Judges a frame after its correction.

        position [m], velocity [m/s]; account [J] of the engine; load [N]: given ones, not those that a twin estimates;
        second: stress or pressure [Pa] where decoded; seen: the innovation; doubt [m]: standard deviation of the body's
        place that the observer expects; found: what the twin thinks now of its material, over what it was told.
        """
        if restarted:
            self._corrected = False
            self.audit.again()
            self.statistics.again()
        values = self.gauge.frame(position, velocity, load, second)
        if account is not None:
            values |= self.audit.frame(account)
        if seen is not None:
            values |= self._seen(seen)
        if math.isfinite(doubt) and self._corrected:
            values["doubt"] = doubt / self._pitch
        if found:
            values |= found
        shares = self._card_shares.copy()
        broken = self._judged(values, shares)
        if not (broken or self._card_broken or restarted) and self.gauge.finite:
            return TrustReading((), values, {}, shares)
        kinds = {KINDS[name].flag for name in (*broken, *self._card_broken)}
        kinds |= {Flag.restarted} if restarted else set()
        kinds |= set() if self.gauge.finite else {Flag.finite}
        flags = tuple(f for f in Flag if f in kinds)
        return TrustReading(flags, {**self.card, **values}, broken | self._card_broken, shares)

    def _seen(self, seen: Seen) -> dict[str, float]:
        count, taken, square = sum_of_gaps(seen.distance, seen.taken)
        if count == 0:
            return {}
        values = {"gap": math.sqrt(square / count) / self._pitch}
        self._corrected |= taken > 0
        if len(seen.whitened):
            values |= self.statistics.frame(seen.whitened)
            values["scatter"], values["believed"] = seen.scatter, taken / count
        load = getattr(seen, "load", None)
        if load is not None:
            values["load_found"] = math.sqrt(float(load @ load)) / self._weight
        return values


@dataclass
class TrustSeries:
    """The readings of a run. flags [n]: words of each frame, empty where it is trusted; reasons [n]: with numbers;
    values: name -> [n], NaN where it was not measured; shares: flag -> [n] of the way to its limit."""

    flags: list[str]
    reasons: list[str]
    values: dict[str, Float[np.ndarray, " n"]]
    shares: dict[str, Float[np.ndarray, " n"]] = field(default_factory=dict)

    @classmethod
    def of(cls, readings: list[TrustReading | None]) -> TrustSeries:
        """From the readings of all frames; None: a frame that was not judged."""
        kept = [TrustReading() if reading is None else reading for reading in readings]
        names = dict.fromkeys(name for reading in kept for name in reading.values)
        values = {name: np.array([reading.values.get(name, np.nan) for reading in kept]) for name in names}
        judged = [flag for flag in Flag if any(flag in reading.shares for reading in kept)]
        shares = {flag.value: np.array([reading.shares.get(flag, np.nan) for reading in kept]) for flag in judged}
        return cls([reading.text for reading in kept], [reading.words for reading in kept], values, shares)

    @property
    def first_flag(self) -> int | None:
        """First frame with a flag, None where there is none."""
        return next((k for k, text in enumerate(self.flags) if text), None)

    def figures(self) -> dict[str, Any]:
        """What a manifest keeps: frames, those that are flagged, the first of them, and frames of each flag."""
        flagged = sum(map(bool, self.flags))
        return {"frames": len(self.flags), "flagged": flagged, "first": self.first_flag, **self.count()}

    def count(self) -> dict[str, int]:
        """Number of frames with each flag."""
        split = [text.split() for text in self.flags]
        return {flag.value: n for flag in Flag if (n := sum(flag in words for words in split))}


def summary_of(series: TrustSeries | None) -> str:
    """One sentence for people: in how many frames a run was not trusted, since when, and why."""
    if series is None or not series.flags:
        return ""
    first = series.first_flag
    if first is None:
        return f"Trusted in all {len(series.flags)} frames."
    counted = ", ".join(f"{flag} in {n}" for flag, n in series.count().items())
    flagged = sum(map(bool, series.flags))
    return f"Not trusted in {flagged} of {len(series.flags)} frames, from row {first} on ({counted})."


def limits_of(engine: Any) -> TrustLimits | None:
    """The limits beside the weights of an engine that `load_engine` has read; None without them."""
    return load_limits(getattr(engine, "folder", None))


def audit_rollout(engine: Any, trajectory: Trajectory, rollout: Rollout) -> TrustSeries:
    """Trust in an open loop: every frame of a rollout of `engine` on `trajectory`, whose loads it was given."""
    return watch_rollout(limits_of(engine), trajectory.body, rollout, trajectory.load)


def watch_rollout(
    limits: TrustLimits | None,
    body: Body,
    rollout: Rollout,
    load: Float[np.ndarray, "frames nodes 3"] | None = None,
) -> TrustSeries:
    """The same with given limits. Frames that the engine never reached are flagged as not finite."""
    monitor, readings = TrustMonitor(limits, body, alone=True), []
    second = next((rollout.fields[name] for name in SECOND if name in rollout.fields), None)
    for k in range(len(rollout.fields["position"])):
        if rollout.diverged_at is not None and k >= rollout.diverged_at:
            readings.append(TrustReading((Flag.finite,)))
            continue
        readings.append(
            monitor.frame(
                np.ascontiguousarray(rollout.fields["position"][k], float),
                np.ascontiguousarray(rollout.fields["velocity"][k], float),
                account={name: float(values[k]) for name, values in rollout.account.items()} or None,
                load=None if load is None else np.ascontiguousarray(load[min(k, len(load) - 1)], float),
                second=None if second is None else np.ascontiguousarray(second[k], float),
            )
        )
    return TrustSeries.of(list(readings))
