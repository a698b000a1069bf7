"""Prony pairs that come back from the complex moduli that they make."""

import cmath
import math

import numpy as np
import pytest

from zsdt.errors import RunRejected
from zsdt.scene import Foam, Modulus
from zsdt.solid.prony import (
    MaterialFamily,
    complex_frequency,
    complex_young,
    from_given_tau,
    from_least_g1,
    from_static_ratio,
    loss_factor,
    relaxed_young,
)

FOAM = Foam()
SILICONE = Foam(1070.0, 2.6e5, 0.45, 0.2, 0.02, Modulus.long_term)


def family(material):
    return MaterialFamily(material.density, material.poisson, material.modulus)


@pytest.mark.parametrize("material", [FOAM, SILICONE])
@pytest.mark.parametrize(("frequency", "damping"), [(2.0, 0.1), (7.7, 0.05), (30.0, 0.0)])
def test_static_ratio_and_known_tau_give_the_material_back(material, frequency, damping):
    s = complex_frequency(frequency, damping)
    modulus = complex_young(material, s)
    for found in (
        from_static_ratio(family(material), relaxed_young(material), modulus, s),
        from_given_tau(family(material), modulus, s, material.tau),
    ):
        assert [found.young, found.g1, found.tau] == pytest.approx(
            [material.young, material.g1, material.tau], rel=1e-6
        )


def test_limits_of_the_complex_modulus_are_the_relaxed_and_the_instantaneous_one():
    assert complex_young(FOAM, 1e-9j).real == pytest.approx(relaxed_young(FOAM), rel=1e-6)
    assert complex_young(FOAM, 1e9j).real == pytest.approx(FOAM.young, rel=1e-6)
    assert relaxed_young(SILICONE) == pytest.approx(SILICONE.young, rel=1e-12)


@pytest.mark.parametrize("tau", [0.004, 0.02, 0.3])
def test_least_g1_explains_the_same_vibration_with_no_more_memory_than_the_truth(tau):
    truth = Foam(1070.0, 2.6e5, 0.45, 0.3, tau, Modulus.long_term)
    s = complex_frequency(7.7, 0.05)
    modulus = complex_young(truth, s)
    found = from_least_g1(family(truth), modulus, s)
    assert complex_young(found, s) == pytest.approx(modulus, rel=1e-6)
    assert found.g1 <= truth.g1 + 1e-9


def test_least_g1_puts_the_peak_of_the_loss_at_the_observed_frequency():
    s = complex_frequency(5.0, 0.0)
    found = from_least_g1(family(SILICONE), 3e5 * cmath.exp(0.08j), s)
    peak = loss_factor(found, 5.0)
    assert peak == pytest.approx(math.tan(0.08), rel=1e-6)
    assert peak >= max(loss_factor(found, f) for f in np.linspace(4.0, 6.0, 21)) * (1 - 2e-3)


def test_what_no_prony_term_can_do_is_refused_with_the_reason():
    s = complex_frequency(5.0, 0.02)
    with pytest.raises(RunRejected, match="static shape"):
        from_static_ratio(family(SILICONE), 4e5, complex_young(SILICONE, s), s)
    with pytest.raises(RunRejected, match="tau"):
        from_given_tau(family(SILICONE), 2e5 * cmath.exp(1.4j), s, 0.02)
