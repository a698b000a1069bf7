"""Materials and shapes say what they are, and refuse what cannot be."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.scene import Liquid, VesselFamily, VesselShape, water


def test_pressure_is_the_linear_us_up_law_and_its_slope_the_sound_speed() -> None:
    glycerin = Liquid()
    assert glycerin.pressure(glycerin.density) == 0.0
    step = 1e-4 * glycerin.density
    slope = (glycerin.pressure(glycerin.density + step) - glycerin.pressure(glycerin.density - step)) / (2 * step)
    assert slope == pytest.approx(glycerin.sound_speed**2, rel=1e-6)
    several = glycerin.pressure(np.array([1250.0, 1270.0]))
    assert several[0] < 0 < several[1]
    assert water().density == 998.0 and water(20.0).sound_speed == 20.0


def test_a_vessel_is_round_or_a_prism() -> None:
    tumbler = VesselShape(VesselFamily.tumbler, [0.0, 0.1], [0.03, 0.04])
    assert tumbler.is_round and not tumbler.is_prism and tumbler.rim == 0.1
    jar = VesselShape(VesselFamily.jar, [0.0, 0.1], [0.04, 0.04], aspect=0.7, exponent=4.0)
    assert jar.is_prism and not jar.is_round


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"heights": [0.0]}, "as many radii as heights"),
        ({"heights": [0.01, 0.1]}, "start at 0 and rise"),
        ({"radii": [0.03, -0.03]}, "must be positive"),
        ({"radii": [0.03, 0.04], "aspect": 0.5}, "round .* or a prism"),
        ({"exponent": 1.0}, "exponent at least 2"),
    ],
)
def test_an_impossible_vessel_is_named(changes: dict, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        VesselShape(**changes)


def test_an_impossible_liquid_is_named() -> None:
    with pytest.raises(OptionError, match="must be positive"):
        Liquid(density=0.0)
