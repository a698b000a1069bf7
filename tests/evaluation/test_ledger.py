"""The account of a rollout against oscillators whose energies are known in closed form."""

import numpy as np
import pytest

from zsdt.evaluation.ledger import closure, ledger_figures, smallest_production, turnover
from zsdt.graph import brick_grid
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory

TIMES = np.linspace(0.0, 3.0, 400)


def damped_oscillator():
    """m = 1, k = 4, c = 0.3, pulled to x = 1 and let go; heat is what the damper took."""
    decay, pulsation = 0.15, np.sqrt(4.0 - 0.15**2)
    swing = np.exp(-decay * TIMES)
    x = swing * (np.cos(pulsation * TIMES) + decay / pulsation * np.sin(pulsation * TIMES))
    v = -swing * 4.0 / pulsation * np.sin(pulsation * TIMES)
    kinetic, elastic = v**2 / 2, 2 * x**2
    return {
        "kinetic": kinetic,
        "elastic": elastic,
        "dissipated": 2.0 - kinetic - elastic,
        "work_of_ports": np.zeros_like(x),
    }


def trajectory_with(ledger):
    grid = brick_grid((1, 1, 1), 0.1)
    body = Body(grid.points, grid.pairs, grid.points[:, 0] == 0, np.ones(8), 0.01, 0.1)
    fields = {"position": np.zeros((len(TIMES), 8, 3))}
    return Trajectory(body, TIMES, fields, np.zeros((len(TIMES), 8, 3)), ledger)


def rollout_with(account):
    return Rollout("any", {"position": np.zeros((len(TIMES), 8, 3))}, np.ones(len(TIMES) - 1), account)


def test_a_closed_account_has_no_residual_and_no_negative_production():
    account = damped_oscillator()
    figures = ledger_figures(rollout_with(account), trajectory_with(account))
    assert figures["ledger_residual"] < 1e-12
    assert figures["entropy_min"] >= -1e-12
    assert figures["dissipated_account_rrmse"] == 0.0


def test_work_done_from_outside_is_energy_gained_and_not_a_residual():
    account = damped_oscillator()
    account["elastic"] = account["elastic"] + 0.5 * TIMES
    assert np.abs(closure(account)).max() * turnover(account) == pytest.approx(1.5)  # the joules nobody booked
    account["work_of_ports"] = 0.5 * TIMES
    assert np.abs(closure(account)).max() < 1e-12


def test_heat_that_flows_back_is_found():
    account = damped_oscillator()
    account["dissipated"] = account["dissipated"].copy()
    account["dissipated"][200] -= 0.1
    assert smallest_production(account) < -0.04  # of 2 J


def test_ten_percent_too_much_heat_is_ten_percent_of_distance():
    theirs, ours = damped_oscillator(), damped_oscillator()
    ours["dissipated"] = 1.1 * ours["dissipated"]
    figures = ledger_figures(rollout_with(ours), trajectory_with(theirs))
    assert figures["dissipated_account_rrmse"] == pytest.approx(0.1)


def test_a_method_without_an_account_is_not_judged_by_one():
    figures = ledger_figures(rollout_with({}), trajectory_with({}))
    assert all(np.isnan(v) for v in figures.values())


def test_a_learned_account_closes_in_its_own_units():
    account = {
        "learned_energy_change": 3.0 * TIMES,
        "learned_port_work": 3.0 * TIMES,
        "learned_entropy_produced": TIMES**2,
    }
    figures = ledger_figures(rollout_with(account), trajectory_with(damped_oscillator()))
    assert figures["ledger_residual"] == 0.0 and figures["entropy_min"] >= 0.0
    account["learned_port_work"] = 2.0 * TIMES
    assert ledger_figures(rollout_with(account), trajectory_with({}))["ledger_residual"] == pytest.approx(1 / 3)
