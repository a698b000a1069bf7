"""Where paint of the grid is, as a probability for every pixel: one interface, several ways to compute it.

eager is torch, always there. openvino is an optional extra that gives the same numbers (to 1e-3) in less time on Intel
and ARM processors. Either computes in bfloat16 where the processor multiplies that itself, in half the time: about one
pixel in 10,000 then falls on the other side of a border.
"""

from __future__ import annotations

import importlib.util
import logging
from enum import StrEnum
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from zsdt.errors import OptionError
from zsdt.perception.unet import UNet
from zsdt.perception.unet_weights import load_unet

WORKING_SIDE = 1280  # px: larger pictures are shrunk to this before segmentation, where lines look as in training


log = logging.getLogger(__name__)


class SegmentationBackend(StrEnum):
    """eager: torch. openvino: needs the optional package of that name. bf16: convolutions in bfloat16, on processors
    that have it. fastest: the fastest of these that this machine can do; the log says which."""

    eager = "eager"
    eager_bf16 = "eager_bf16"
    openvino = "openvino"
    openvino_bf16 = "openvino_bf16"
    fastest = "fastest"

    @property
    def half(self) -> bool:
        """Whether it computes in bfloat16."""
        return self in (SegmentationBackend.eager_bf16, SegmentationBackend.openvino_bf16)


@runtime_checkable
class PictureNetwork(Protocol):
    """A trained U-Net, computed in one of these ways."""

    def __call__(self, picture: Float[np.ndarray, "batch h w 3"]) -> Float[np.ndarray, "batch outputs h w"]:
        """Probabilities of pictures of values -0.5..0.5."""


def computed_by(network: UNet, backend: SegmentationBackend) -> PictureNetwork:
    """The network, ready for inference.

    Raises: OptionError where the backend is not installed or needs what the processor has not.
    """
    backend = resolved(SegmentationBackend(backend))
    if backend.half and not has_bfloat16():
        raise OptionError(f"backend={backend} needs a processor that multiplies bfloat16; choose backend=fastest.")
    if backend in (SegmentationBackend.openvino, SegmentationBackend.openvino_bf16):
        from zsdt.perception.openvino_segmenter import OpenVinoNetwork  # an optional package

        return OpenVinoNetwork(network, backend.half)
    return EagerNetwork(network, backend.half)


def resolved(backend: SegmentationBackend) -> SegmentationBackend:
    """What `fastest` means on this machine; any other as it is."""
    if backend is not SegmentationBackend.fastest:
        return backend
    program = "openvino" if importlib.util.find_spec("openvino") else "eager"
    chosen = SegmentationBackend(program + ("_bf16" if has_bfloat16() else ""))
    log.info("the segmentation is computed by %s", chosen)
    return chosen


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 itself; elsewhere it would be imitated, slowly."""
    try:
        return "avx512_bf16" in Path("/proc/cpuinfo").read_text()
    except OSError:  # no Linux
        return False


@runtime_checkable
class Segmenter(Protocol):
    """Says where the painted grid is."""

    def probability(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Probability [h, w], float32, that a pixel of the picture (BGR) shows paint of the grid."""


def load_segmenter(folder: str | Path, backend: SegmentationBackend = SegmentationBackend.eager) -> Segmenter:
    """The U-Net in `folder`, computed by `backend`.

    Raises: DataError where the weights are missing or broken, OptionError where the backend is not installed or needs
    what the processor has not.
    """
    network = folded(load_unet(folder))
    return UNetSegmenter(computed_by(network, backend), network.multiple)


def folded(network: UNet) -> UNet:
    """The same network with every normalisation drawn into the convolution before it; for inference only."""
    for block in (*network.down, *network.up):
        assert isinstance(block, nn.Sequential)
        for k in range(0, len(block), 3):
            convolution, normalisation = block[k], block[k + 1]
            assert isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d)
            block[k], block[k + 1] = fuse_conv_bn_eval(convolution, normalisation), nn.Identity()
    return network.eval()


class EagerNetwork:
    """A U-Net by torch, channels last, on as many threads as torch has. See `PictureNetwork`."""

    def __init__(self, network: UNet, half: bool = False):
        self._network, self._half = network.eval(), half

    def __call__(self, picture: Float[np.ndarray, "batch h w 3"]) -> Float[np.ndarray, "batch outputs h w"]:
        """See `PictureNetwork`."""
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=self._half):
            logit = self._network(torch.from_numpy(picture).permute(0, 3, 1, 2))
            return np.asarray(torch.sigmoid(logit.float()).numpy(), np.float32)


class UNetSegmenter:
    """See `Segmenter`."""

    def __init__(self, network: PictureNetwork, multiple: int):
        self._network, self._multiple = network, multiple

    def probability(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """See `Segmenter`."""
        picture, size = prepared(image, self._multiple)
        return finished(self._network(picture)[0, 0], size, image)


def prepared(
    image: UInt8[np.ndarray, "h w 3"], multiple: int
) -> tuple[Float[np.ndarray, "1 height width 3"], tuple[int, int]]:
    """Picture as the network wants it, values -0.5..0.5, and its height and width before padding.

    Larger pictures are shrunk to `WORKING_SIDE`; the border is continued up to multiples of `multiple`.
    """
    h, w = image.shape[:2]
    shrink = min(1.0, WORKING_SIDE / max(h, w))
    if shrink < 1.0:
        h, w = max(1, round(h * shrink)), max(1, round(w * shrink))
        image = np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA), np.uint8)
    bottom, right = -h % multiple, -w % multiple
    if bottom or right:
        image = np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    return normalised(image)[None], (h, w)


def normalised(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Values -0.5..0.5, float32."""
    return np.asarray(image, np.float32) * np.float32(1 / 255) - np.float32(0.5)


def finished(
    answer: Float[np.ndarray, "height width"], size: tuple[int, int], image: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """The network's answer without its padding, at the size of the picture."""
    h, w = size
    answer = np.ascontiguousarray(answer[:h, :w], np.float32)
    if image.shape[:2] != (h, w):
        answer = cv2.resize(answer, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(answer, np.float32)
