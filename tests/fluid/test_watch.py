"""What the watch rejects: faults put into a state on purpose, and motions outside the tested range."""

import numpy as np
import pytest

from zsdt.errors import OptionError, RunRejected
from zsdt.fluid.ledger import Account
from zsdt.fluid.watch import WatchOptions, check_balance, check_layers, check_range, check_state
from zsdt.scene import Liquid, water

SPACING, RIM = 0.005, 0.1


def calm() -> dict:
    """A state with nothing wrong."""
    grid = np.stack(np.meshgrid(*[SPACING * np.arange(1, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return {
        "position": grid,
        "speed": 0.5,
        "density": np.full(len(grid), 1261.0),
        "distance": np.full(len(grid), SPACING),
        "rim": RIM,
        "spacing": SPACING,
        "liquid": Liquid(),
        "limits": WatchOptions(),
    }


def broken(**changes) -> str:
    """Cause for which a changed state is rejected."""
    with pytest.raises(RunRejected) as caught:
        check_state(**{**calm(), **changes})
    assert str(caught.value).endswith(".")
    return caught.value.cause


def test_a_calm_state_passes():
    check_state(**calm())


def test_every_fault_is_rejected_with_its_cause():
    state = calm()
    assert broken(speed=float("nan")) == "not_finite"
    density = state["density"].copy()
    density[3] = np.inf
    assert broken(density=density) == "not_finite"
    assert broken(speed=5.0) == "mach"
    density[3] = 1261.0 * 1.2
    assert broken(density=density) == "density"
    close = state["position"].copy()
    close[1] = close[0] + 1e-5
    assert broken(position=close) == "clustering"


def test_a_leak_is_told_apart_from_a_splash_over_the_rim():
    state = calm()
    distance = state["distance"].copy()
    distance[5] = -0.5 * SPACING
    assert broken(distance=distance) == "leak"
    high = state["position"].copy()
    high[5, 2] = RIM + 0.01
    check_state(**{**state, "distance": distance, "position": high})


def test_too_few_layers_are_rejected():
    check_layers(0.021, SPACING, WatchOptions())
    with pytest.raises(RunRejected, match=r"3\.0 particles deep"):
        check_layers(0.015, SPACING, WatchOptions())


def test_an_account_that_does_not_close_is_rejected():
    names = ("kinetic", "potential", "internal", "elastic", "friction", "impulse", "numerical", "guard")
    zeros = dict.fromkeys((*names, "work_inertial", "wall_work", "spilled"), 0.0)
    check_balance(Account(**zeros, residual=1e-4), 0.02, 0.2, WatchOptions())
    for residual in (1e-3, float("nan")):
        with pytest.raises(RunRejected) as caught:
            check_balance(Account(**zeros, residual=residual), 0.02, 0.2, WatchOptions())
        assert caught.value.cause == "ledger"


def test_motions_outside_the_tested_range_are_refused():
    check_range(Liquid(), 1.0, 0.02)
    check_range(Liquid(), 0.5, 0.0)
    check_range(water(), 0.5, 0.0)
    for liquid, speed, ramp in ((Liquid(), 1.0, 0.0), (Liquid(), 1.2, 0.1), (water(), 0.6, 0.1)):
        with pytest.raises(OptionError, match="outside the range"):
            check_range(liquid, speed, ramp)
    with pytest.raises(OptionError, match="negative"):
        check_range(Liquid(), -1.0, 0.0)


def test_limits_must_be_positive():
    with pytest.raises(OptionError, match="positive"):
        WatchOptions(mach=0.0)
