"""Errors of a rollout against closed forms and the identities that tie them together."""

import numpy as np
import pytest

from zsdt.evaluation import metrics
from zsdt.fields import von_mises

FREE = np.array([False, True, True, True])


@pytest.fixture
def truth():
    random = np.random.default_rng(3)
    first = random.normal(size=(1, 4, 3))
    moved = first + np.concatenate([np.zeros((1, 4, 3)), 0.1 * random.normal(size=(15, 4, 3))])
    return {"position": moved, "velocity": random.normal(size=(16, 4, 3)), "stress": random.normal(size=(16, 4, 6))}


def scaled(truth, factor):
    """Velocity, stress and displacement (not position) multiplied."""
    first = truth["position"][:1]
    return {
        "position": first + factor * (truth["position"] - first),
        "velocity": factor * truth["velocity"],
        "stress": factor * truth["stress"],
    }


@pytest.mark.parametrize("factor", [0.0, 0.9, 1.0, 3.0])
def test_scaling_every_field_gives_the_same_relative_error_everywhere(truth, factor):
    errors = metrics.field_errors(scaled(truth, factor), truth, FREE)
    for name in ("displacement", "velocity", "stress", "von_mises", "axial_stress"):
        assert errors[f"{name}_rrmse"] == pytest.approx(abs(factor - 1.0), abs=1e-12)


def test_relative_errors_do_not_depend_on_the_unit_and_absolute_ones_carry_it(truth):
    predicted = {k: v + 0.01 for k, v in truth.items()}
    metres = metrics.field_errors(predicted, truth, FREE)
    millimetres = metrics.field_errors(
        {k: 1e3 * v for k, v in predicted.items()}, {k: 1e3 * v for k, v in truth.items()}, FREE
    )
    for name in ("position", "displacement", "stress"):
        assert millimetres[f"{name}_rrmse"] == pytest.approx(metres[f"{name}_rrmse"], rel=1e-12)
        assert millimetres[f"{name}_rmse"] == pytest.approx(1e3 * metres[f"{name}_rmse"], rel=1e-12)
    assert metres["position_rmse"] == pytest.approx(0.01)


def test_plain_position_error_flatters_and_displacement_does_not(truth):
    far = {**truth, "position": truth["position"] + 100.0}
    still = {**far, "position": np.repeat(far["position"][:1], 16, axis=0)}
    errors = metrics.field_errors(still, far, FREE)
    assert errors["displacement_rrmse"] == pytest.approx(1.0)
    assert errors["position_rrmse"] < 2e-3


def test_first_frame_and_clamped_nodes_do_not_count(truth):
    predicted = {k: v.copy() for k, v in truth.items()}
    for values in predicted.values():
        values[0] += 7.0
        values[:, 0] -= 5.0
    assert all(v == 0.0 for v in metrics.field_errors(predicted, truth, FREE).values())


def test_mean_square_of_the_curve_is_the_square_of_the_rollout_error(truth):
    random = np.random.default_rng(5)
    predicted = {k: v + 0.3 * random.normal(size=v.shape) for k, v in truth.items()}
    errors = metrics.field_errors(predicted, truth, FREE)
    curves = metrics.errors_over_time(predicted, truth, FREE)
    for name, curve in curves.items():
        assert np.sqrt(np.mean(curve[1:] ** 2)) == pytest.approx(errors[f"{name}_rrmse"], rel=1e-12)


def test_von_mises_of_uniaxial_pure_shear_and_pressure():
    stress = np.array([[-7.0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 2.0, 0], [5.0, 5.0, 5.0, 0, 0, 0]])
    np.testing.assert_allclose(von_mises(stress), [7.0, 2.0 * np.sqrt(3.0), 0.0], atol=1e-12)


def test_von_mises_and_its_error_do_not_change_when_both_tensors_are_rotated(truth):
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))

    def rotated(stress):
        full = np.empty((*stress.shape[:-1], 3, 3))
        for k, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
            full[..., i, j] = full[..., j, i] = stress[..., k]
        full = turn @ full @ turn.T
        return np.stack([full[..., i, j] for i, j in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]], axis=-1)

    predicted = {**truth, "stress": truth["stress"] + 0.2}
    turned = metrics.field_errors(
        {**predicted, "stress": rotated(predicted["stress"])}, {**truth, "stress": rotated(truth["stress"])}, FREE
    )
    assert turned["von_mises_rrmse"] == pytest.approx(metrics.field_errors(predicted, truth, FREE)["von_mises_rrmse"])


def test_diverged_rollout_has_an_infinite_error_and_not_an_undefined_one(truth):
    lost = {k: np.where(np.arange(16)[:, None, None] < 9, v, np.nan) for k, v in truth.items()}
    errors = metrics.field_errors(lost, truth, FREE)
    assert errors["position_rrmse"] == errors["von_mises_rmse"] == float("inf")
    assert np.isinf(metrics.errors_over_time(lost, truth, FREE)["velocity"][9:]).all()
    assert metrics.mean_and_worst([0.1, errors["position_rrmse"]]) == (float("inf"), float("inf"))


def test_growth_of_steady_and_linear_errors():
    assert metrics.error_growth(np.ones(400)) == pytest.approx(1.0)
    assert metrics.error_growth(np.arange(4000.0)) == pytest.approx(7.0 / 3.0, rel=1e-3)
    assert np.isnan(metrics.error_growth(np.ones(5)))


def test_mean_and_worst_leave_undefined_values_out():
    assert metrics.mean_and_worst([0.1, float("nan"), 0.3]) == (pytest.approx(0.2), 0.3)
    assert all(np.isnan(metrics.mean_and_worst([])))
