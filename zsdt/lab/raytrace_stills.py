"""Single ray-traced pictures of glasses: the scenes of `zsdt.lab.glass_stills`, taken by the other camera."""

from __future__ import annotations

import os
from pathlib import Path

import cv2

from zsdt.files import atomic_path
from zsdt.lab.glass_shooting import GlassFrame
from zsdt.lab.glass_stills import GlassStillOptions, plan_still, taken_still
from zsdt.lab.raytrace import RayTracer
from zsdt.lab.raytrace_options import RaytraceOptions
from zsdt.lab.styles import Pool


def raytraced_glass(
    seed: int,
    pool: Pool = Pool.train,
    size: tuple[int, int] = (384, 384),
    options: GlassStillOptions | None = None,
    raytrace: RaytraceOptions | None = None,
) -> GlassFrame:
    """A ray-traced picture (BGR) of the glasses that `zsdt.lab.glass_stills.painted_glass` paints, with its masks.

    size: (width, height) px. Same seed, pool, size and options: same bytes. Raises: OptionError without the
    extra ``zsdt[raytrace]``.
    """
    return taken_still(plan_still(seed, pool, size, options), RayTracer(raytrace), options)


def write_raytraced_glasses(
    folder: str | os.PathLike[str],
    seeds: range,
    pool: Pool = Pool.train,
    size: tuple[int, int] = (384, 384),
    options: GlassStillOptions | None = None,
    raytrace: RaytraceOptions | None = None,
) -> int:
    """Ray-traces a still for each seed that `folder` does not hold yet; gives back how many were made.

    Each is ``images/SEED.png`` with ``masks/SEED_container.png`` and ``masks/SEED_liquid.png`` (cover, 0 to 255), as
    segmentation is trained on. Raises: OptionError without the extra, DataError where the disk does not take them.
    """
    root, made = Path(folder), 0
    for seed in seeds:
        name = f"{seed:06d}"
        picture = root / "images" / f"{name}.png"
        if picture.is_file():
            continue
        still = raytraced_glass(seed, pool, size, options, raytrace)
        files = {
            root / "masks" / f"{name}_container.png": still.container_mask,
            root / "masks" / f"{name}_liquid.png": still.liquid_mask,
            picture: still.image,  # last: a picture is there only with its masks
        }
        for path, image in files.items():
            with atomic_path(path) as beside:
                beside.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        made += 1
    return made
