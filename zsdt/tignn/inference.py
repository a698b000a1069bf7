"""Choices of how a trained engine is computed; `zsdt.interop.inference` carries them out."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class InferenceBackend(StrEnum):
    """eager: torch, operator by operator, and loops in double precision. kernel: BLAS into standing buffers with
    compiled loops between; sums over a particle's neighbours in single precision. compiled: torch.compile, which needs
    a C++ compiler. onnx: ONNX Runtime. openvino: OpenVINO. The last three are for node forms, pay at the first step and
    hold no energy account, for the brackets do not leave them."""

    eager = "eager"
    kernel = "kernel"
    compiled = "compiled"
    onnx = "onnx"
    openvino = "openvino"


@dataclass
class InferenceOptions:
    """backend: see `InferenceBackend`; all give the same numbers to 1e-5 of a field's largest value a frame. device:
    cpu, or a device of torch (cuda, cuda:1, ...) for the network of a node form, by backend=eager or compiled."""

    backend: InferenceBackend = InferenceBackend.kernel
    device: str = "cpu"
