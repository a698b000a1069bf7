"""Closed forms of a bending cantilever against textbook numbers, each other, and the finite elements."""

import math

import numpy as np
import pytest

from zsdt.errors import DataError, OptionError
from zsdt.scene import BeamShape, Foam
from zsdt.solid.bending import Cantilever
from zsdt.solid.loads import bending_frequency
from zsdt.solid.specimen import Specimen, SpecimenFem

SHAPE = BeamShape(0.1, 0.03, 0.03)
YOUNG, SECOND = 263.8e3, 0.03**4 / 12.0


def test_self_weight_drops_by_q_l4_over_8_ei():
    beam = Cantilever(SHAPE, 1070.0)
    q = 1070.0 * 9.81 * 0.03**2
    assert beam.tip_drop(YOUNG, shear=False) == pytest.approx(q * 0.1**4 / (8 * YOUNG * SECOND), rel=1e-12)
    assert beam.tip_drop(YOUNG, shear=False) == pytest.approx(6.63e-3, rel=2e-3)  # SOURCE.md of the data


def test_tip_mass_adds_p_l3_over_3_ei_and_shear_adds_p_l_over_kappa_g_a():
    free, loaded = Cantilever(SHAPE, 1070.0), Cantilever(SHAPE, 1070.0, 0.052)
    p = 0.052 * 9.81
    bent = loaded.tip_drop(YOUNG, shear=False) - free.tip_drop(YOUNG, shear=False)
    assert bent == pytest.approx(p * 0.1**3 / (3 * YOUNG * SECOND), rel=1e-12)
    kappa, modulus = 10 * 1.45 / (12 + 11 * 0.45), YOUNG / 2.9
    sheared = loaded.tip_drop(YOUNG) - free.tip_drop(YOUNG) - bent
    assert sheared == pytest.approx(p * 0.1 / (kappa * modulus * 0.03**2), rel=1e-12)


def test_frequency_without_mass_is_the_textbook_one():
    beam = Cantilever(SHAPE, 1070.0)
    exact = 3.5160153 / (2 * math.pi * 0.1**2) * math.sqrt(YOUNG * SECOND / (1070.0 * 0.03**2))
    assert beam.frequency(YOUNG, shear=False) == pytest.approx(exact, rel=1e-6)
    assert beam.frequency(YOUNG, shear=False) == pytest.approx(7.61, abs=0.01)  # SOURCE.md of the data


def test_heavy_tip_mass_gives_the_frequency_of_a_spring():
    beam = Cantilever(SHAPE, 1070.0, tip_mass=50.0)
    spring = math.sqrt(3 * YOUNG * SECOND / 0.1**3 / (50.0 + 33 / 140 * beam.mass)) / (2 * math.pi)
    assert beam.frequency(YOUNG, shear=False) == pytest.approx(spring, rel=1e-3)


def test_agrees_with_the_frequency_that_loads_are_drawn_with():
    foam = Foam(g1=0.0)
    shape = BeamShape(0.55, 0.2, 0.2)
    assert Cantilever(shape, foam.density, poisson=foam.poisson).frequency(foam.young) == pytest.approx(
        bending_frequency(shape, foam), rel=1e-6
    )


def test_young_comes_back_from_the_shape_and_a_shape_that_rises_is_refused():
    beam = Cantilever(SHAPE, 1070.0, 0.02)
    x = np.linspace(0.02, 0.1, 7)
    assert beam.young_from_shape(x, beam.deflection(x, YOUNG)) == pytest.approx(YOUNG, rel=1e-12)
    with pytest.raises(DataError, match="does not sag"):
        beam.young_from_shape(x, -beam.deflection(x, YOUNG))
    with pytest.raises(OptionError, match="tip mass"):
        Cantilever(SHAPE, 1070.0, -0.1)


def test_finite_elements_with_a_hung_mass_meet_beam_theory_where_it_holds():
    """60 x 5 x 5 cm, a stiff card so that it bends little: drop under own weight and mass, and the slow swing."""
    stiff = Foam(young=3e6, poisson=0.0, g1=0.0)
    specimen = Specimen(BeamShape(0.6, 0.05, 0.05), stiff.density, 0.025, tip_mass=0.05)
    fem = SpecimenFem(specimen, np.array([[0.6, 0.025, 0.025]]))
    theory = specimen.beam_theory(0.0)
    drop = -fem.rest(stiff)[0, 2]
    assert drop == pytest.approx(theory.tip_drop(stiff.young), rel=0.01)
    height = fem.swing(stiff, 120, 0.005)[:, 0, 2] + drop  # let go straight: a cosine about the rest
    falling = np.flatnonzero((height[:-1] > 0) & (height[1:] <= 0))
    crossing = falling + height[falling] / (height[falling] - height[falling + 1])
    assert 1.0 / (0.005 * np.diff(crossing).mean()) == pytest.approx(theory.frequency(stiff.young), rel=0.01)
