"""The energy and entropy account of a rollout: does it close, and does it agree with the solver's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory

Account = Mapping[str, Float[np.ndarray, " frames"]]

# What counts as energy of the body and as work done on it. Heat stays inside: dissipation moves energy, it loses none.
# Gravity is a port like the load, so its work is part of `work_of_ports` and its potential no energy of the body.
SOLID_ENERGIES = ("kinetic", "elastic", "dissipated")
# Of a liquid the internal energy holds heat and compression, and gravity, which nobody can switch off, a potential.
LIQUID_ENERGIES = ("kinetic", "potential", "internal")
# Solvers book the ports one by one, engines may give their sum.
WORK, WORKS = "work_of_ports", ("work_load", "work_gravity", "work_inertial")
# A network that learns its own energy and entropy has an account too, in units of its own.
LEARNED_ENERGY, LEARNED_WORK, LEARNED_ENTROPY = (
    "learned_energy_change",
    "learned_port_work",
    "learned_entropy_produced",
)


def energies_of(account: Account) -> tuple[str, ...]:
    """Names of the energies of this kind of account that together are the whole; it need not book all of them."""
    return LIQUID_ENERGIES if "internal" in account else SOLID_ENERGIES


def total_energy(account: Account) -> Float[np.ndarray, " frames"] | None:
    """Sum [J] of all energies of an account, heat included (or the learned energy); None where it has none."""
    if LEARNED_ENERGY in account:
        return np.asarray(account[LEARNED_ENERGY])
    parts = [np.asarray(account[name]) for name in energies_of(account) if name in account]
    return np.sum(parts, axis=0) if parts else None


def work_of_ports(account: Account) -> Float[np.ndarray, " frames"] | None:
    """Work [J] done on the body since the first frame; None where the account does not book it."""
    for name in (WORK, LEARNED_WORK):
        if name in account:
            return np.asarray(account[name])
    parts = [np.asarray(account[name]) for name in WORKS if name in account]
    return np.sum(parts, axis=0) if parts else None


def turnover(account: Account) -> float:
    """Scale [J] of an account: the largest change of any of its entries over the rollout."""
    names = (LEARNED_ENERGY,) if LEARNED_ENERGY in account else energies_of(account)  # never joules with other units
    entries = [np.asarray(account[name]) for name in names if name in account]
    work = work_of_ports(account)
    entries += [] if work is None else [work]
    return max((float(np.nanmax(np.abs(values - values[0]))) for values in entries), default=0.0)


def closure(account: Account) -> Float[np.ndarray, " frames"] | None:
    """`(E(t) - E(0) - W(t) + W(0)) / turnover`: zero where energy changes by the work of the ports alone [-].

    None where the account has no energies or no work.
    """
    energy, work = total_energy(account), work_of_ports(account)
    if energy is None or work is None:
        return None
    scale = turnover(account)
    gap = (energy - energy[0]) - (work - work[0])
    return gap / scale if scale > 0 else np.zeros_like(gap)


def heat(account: Account) -> Float[np.ndarray, " frames"] | None:
    """Dissipated energy [J], or the entropy produced where the network learns one of its own; None without either."""
    for name in ("dissipated", "heat", LEARNED_ENTROPY):
        if name in account:
            return np.asarray(account[name])
    return None


def smallest_production(account: Account) -> float:
    """Smallest step of `heat` over the largest change of it [-]: negative where the second law was broken, NaN where
    nothing is booked.
    """
    booked = heat(account)
    if booked is None or len(booked) < 2 or np.isnan(booked[1]):
        return float("nan")
    scale = float(np.nanmax(np.abs(booked - booked[0])))
    smallest = float(np.nanmin(np.diff(booked)))
    return smallest / scale if scale > 0 else smallest


def ledger_figures(rollout: Rollout, trajectory: Trajectory) -> dict[str, float]:
    """Figures of a rollout's account for a table; NaN where there is nothing to judge.

    ledger_residual: largest |closure|; entropy_min: see `smallest_production`; `<energy>_account_rrmse`: distance of
    an energy (change since the first frame) from the solver's own, relative to the solver's.
    """
    gap = closure(rollout.account)
    figures = {
        "ledger_residual": float("nan") if gap is None or np.isnan(gap).all() else float(np.nanmax(np.abs(gap))),
        "entropy_min": smallest_production(rollout.account),
    }
    for name in energies_of(trajectory.ledger):
        figures[f"{name}_account_rrmse"] = _distance(rollout.account.get(name), trajectory.ledger.get(name))
    ours, theirs = work_of_ports(rollout.account), work_of_ports(trajectory.ledger)
    figures[f"{WORK}_account_rrmse"] = _distance(ours, theirs)
    return figures


def _distance(ours: np.ndarray | None, theirs: np.ndarray | None) -> float:
    if ours is None or theirs is None:
        return float("nan")
    count = min(len(ours), len(theirs))
    ours, theirs = ours[:count] - ours[0], theirs[:count] - theirs[0]
    size = float(np.sum(theirs**2))
    return float(np.sqrt(np.sum((ours - theirs) ** 2) / size)) if size > 0 else float("nan")
