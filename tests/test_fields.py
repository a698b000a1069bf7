"""Components and weights of the stress, and that every field says its unit."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fields import FIELDS, STRESS_COMPONENTS, VOIGT_WEIGHTS, von_mises
from zsdt.scene import BeamShape, Foam, Modulus

PLACES = [(int(c[0]) - 1, int(c[1]) - 1) for c in STRESS_COMPONENTS]


def as_matrix(six):
    full = np.zeros((3, 3))
    for value, (i, j) in zip(six, PLACES, strict=True):
        full[i, j] = full[j, i] = value
    return full


def test_every_field_has_a_unit_and_words():
    assert all(f.unit and f.description and f.components in (1, 3, 6) for f in FIELDS.values())
    assert all(name == field.name for name, field in FIELDS.items())


def test_weights_turn_six_components_into_the_double_contraction():
    six = np.random.default_rng(0).normal(size=6)
    assert (VOIGT_WEIGHTS * six**2).sum() == pytest.approx((as_matrix(six) ** 2).sum())


def test_von_mises_is_the_norm_of_the_deviator():
    stress = np.random.default_rng(1).normal(size=(5, 6))
    for six, value in zip(stress, von_mises(stress), strict=True):
        full = as_matrix(six)
        deviator = full - np.trace(full) / 3 * np.eye(3)
        assert value == pytest.approx(np.sqrt(1.5 * (deviator**2).sum()))


def test_relaxed_and_instantaneous_cards_describe_the_same_foam():
    """Given its long-term shear modulus, a foam has 1 / (1 - g1) times as much at once; the bulk does not relax."""
    now, later = Foam(young=4.5e4), Foam(young=4.5e4, modulus=Modulus.long_term)
    assert now.shear == pytest.approx(4.5e4 / 2.6)
    assert later.shear * (1 - later.g1) == pytest.approx(now.shear)
    assert now.bulk == later.bulk == pytest.approx(4.5e4 / 1.2)


@pytest.mark.parametrize("wrong", [{"poisson": 0.5}, {"young": -1.0}, {"g1": 1.0}, {"tau": 0.0}, {"density": 0.0}])
def test_impossible_foams_are_refused(wrong):
    with pytest.raises(OptionError):
        Foam(**wrong)


def test_a_beam_without_extent_is_refused():
    with pytest.raises(OptionError):
        BeamShape(depth=0.0)
