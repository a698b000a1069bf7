"""A liquid that is carried along: it keeps its volume and place, and leaves a stop with the momentum it brought."""

from __future__ import annotations

import numpy as np
import pytest

from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselShape
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.trajectory import VesselMotion
from zsdt.twin.glass_graph import GlassGraphOptions
from zsdt.twin.liquid_history import CarriedLiquid, carried_liquid, pushes

SHAPE = VesselShape()
LEVEL, SPEED, RAMP = 0.06, 0.2, 0.02


def motion(speed: float) -> VesselMotion:
    """An even motion of 50 ms that stops within 20 ms."""
    times = 1e-3 * np.arange(-70, 1)
    velocity = np.zeros((len(times), 3))
    velocity[:, 0] = speed * np.clip(-times / RAMP, 0.0, 1.0)
    return VesselMotion(times, velocity, np.tile([0.0, 0.0, -9.81], (len(times), 1)))


def carried(speed: float, liquid: Liquid | None = None, engine: ParticleEngine | None = None) -> CarriedLiquid:
    volume = Vessel(SHAPE).volume(LEVEL)
    return carried_liquid(
        engine or ParticleEngine(), SHAPE, volume, motion(speed), liquid=liquid or Liquid(), fps=60.0, gravity=9.81,
        options=GlassGraphOptions(particles=160),
    )  # fmt: skip


@pytest.fixture(scope="module")
def stopped() -> CarriedLiquid:
    return carried(SPEED)


def test_pushes_add_up_to_the_change_of_velocity(stopped: CarriedLiquid) -> None:
    total = pushes(stopped.body).sum(axis=0) * stopped.body.frame_dt
    assert np.allclose(total, [SPEED, 0.0, 0.0], atol=1e-12)


def test_a_vessel_that_stands_leaves_its_liquid_at_rest() -> None:
    still = carried(0.0)
    speed = np.linalg.norm(still.fields["velocity"], axis=1)
    assert np.sqrt((speed**2).mean()) < 0.02 * SPEED
    assert np.abs(still.fields["position"][:, :2].mean(axis=0)).max() < 1e-3


def test_after_a_stop_the_liquid_goes_on_in_its_direction(stopped: CarriedLiquid) -> None:
    mean = stopped.fields["velocity"].mean(axis=0)
    assert 0.1 * SPEED < mean[0] < SPEED  # the walls took the rest of it
    assert abs(mean[1]) < 0.05 * SPEED
    # What it climbs at the wall towards which it runs, it leaves at the other.
    x, w = stopped.fields["position"][:, 0], stopped.fields["velocity"][:, 2]
    assert (x * w).sum() > 0.25 * np.sqrt((x**2).sum() * (w**2).sum())
    mirrored = carried(-SPEED)
    assert mirrored.fields["velocity"].mean(axis=0)[0] == pytest.approx(-mean[0], rel=0.05)


def test_a_hard_stop_does_not_press_the_liquid_of_a_soft_engine_together() -> None:
    soft = ParticleEngine(options=ParticleOptions(sound_speed=4.0))
    found = carried(0.5, engine=soft).fields["velocity"]
    hardly = carried(0.5, Liquid(sound_speed=26.0), ParticleEngine()).fields["velocity"]
    soft_liquid = carried(0.5, Liquid(sound_speed=4.0)).fields["velocity"]
    size = np.linalg.norm(hardly)
    assert np.linalg.norm(found - hardly) < 0.06 * size, "the liquid's own stiffness is enough"
    assert np.linalg.norm(soft_liquid - hardly) > 0.15 * size, "the engine's is not"
    assert soft.options.sound_speed == 4.0, "whoever lends the engine finds it as it was"


def test_it_stays_in_the_vessel_and_keeps_its_mass(stopped: CarriedLiquid) -> None:
    body = stopped.body
    assert body.mass.sum() == pytest.approx(1261.0 * Vessel(SHAPE).volume(LEVEL), rel=1e-9)
    assert Vessel(SHAPE).distance(stopped.fields["position"]).min() > 0.0
    assert np.array_equal(body.points, stopped.fields["position"])
