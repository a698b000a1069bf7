"""Ray-traced stills show what the painted ones show, and a folder of them is filled up where it was left."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from zsdt.lab.glass_stills import GlassStillOptions, painted_glass
from zsdt.lab.raytrace_options import RaytraceOptions
from zsdt.lab.raytrace_stills import raytraced_glass, write_raytraced_glasses
from zsdt.lab.styles import Pool

pytest.importorskip("mitsuba", reason="the extra zsdt[raytrace] is not installed")
SIZE = (96, 96)
STILLS = GlassStillOptions(none=0.0, two=0.0, empty=0.0, hidden=0.0, moving=0.0)
COARSE = RaytraceOptions(samples=2)


def test_a_seed_shows_the_same_glass_to_both_cameras() -> None:
    for seed in (3, 4):
        traced = raytraced_glass(seed, Pool.train, SIZE, STILLS, COARSE)
        painted = painted_glass(seed, Pool.train, SIZE, STILLS)
        for name, limit in (("container_mask", 0.96), ("liquid_mask", 0.9)):
            a, b = (getattr(still, name) > 127 for still in (traced, painted))
            assert (a & b).sum() / (a | b).sum() > limit, (seed, name)
        assert np.abs(traced.image.astype(float) - painted.image).max() > 10.0


def test_a_folder_is_filled_up(tmp_path: Path) -> None:
    assert write_raytraced_glasses(tmp_path, range(2), Pool.unseen, SIZE, STILLS, COARSE) == 2
    before = (tmp_path / "images" / "000001.png").read_bytes()
    (tmp_path / "images" / "000000.png").unlink()
    assert write_raytraced_glasses(tmp_path, range(2), Pool.unseen, SIZE, STILLS, COARSE) == 1
    assert (tmp_path / "images" / "000001.png").read_bytes() == before
    again = raytraced_glass(0, Pool.unseen, SIZE, STILLS, COARSE)
    kept = [cv2.imread(str(tmp_path / "masks" / f"000000_{part}.png"), 0) for part in ("container", "liquid")]
    np.testing.assert_array_equal(kept[0], again.container_mask)
    np.testing.assert_array_equal(kept[1], again.liquid_mask)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "images" / "000000.png")), again.image)
