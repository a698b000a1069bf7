"""The port of an observer: its work closes the account, nobody goes through a wall, nothing asked is nothing done."""

import numpy as np
import pytest

from tests.tignn.particle_bodies import engine_for, equal_liquid, stirred
from zsdt.tignn.particle_port import displace


def total(engine, state, work):
    a = engine.account(state)
    return a["kinetic"] + a["potential"] + a["internal"] - a["work_of_ports"] - work - a["integrator"]


def test_the_work_closes_the_account_and_walls_hold():
    body = equal_liquid()
    engine = engine_for(body)
    nothing = np.zeros_like(body.points)
    state = engine.start(stirred(body), nothing)
    state = engine.step(state, nothing, nothing)
    first = total(engine, state, 0.0)
    rng = np.random.default_rng(1)
    move, push = rng.normal(scale=5e-4, size=body.points.shape), rng.normal(scale=0.05, size=body.points.shape)
    moved, work = displace(engine, state, move, push, rng.normal(scale=20.0, size=body.nodes))
    assert abs(work) > 0 and total(engine, moved, work) == pytest.approx(first, abs=1e-12)
    later = engine.step(moved, nothing, nothing)
    assert total(engine, later, work) == pytest.approx(first, abs=1e-9 * abs(engine.account(later)["potential"]))
    far, _ = displace(engine, state, np.full_like(move, -0.5), 0 * push)
    assert far.position[:, 2].min() >= 0.99 * engine.constants.guard


def test_nothing_asked_is_nothing_done():
    body = equal_liquid()
    engine = engine_for(body)
    nothing = np.zeros_like(body.points)
    state = engine.start(stirred(body), nothing)
    same, work = displace(engine, state, nothing, nothing)
    assert same is state and work == 0.0
