"""Families of vessels: every draw is a vessel that holds what was asked for, and looks like its family."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.fluid.families import draw_shape
from zsdt.fluid.vessel import Vessel
from zsdt.scene import VesselFamily


@pytest.mark.parametrize("family", list(VesselFamily), ids=lambda f: f.value)
def test_draws_keep_what_was_asked_for(family):
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(200):
        radius, fill, freeboard = rng.uniform(0.025, 0.05), rng.uniform(0.03, 0.08), rng.uniform(0.05, 0.08)
        shape = draw_shape(family, radius, fill, freeboard, rng)
        assert shape.family is family
        assert shape.rim == pytest.approx(fill + freeboard, abs=1e-6)
        at = float(np.interp(fill / 2, shape.heights, shape.radii)) if family is VesselFamily.tumbler else None
        assert (at or max(shape.radii)) == pytest.approx(radius, abs=2e-6)
        assert min(shape.radii) >= 0.35 * radius - 1e-6 and max(shape.radii) < 0.07
        low, high = Vessel(shape).bounds()
        box = np.prod(high[:2] - low[:2]) * fill
        assert 0.2 * box < Vessel(shape).volume(fill) < box
        seen.add((*shape.radii, shape.aspect))
    assert len(seen) == 200


def test_shapes_are_what_their_names_say():
    rng = np.random.default_rng(1)

    def radii(family):
        return np.array(draw_shape(family, 0.04, 0.06, 0.06, rng).radii)

    for _ in range(20):
        assert len(set(radii(VesselFamily.cylinder))) == 1
        assert np.all(np.diff(radii(VesselFamily.tumbler)) > 0)
        flask = radii(VesselFamily.flask)
        assert np.all(np.diff(flask) <= 0) and flask[-1] <= 0.65 * flask[0] + 1e-6
        bowl = radii(VesselFamily.bowl)
        widest = int(bowl.argmax())
        assert np.all(np.diff(bowl[: widest + 1]) > 0) and np.all(np.diff(bowl[widest:]) < 0)
        jar = draw_shape(VesselFamily.jar, 0.04, 0.06, 0.06, rng)
        assert jar.is_prism and not jar.is_round and jar.aspect <= 1.0 and jar.exponent > 2.0


def test_same_seed_same_shape_and_nonsense_is_refused():
    a, b = (draw_shape(VesselFamily.bowl, 0.04, 0.06, 0.06, np.random.default_rng(7)) for _ in range(2))
    assert a == b
    with pytest.raises(OptionError, match="must be positive"):
        draw_shape(VesselFamily.bowl, 0.04, 0.0, 0.06, np.random.default_rng(7))
