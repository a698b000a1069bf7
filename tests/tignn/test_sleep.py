"""Bodies at rest sleep: nothing changes by it, the account closes, and they wake in the frame in which they must."""

import itertools

import numpy as np
import pytest

from tests.tignn.cell_bodies import body_of, foam_constants
from tests.tignn.particle_bodies import engine_for, equal_liquid
from zsdt.errors import OptionError
from zsdt.tignn.cell_energy import CellOptions
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.sleep import Sleeper, SleepingEngine, SleepOptions, come_to_rest

STILL = 2e-6  # m within half a second


@pytest.fixture(scope="module")
def beam():
    """Engine, body and a load of 0.2 N at its tip."""
    body = body_of((6, 2, 2))
    load = np.zeros_like(body.points)
    tip = body.points[:, 0] > body.points[:, 0].max() - 1e-9
    load[tip, 2] = -0.2 / tip.sum()
    return CellEngine(foam_constants(), CellOptions()), body, load


def at_rest(body):
    zero = np.zeros_like(body.points)
    return {"position": body.points.copy(), "velocity": zero}


def rolled(engine, body, loads):
    engine.prepare(body)
    states = [engine.start(at_rest(body), loads[0])]
    for before, after in itertools.pairwise(loads):
        states.append(engine.step(states[-1], before, after))
    return states


def test_a_beam_at_rest_sleeps_and_nothing_changes_by_it(beam):
    engine, body, load = beam
    loads = [0 * load] * 2 + [load] * 300  # pushed once: it swings and comes to rest
    awake = rolled(engine, body, loads)
    slept = rolled(SleepingEngine(engine, SleepOptions(still=STILL)), body, loads)
    assert slept[-1].skipped > 100
    apart = [np.abs(s.inner.u - a.u).max() for s, a in zip(slept, awake, strict=True)]
    assert max(apart) < 2 * STILL
    swing = max(np.abs(a.u - awake[0].u).max() for a in awake)
    assert swing > 100 * STILL  # there was something to lose
    assert not slept[60].sleeper.asleep  # nor did it sleep where it turned


def test_falling_asleep_keeps_the_account(beam):
    engine, body, load = beam
    engine.prepare(body)
    state = engine.start(at_rest(body), load)
    state.velocity[:] = 0.01 * ~body.clamped[:, None]
    before, after = engine.account(state), engine.account(come_to_rest(engine, state))
    whole = [a["kinetic"] + a["elastic"] + a["dissipated"] - a["work_of_ports"] for a in (before, after)]
    assert before["kinetic"] > 0 and after["kinetic"] == 0
    assert whole[1] == pytest.approx(whole[0], rel=1e-12)


def test_a_load_wakes_a_beam_in_the_same_frame(beam):
    engine, body, load = beam
    loads = [0 * load] * 120 + [load] * 5
    awake = rolled(engine, body, loads)
    slept = rolled(SleepingEngine(engine, SleepOptions(still=STILL)), body, loads)
    assert slept[119].sleeper.asleep and not slept[120].sleeper.asleep
    for k in range(120, 125):
        moved = np.abs(awake[k].u - awake[119].u).max()
        assert moved > 0
        assert np.abs(slept[k].inner.u - awake[k].u).max() < 1e-3 * moved + STILL


def test_a_liquid_at_rest_sleeps_particle_by_particle_into_heat():
    body = equal_liquid()
    engine = engine_for(body)
    state = engine.start({"position": body.points.copy(), "velocity": np.full_like(body.points, 1e-3)}, 0 * body.points)
    still = come_to_rest(engine, state)
    before, after = engine.account(state), engine.account(still)
    assert after["kinetic"] == 0
    assert after["internal"] - before["internal"] == pytest.approx(before["kinetic"], rel=1e-9)
    np.testing.assert_array_equal(still.position, state.position)


def test_creeping_is_no_rest():
    sleeper = Sleeper(SleepOptions(still=1e-3, calm=0.5), frame_dt=0.1)
    place = np.zeros((4, 3))
    assert not any(sleeper.note(place + 3e-4 * k) for k in range(50))  # 0.3 mm a frame: 1.5 mm in half a second
    assert any(sleeper.note(place + 1e-4 * (k % 2)) for k in range(8))


def test_an_engine_without_heat_is_refused(beam):
    class Other:
        name = "other"

    with pytest.raises(OptionError, match="no account of heat"):
        come_to_rest(Other(), object())
