"""Hard cases of a camera, as data: what goes wrong between a beam that is filmed and a twin that looks.

The pictures are those of one painted clip of the virtual lab; the rest is the twin as it is shipped: segmentation,
tracking, loop. A case is reproducible by its name.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Trouble(StrEnum):
    """What goes wrong, and what its size means.

    nothing; noise: grey levels (standard deviation); blur: px (standard deviation); occlusion: share of the nodes
    hidden for half a second; dropped, doubled: share of the frames; swapped: share of the frames that change places
    with the next; frozen: frames that show the same picture; exposure: factor by which every 15 frames the light jumps
    up and down; jitter: px by which the picture jumps (standard deviation); depth, focal: relative error of what is
    told.
    """

    nothing = "nothing"
    noise = "noise"
    blur = "blur"
    occlusion = "occlusion"
    dropped = "dropped"
    doubled = "doubled"
    swapped = "swapped"
    frozen = "frozen"
    exposure = "exposure"
    jitter = "jitter"
    depth = "depth"
    focal = "focal"


@dataclass(frozen=True)
class CameraCase:
    """A trouble of some `size` (see `Trouble`) from frame `start` on; seed of what is random."""

    name: str
    what: str
    trouble: Trouble
    size: float = 0.0
    start: int = 20
    frames: int = 90
    seed: int = 0
    normal: bool = False

    @property
    def kind(self) -> str:
        """What the case is about."""
        return "camera"

    @property
    def cost(self) -> float:
        """About how long it takes, beside other cases."""
        return 2e3


CAMERA_CASES = (
    CameraCase("normal_camera", "the clip as it is", Trouble.nothing, normal=True),
    CameraCase("noise", "noise of 12 grey levels", Trouble.noise, 12.0),
    CameraCase("noise_heavy", "noise of 40 grey levels", Trouble.noise, 40.0),
    CameraCase("blur", "out of focus by 4 px", Trouble.blur, 4.0),
    CameraCase("occlusion", "half of the nodes hidden for half a second", Trouble.occlusion, 0.5),
    CameraCase("occlusion_all", "all nodes hidden for half a second", Trouble.occlusion, 1.0),
    CameraCase("dropped", "20 % of the frames never come", Trouble.dropped, 0.2),
    CameraCase("doubled", "20 % of the frames show the one before", Trouble.doubled, 0.2),
    CameraCase("swapped", "20 % of the frames change places with the next", Trouble.swapped, 0.2),
    CameraCase("frozen", "the picture freezes for half a second", Trouble.frozen, 30.0),
    CameraCase("exposure", "the light jumps by a factor of 2 every 15 frames", Trouble.exposure, 2.0),
    CameraCase("jitter", "the picture jumps by 3 px", Trouble.jitter, 3.0),
    CameraCase("depth_10", "told a distance 10 % too far", Trouble.depth, 0.1),
    CameraCase("depth_minus_10", "told a distance 10 % too near", Trouble.depth, -0.1),
    CameraCase("focal_10", "told a focal length 10 % too long", Trouble.focal, 0.1),
    CameraCase("focal_minus_10", "told a focal length 10 % too short", Trouble.focal, -0.1),
)  # fmt: skip
