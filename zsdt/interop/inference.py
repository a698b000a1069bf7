"""One switch for how a trained network is computed: `with_backend(load_engine(folder), InferenceBackend.kernel)`.

Every backend gives an `Engine` whose numbers are those of the eager one to 1e-5 of a field's largest value a frame.
Engines that are compiled loops already (sub-step forms, solvers) have two: `kernel` sums over neighbours in single
precision where the engine can, `eager` all in double.
"""

from __future__ import annotations

import copy
import importlib.util
import logging
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zsdt.errors import OptionError
from zsdt.interop.onnx_engine import OnnxLiquidModel, OnnxNodeEngine
from zsdt.interop.onnx_files import OnnxFile, write_onnx
from zsdt.interop.onnx_networks import LiquidStepNetwork, StepNetwork, card_of
from zsdt.tignn.engine import Engine
from zsdt.tignn.inference import InferenceBackend, InferenceOptions
from zsdt.tignn.inference_networks import FastFeatures, accelerated, eager_of
from zsdt.tignn.liquid_engine import LiquidEngine
from zsdt.tignn.node_engine import NodeEngine
from zsdt.tignn.particle_engine import ParticleEngine

log = logging.getLogger(__name__)


PACKAGES = {InferenceBackend.onnx: ("onnx", "onnxruntime"), InferenceBackend.openvino: ("onnx", "openvino")}


def with_backend(engine: Engine, backend: InferenceOptions | InferenceBackend | str) -> Engine:
    """`engine` computed by `backend`; the given one stays as it is. Call `prepare` of the new one.

    Raises: OptionError where the backend does not suit the engine or is not installed.
    """
    device = backend.device if isinstance(backend, InferenceOptions) else "cpu"
    try:
        backend = InferenceBackend(backend.backend if isinstance(backend, InferenceOptions) else backend)
    except ValueError as error:
        known = ", ".join(b.value for b in InferenceBackend)
        raise OptionError(f"'{backend}' is no inference backend; known are {known}.") from error
    if device != "cpu":
        return _on_device(engine, backend, device)
    if isinstance(engine, ParticleEngine):
        _refuse_traced(engine, backend)
        other = copy.copy(engine)
        other.single = backend is InferenceBackend.kernel
        return other
    if not isinstance(engine, NodeEngine | LiquidEngine):
        _refuse_traced(engine, backend)
        return engine
    plain = _as_eager(engine)
    if backend is InferenceBackend.eager:
        return plain
    return _accelerated(plain) if backend is InferenceBackend.kernel else _traced(plain, backend)


def backends(engine: Engine) -> list[str]:
    """Names of the backends that suit an engine and can run on this machine."""
    found = []
    for backend in InferenceBackend:
        try:
            _check(engine, backend)
        except OptionError:
            continue
        found.append(backend.value)
    return found


def _check(engine: Engine, backend: InferenceBackend) -> None:
    if backend in (InferenceBackend.eager, InferenceBackend.kernel):
        return
    if not isinstance(engine, NodeEngine | LiquidEngine):
        _refuse_traced(engine, backend)
    _network(engine)
    if backend is InferenceBackend.compiled and not any(shutil.which(name) for name in ("c++", "g++", "clang++")):
        raise OptionError("inference.backend=compiled needs a C++ compiler, and none is on the path; choose kernel.")
    for package in PACKAGES.get(backend, ()):
        if importlib.util.find_spec(package) is None:
            raise OptionError(f"inference.backend={backend.value} needs the package {package}: pip install {package}.")


def _refuse_traced(engine: Engine, backend: InferenceBackend) -> None:
    if backend not in (InferenceBackend.eager, InferenceBackend.kernel):
        raise OptionError(
            f"The engine '{engine.name}' is a compiled loop of many small steps and no network that "
            f"inference.backend={backend.value} could take; choose kernel."
        )


def _as_eager(engine: NodeEngine | LiquidEngine) -> NodeEngine | LiquidEngine:
    """The engine before it was accelerated."""
    if eager_of(engine.model) is engine.model:
        return engine
    other: Any = copy.copy(engine)
    other.model = eager_of(engine.model)
    return other


def _accelerated(engine: NodeEngine | LiquidEngine) -> Engine:
    other: Any = copy.copy(engine)
    model: Any = accelerated(engine.model)
    if isinstance(engine, NodeEngine):
        model.look = FastFeatures()
    other.model = model
    return other


def _network(engine: Any) -> StepNetwork | LiquidStepNetwork:
    """Its network as a function of tensors. Raises: OptionError where that cannot be."""
    if any(p.dtype != torch.float32 for p in eager_of(engine.model).parameters()):
        raise OptionError("Traced inference backends are in single precision; choose eager or kernel for double.")
    model: Any = copy.deepcopy(eager_of(engine.model))
    return LiquidStepNetwork(model) if isinstance(engine, LiquidEngine) else StepNetwork(model)


def _traced(engine: NodeEngine | LiquidEngine, backend: InferenceBackend) -> Engine:
    _check(engine, backend)
    network = _network(engine)
    file: Any
    if backend is InferenceBackend.compiled:
        file = TorchNetwork(network, compiled=True)
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "network.onnx"
            write_onnx(path, network, card_of(network))
            threads = torch.get_num_threads()
            file = OnnxFile(path, threads) if backend is InferenceBackend.onnx else OpenVinoFile(path, network, threads)
    return _around(file, engine, backend.value)


def _around(file: Any, engine: Engine, what: str) -> Engine:
    """An engine on a network of named tensors."""
    if isinstance(engine, LiquidEngine):
        return LiquidEngine(OnnxLiquidModel(file), f"{engine.name} ({what})")
    found = OnnxNodeEngine(file)
    found.name = f"{engine.name} ({what})"
    return found


def _on_device(engine: Engine, backend: InferenceBackend, device: str) -> Engine:
    if not isinstance(engine, NodeEngine | LiquidEngine):
        raise OptionError(f"The engine '{engine.name}' is a compiled loop for processors; leave inference.device=cpu.")
    if backend not in (InferenceBackend.eager, InferenceBackend.compiled):
        raise OptionError(
            f"inference.backend={backend.value} runs on the cpu alone; on {device} take eager or compiled."
        )
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise OptionError(f"inference.device={device}, but torch finds no such device here; leave it at cpu.")
    if backend is InferenceBackend.compiled:
        _check(engine, backend)
    file = TorchNetwork(_network(engine), compiled=backend is InferenceBackend.compiled, device=device)
    return _around(file, engine, f"{backend.value}, {device}")


class TorchNetwork:
    """A network of named tensors by torch, on any device, compiled or not; interface of `OnnxFile`.

    Sizes may change from call to call. Tensors come from the processor's memory and go back there.
    """

    def __init__(self, network: Any, compiled: bool = False, device: str = "cpu"):
        self.inputs, self.outputs, self.card = list(network.inputs), network.outputs, card_of(network)
        self.device = torch.device(device)
        whole = network.eval().to(self.device)
        self.call: Callable[..., tuple[torch.Tensor, ...]] = torch.compile(whole, dynamic=True) if compiled else whole

    def run(self, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Outputs by name, on the device."""
        given = [tensors[name].to(self.device) for name in self.inputs]
        # Constants made on the way are made there, too.
        there = nullcontext() if self.device.type == "cpu" else self.device
        # The compiler's own guards fail on constants that are made in inference mode.
        with torch.inference_mode(False), torch.no_grad(), there:
            return dict(zip(self.outputs, self.call(*given), strict=True))

    def __call__(self, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Outputs by name."""
        return {name: value.cpu() for name, value in self.run(tensors).items()}


class OpenVinoFile:
    """An ONNX file through OpenVINO in single precision; interface of `OnnxFile`."""

    def __init__(self, path: Path, network: Any, threads: int):
        from zsdt.perception.openvino_segmenter import load_openvino  # an optional package

        module = load_openvino()
        self.inputs, self.outputs, self.card = list(network.inputs), network.outputs, card_of(network)
        core = module.Core()
        settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": str(threads)}
        self._network = core.compile_model(core.read_model(str(path)), "CPU", settings)

    def __call__(self, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Outputs by name."""
        given = {name: np.ascontiguousarray(tensors[name].numpy()) for name in self.inputs}
        found = self._network(given)
        return {name: torch.from_numpy(np.array(found[name])) for name in self.outputs}
