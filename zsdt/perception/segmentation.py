"""Where paint of the grid is, as a probability for every pixel: one interface, several ways to compute it.

eager is torch, always there. openvino is an optional extra that gives the same numbers (to 1e-3) in less time on Intel
and ARM processors.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from zsdt.perception.unet import UNet
from zsdt.perception.unet_weights import load_unet

WORKING_SIDE = 1280  # px: larger pictures are shrunk to this before segmentation, where lines look as in training


class SegmentationBackend(StrEnum):
    """eager: torch. openvino: needs the optional package of that name."""

    eager = "eager"
    openvino = "openvino"


@runtime_checkable
class Segmenter(Protocol):
    """Says where the painted grid is."""

    def probability(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Probability [h, w], float32, that a pixel of the picture (BGR) shows paint of the grid."""


def load_segmenter(folder: str | Path, backend: SegmentationBackend = SegmentationBackend.eager) -> Segmenter:
    """The U-Net in `folder`, computed by `backend`.

    Raises: DataError where the weights are missing or broken, OptionError where the backend is not installed.
    """
    network = folded(load_unet(folder))
    if SegmentationBackend(backend) is SegmentationBackend.openvino:
        from zsdt.perception.openvino_segmenter import OpenVinoSegmenter  # an optional package

        return OpenVinoSegmenter(network)
    return EagerSegmenter(network)


def folded(network: UNet) -> UNet:
    """The same network with every normalisation drawn into the convolution before it; for inference only."""
    for block in (*network.down, *network.up):
        assert isinstance(block, nn.Sequential)
        for k in range(0, len(block), 3):
            convolution, normalisation = block[k], block[k + 1]
            assert isinstance(convolution, nn.Conv2d) and isinstance(normalisation, nn.BatchNorm2d)
            block[k], block[k + 1] = fuse_conv_bn_eval(convolution, normalisation), nn.Identity()
    return network.eval()


class EagerSegmenter:
    """U-Net by torch, channels last, on as many threads as torch has."""

    def __init__(self, network: UNet):
        self._network = network.eval()

    def probability(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """See `Segmenter`."""
        picture, size = prepared(image, self._network.multiple)
        with torch.inference_mode():
            logit = self._network(torch.from_numpy(picture).permute(0, 3, 1, 2))
            answer = torch.sigmoid(logit)[0, 0].numpy()
        return finished(answer, size, image)


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
