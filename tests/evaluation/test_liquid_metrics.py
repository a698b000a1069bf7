"""The surface at the wall of tilted liquids, leaks and clusters that were put in, energies, and reference levels."""

from dataclasses import replace

import numpy as np
import pytest

from tests.evaluation.made_up_liquid import BOWL, CYLINDER, JAR, PITCH, body_of, filled, sloshing
from zsdt.evaluation.degeneracy import degeneracy
from zsdt.evaluation.judges import judge_of
from zsdt.evaluation.ledger import closure, turnover
from zsdt.evaluation.liquid_metrics import field_energies, outside, swing_of
from zsdt.evaluation.outline import outline, reach
from zsdt.evaluation.stability import left_range
from zsdt.evaluation.wall_level import wall_levels
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.engine import Rollout
from zsdt.tignn.liquid_engine import LiquidEngine
from zsdt.tignn.liquid_features import LiquidScales
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.options import TignnOptions

X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize(("shape", "direction"), [(CYLINDER, X), (JAR, X), (JAR, Y), (BOWL, X)])
@pytest.mark.parametrize("slope", [0.0, 0.25, -0.5])
def test_level_of_a_tilted_plane_at_the_wall(shape, direction, slope):
    points = filled(shape, 0.055, slope * direction[:2])
    front, back = wall_levels(body_of(points, shape), points[None], direction)[0]
    for level, sign in ((front, 1.0), (back, -1.0)):
        for _ in range(3):  # where the plane meets the wall, one spacing away from it
            place = reach(Vessel(shape), np.array([level]), sign * direction, PITCH)[0]
        assert level == pytest.approx(0.055 + sign * slope * place, abs=0.5 * PITCH)


def test_a_lone_drop_is_no_surface_and_a_dry_wall_has_level_zero():
    points = filled(CYLINDER, 0.05)
    splashed = np.concatenate([points, [[0.03, 0.0, 0.09]]])
    calm, wet = [wall_levels(body_of(p), p[None], X)[0, 0] for p in (points, splashed)]
    assert wet == pytest.approx(calm, abs=1e-9)
    heap = points[np.linalg.norm(points[:, :2], axis=1) < 0.015]
    assert (wall_levels(body_of(heap), heap[None], X) == 0.0).all()
    assert np.isnan(wall_levels(body_of(points), np.full((1, *points.shape), np.nan), X)).all()


def test_reach_and_outline_are_those_of_the_shape():
    heights = np.array([0.01, 0.05, 0.1])
    np.testing.assert_allclose(reach(Vessel(BOWL), heights, X), Vessel(BOWL).radius(heights), atol=1e-7)
    np.testing.assert_allclose(reach(Vessel(JAR), heights, Y), 0.8 * 0.035, atol=1e-7)
    np.testing.assert_allclose(reach(Vessel(CYLINDER), heights, Y, inset=0.005), [0.03] * 3, atol=1e-7)
    place, height = outline(Vessel(CYLINDER), X)
    assert np.ptp(place) == pytest.approx(0.07) and height.max() == 0.12


def rollout_of(trajectory, **changed):
    return Rollout("any", {**trajectory.fields, **changed}, np.ones(trajectory.frames - 1))


def test_leaked_spilled_and_clustered_particles_are_counted():
    truth = sloshing(frames=12)
    position = truth.fields["position"].copy()
    position[5, 3] = [0.05, 0.0, 0.02]  # through the wall and back
    position[6:, 4] = [0.0, 0.0, -0.01]  # through the floor for ever
    position[7, 5] = [0.05, 0.0, 0.2]  # over the rim
    leaked, spilled = outside(truth.body, position)
    assert leaked.tolist() == [3, 4] and spilled.tolist() == [5]
    assert left_range(truth, rollout_of(truth, position=position)) == 5
    close = truth.fields["position"].copy()
    close[1:, 20] = close[1:, 21] + [0.1 * PITCH, 0.0, 0.0]
    figures = judge_of(truth, 0.9).figures(rollout_of(truth, position=close))
    assert figures["close_share"] == pytest.approx(2.0 / truth.body.nodes, rel=1e-6)
    assert figures["least_spacing"] == pytest.approx(0.1) and figures["true_close_share"] == 0.0
    assert figures["leaked"] == 0 and figures["density_error"] > 0
    assert left_range(truth, rollout_of(truth)) is None


def test_a_compressed_liquid_has_lost_volume():
    truth = sloshing(frames=12)
    squeezed = truth.fields["position"] * 0.98
    figures = judge_of(truth, 0.9).figures(rollout_of(truth, position=squeezed))
    assert figures["volume_error"] == pytest.approx(1 - 0.98**3, abs=0.02) and figures["density_error"] > 0.02


def test_energy_increment_does_not_depend_on_the_reference_level_and_the_plain_error_does():
    truth = sloshing(frames=20)
    heat = 1.1 * truth.fields["internal_energy"]
    figures = judge_of(truth, 0.9).figures(rollout_of(truth, internal_energy=heat))
    far = replace(truth, fields={**truth.fields, "internal_energy": truth.fields["internal_energy"] + 1e3})
    shifted = judge_of(far, 0.9).figures(rollout_of(far, internal_energy=heat + 1e3))
    assert figures["energy_increment_rrmse"] == pytest.approx(0.1) and figures["internal_energy_rrmse"] > 0.09
    assert shifted["energy_increment_rrmse"] == pytest.approx(0.1, rel=1e-6)
    assert shifted["internal_energy_rrmse"] < 1e-5
    assert shifted["internal_energy_level"] == pytest.approx(figures["internal_energy_level"] + 1e3)
    own = judge_of(truth, 0.9).figures(
        rollout_of(truth, internal_energy=heat + 7.0)
    )  # a method with a level of its own
    assert own["energy_increment_rrmse"] == pytest.approx(0.1)


def test_the_truth_itself_is_without_error():
    truth = sloshing()
    figures = judge_of(truth, 0.9).figures(rollout_of(truth))
    for name in ("centroid_rrmse", "level_rmse", "frequency_error", "damping_error", "volume_error", "momentum_rrmse"):
        assert figures[name] == pytest.approx(0.0, abs=1e-12)
    assert figures["kinetic_ratio"] == figures["kinetic_factor"] == pytest.approx(1.0)
    assert figures["true_frequency_hz"] == pytest.approx(2.9, rel=1e-3)
    assert figures["true_damping"] == pytest.approx(0.45, rel=1e-3)


def test_a_rollout_that_left_the_numbers_is_infinitely_wrong_and_not_undefined():
    truth = sloshing(frames=30)
    lost = {k: np.where(np.arange(30)[:, None, None] < 9, v, np.nan) for k, v in truth.fields.items()}
    figures = judge_of(truth, 0.9).figures(rollout_of(truth, **lost))
    for name in ("centroid_rrmse", "level_rmse", "peak_level_error", "volume_error", "kinetic_ratio", "energy_drift"):
        assert figures[name] == float("inf"), name
    assert figures["leaked"] == 0


def test_energies_from_fields():
    truth = sloshing(frames=5)
    body = truth.body
    energies = field_energies(body, truth.fields)
    mass = body.mass.sum()
    np.testing.assert_allclose(
        energies["internal"], mass * truth.fields["internal_energy"].mean(axis=(1, 2)), rtol=1e-12
    )
    lifted = {**truth.fields, "position": truth.fields["position"] + [0.0, 0.0, 0.1]}
    np.testing.assert_allclose(field_energies(body, lifted)["potential"] - energies["potential"], 0.981 * mass)
    swing = swing_of(body, truth.fields["position"])
    assert swing.counts.shape == (5, body.nodes) and (np.diff(swing.counts, axis=1) >= 0).all()


def test_the_account_of_a_liquid_closes_with_gravity_as_an_energy_and_learned_units_stay_apart():
    falling = np.linspace(0.0, 1.0, 9)
    account = {"kinetic": 1.5 * falling, "potential": 5.0 - 2.0 * falling, "internal": 3.0 + 0.5 * falling}
    account |= {"elastic": np.full(9, 7.0), "work_inertial": np.zeros(9)}  # compression is part of the internal energy
    assert np.abs(closure(account)).max() < 1e-12 and turnover(account) == 2.0
    driven = {**account, "kinetic": 2.5 * falling, "work_inertial": falling}
    assert np.abs(closure(driven)).max() < 1e-12
    learned = {**account, "learned_energy_change": 9.0 * falling, "learned_port_work": 8.0 * falling}
    assert turnover(learned) == 9.0 and closure(learned)[-1] == pytest.approx(1.0 / 9.0)


def test_an_untrained_liquid_bracket_is_probed_in_double_precision():
    truth = sloshing(frames=3)
    options = TignnOptions(passes=1, width=8, hidden_layers=1)
    engine = LiquidEngine(LiquidModel(options, LiquidScales()))
    found = degeneracy(engine, truth, frames=1)
    assert found["probe_energy_residual"] < 1e-9 and found["probe_entropy_production"] > -1e-12
