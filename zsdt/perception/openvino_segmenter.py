"""The U-Net through OpenVINO, an optional package. Converted in memory, compiled once for each picture size."""

from __future__ import annotations

import importlib
import logging
import sys
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.perception.unet import UNet

log = logging.getLogger(__name__)


def load_openvino() -> Any:
    """The module, without its usage reports.

    OpenVINO tells its maker when it is imported unless its telemetry package is absent; no experiment should talk to
    the network, so that package is hidden. Raises: OptionError where OpenVINO is not installed.
    """
    if "openvino" not in sys.modules:
        sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    try:
        module = importlib.import_module("openvino")
    except ImportError as error:
        raise OptionError(
            "The segmentation backend openvino is not installed; run `pip install openvino` or choose "
            "backend=eager, which gives the same result."
        ) from error
    if "absl.logging" in sys.modules:
        # It comes along, and its handler closes the stderr that it found, redirected or not, when logging is set up
        # anew; the stderr of the process it leaves open.
        sys.modules["absl.logging"].get_absl_handler().python_handler.stream = sys.__stderr__
    return module


class OpenVinoNetwork:
    """Pictures [batch, h, w, 3] of values -0.5..0.5 -> probabilities [batch, outputs, h, w] of a U-Net.

    half: in bfloat16, else single precision. As many threads as torch has when a picture size comes for the first time.
    """

    def __init__(self, network: UNet, half: bool = False):
        self._openvino, self._precision = load_openvino(), "bf16" if half else "f32"
        self._network = network.eval()
        self._core = self._openvino.Core()
        self._compiled: dict[tuple[int, ...], Any] = {}

    def __call__(self, picture: Float[np.ndarray, "batch h w 3"]) -> Float[np.ndarray, "batch outputs h w"]:
        """See the class."""
        channels_first = np.ascontiguousarray(picture.transpose(0, 3, 1, 2))
        return np.array(self._at(channels_first.shape)(channels_first)[0])  # its own memory is used anew

    def _at(self, shape: tuple[int, ...]) -> Any:
        """The network compiled for pictures of one shape."""
        if shape not in self._compiled:
            whole = torch.nn.Sequential(self._network, torch.nn.Sigmoid())
            model = self._openvino.convert_model(
                whole, example_input=torch.zeros(shape), input=self._openvino.PartialShape(list(shape))
            )
            settings = {
                "INFERENCE_PRECISION_HINT": self._precision,
                "INFERENCE_NUM_THREADS": str(torch.get_num_threads()),
            }
            self._compiled[shape] = self._core.compile_model(model, "CPU", settings)
            log.info("OpenVINO compiled the segmentation for %d x %d px", shape[3], shape[2])
        return self._compiled[shape]
