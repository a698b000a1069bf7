"""Stills: many kinds of glasses, masks that fit them, and the same picture for the same seed."""

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.lab.glass_stills import GlassStillOptions, painted_glass, plan_still, random_surface
from zsdt.lab.styles import Pool
from zsdt.scene import VesselFamily, VesselShape

SMALL = (96, 96)


def test_stills_are_pictures_with_masks() -> None:
    containers, liquids = [], []
    for seed in range(16):
        image, container, liquid = painted_glass(seed, Pool.train, SMALL)
        assert image.shape == (96, 96, 3) and image.dtype == np.uint8 and image.std() > 2
        assert container.shape == liquid.shape == (96, 96) and (liquid <= container).all()
        containers.append((container > 127).mean())
        liquids.append((liquid > 127).mean())
    assert 0.02 < np.mean(containers) < 0.6 and np.mean(liquids) > 0.01


def test_same_seed_same_still_and_pools_differ() -> None:
    first, again, other = (painted_glass(7, pool, SMALL) for pool in (Pool.train, Pool.train, Pool.unseen))
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    assert (first.image != other.image).any()


def test_plans_hold_all_kinds() -> None:
    plans = [plan_still(seed, Pool.unseen, SMALL) for seed in range(120)]
    counts = [len(plan.views[0].glasses) for plan in plans]
    assert set(counts) == {0, 1, 2}
    glasses = [glass for plan in plans for glass in plan.views[0].glasses]
    assert {glass.vessel.family for glass in glasses} == set(VesselFamily)
    assert 0.04 < np.mean([glass.height is None for glass in glasses]) < 0.25
    slopes = [np.ptp(g.height[-1]) / (2 * max(g.vessel.radii)) for g in glasses if g.height is not None]
    assert np.max(slopes) > 0.4 and np.min(slopes) < 0.01
    assert any(len(plan.views) > 1 for plan in plans)
    with pytest.raises(OptionError, match="shares"):
        GlassStillOptions(empty=1.5)


def test_random_surfaces_stay_in_the_vessel() -> None:
    vessel = VesselShape(VesselFamily.cylinder, [0.0, 0.05], [0.03, 0.03])
    for seed in range(40):
        height = random_surface(np.random.default_rng(seed), vessel, 0.01, 1.0)
        assert height.min() > 0.0025 and height.max() < 0.0475
