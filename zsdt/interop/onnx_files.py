"""ONNX files: writing a network with a card of what it is, opening it in ONNX Runtime, and comparing both.

Needs the optional packages onnx, onnxscript (to write) and onnxruntime (to run); see `pip install 'zsdt[onnx]'`.
"""

from __future__ import annotations

import importlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path
from zsdt.graph import brick_grid, graph_of
from zsdt.interop.onnx_networks import INDICES, MaskNetwork, Shape
from zsdt.logs import errors_alone

OPSET = 20
CARD = "zsdt"  # key of the metadata
TOLERANCE = 1e-4  # of the largest value of an output


def optional(package: str) -> Any:
    """An optional package of the extra `onnx`. Raises: OptionError where it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise OptionError(
            f"ONNX files need the package {package}, which is not installed; run `pip install 'zsdt[onnx]'`."
        ) from error


def write_onnx(path: str | os.PathLike[str], network: Any, card: Mapping[str, Any]) -> None:
    """Writes a network of `zsdt.interop.onnx_networks` with its `card` (JSON) in the metadata under `zsdt`.

    Every dimension with a name may have any length; for a `MaskNetwork` the sides of the picture may be any multiple
    of `multiple`. Raises: OptionError where a package is missing; DataError where the disk does not take it.
    """
    onnx = optional("onnx")
    optional("onnxscript")
    example = made_up(network, (2, 2, 2), seed=0)
    shapes = (tuple(_dimensions(network)),)
    with _quiet():
        program = torch.onnx.export(
            network.eval(),
            tuple(example.values()),
            dynamo=True,
            dynamic_shapes=shapes,
            input_names=list(network.inputs),
            output_names=list(network.outputs),
            opset_version=OPSET,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.producer_name, model.doc_string = "zsdt", " ".join((type(network).__doc__ or "").split())
    onnx.helper.set_model_props(model, {CARD: json.dumps(card, sort_keys=True)})
    for node in [*model.graph.node, *(n for f in model.functions for n in f.node)]:
        del node.metadata_props[:]  # where in which source file a node came from: paths of the machine that wrote it
    for value in [*model.graph.value_info, *model.graph.input, *model.graph.output]:
        del value.metadata_props[:]
    onnx.checker.check_model(model)
    with atomic_path(path) as beside:
        beside.write_bytes(model.SerializeToString(deterministic=True))


def _dimensions(network: Any) -> Iterator[dict[int, Any]]:
    """What may have any length, input by input."""
    named: dict[str, Any] = {}
    for shape in network.inputs.values():
        for name in (size for size in shape if isinstance(size, str)):
            least = 1 if name == "batch" else 2
            named.setdefault(name, torch.export.Dim(name, min=least))
    if isinstance(network, MaskNetwork):
        for side, count in (("height", "rows"), ("width", "columns")):
            named[side] = network.multiple * torch.export.Dim(count, min=1)
    for shape in network.inputs.values():
        yield {k: named[size] for k, size in enumerate(shape) if isinstance(size, str)}


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter's own progress is left out: warnings about torchvision, axis names and future versions."""
    with errors_alone("torch.onnx"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def made_up(network: Any, counts: tuple[int, int, int], seed: int) -> dict[str, torch.Tensor]:
    """Random inputs of a network on a grid of `counts` bricks (pictures: of so many multiples), to trace and to check.

    Columns of one number are positive, as time steps and lengths are; tensors of 3 x 3 are near the identity.
    """
    draw = torch.Generator().manual_seed(seed)
    grid = brick_grid(counts, 1.0)
    graph = graph_of(len(grid.points), grid.pairs)
    rows = np.empty((len(graph.pairs), 2), np.int64)
    rows[graph.pair, (graph.sign < 0).astype(np.int64)] = np.arange(len(graph.pair))
    to = np.repeat(np.arange(graph.nodes), np.diff(graph.offset))
    indices = {"to": to, "source": graph.neighbour, "pairs": graph.pairs, "rows": rows}
    sizes = {"nodes": graph.nodes, "directed": len(to), "pairs": len(rows), "batch": 1}
    multiple = getattr(network, "multiple", 1)
    sizes |= {"height": counts[0] * multiple, "width": counts[1] * multiple}

    def values(name: str, shape: Shape) -> torch.Tensor:
        if name in INDICES:
            return torch.from_numpy(indices[name])
        drawn = torch.randn([sizes[s] if isinstance(s, str) else s for s in shape], generator=draw)
        if shape[1:] == (1,):
            return drawn.abs() + 0.5
        return torch.eye(3) + 0.1 * drawn if shape[1:] == (3, 3) and name == "deformation" else drawn

    return {name: values(name, shape) for name, shape in network.inputs.items()}


class OnnxFile:
    """An ONNX file in ONNX Runtime on the CPU. card: what `write_onnx` wrote about it; inputs: their names.

    Raises: DataError where the file is missing, broken or has no card; OptionError where onnxruntime is not installed.
    """

    def __init__(self, path: str | os.PathLike[str], threads: int = 1):
        runtime = optional("onnxruntime")
        if not Path(path).is_file():
            raise DataError(f"There is no ONNX file {path}; write one with `python -m pipelines.export onnx`.")
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        try:
            self.session = runtime.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its own exceptions have no base class
            raise DataError(f"The ONNX file {path} cannot be opened ({error}); write it again.") from error
        card = self.session.get_modelmeta().custom_metadata_map.get(CARD)
        if card is None:
            raise DataError(f"The ONNX file {path} has no card of zsdt; open it with onnxruntime itself.")
        self.card: dict[str, Any] = json.loads(card)
        self.inputs = [value.name for value in self.session.get_inputs()]
        self.outputs = [value.name for value in self.session.get_outputs()]

    def __call__(self, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Outputs by name from inputs by name."""
        feed = {name: tensors[name].numpy() for name in self.inputs}
        return dict(zip(self.outputs, map(torch.from_numpy, self.session.run(None, feed)), strict=True))


def difference(file: OnnxFile, network: nn.Module, tensors: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """Largest difference between the file and the network it was made of, over the largest value, for every output."""
    with torch.no_grad():
        wanted = network(*tensors.values())
    given = file(tensors)
    found = {}
    for name, value in zip(file.outputs, wanted, strict=True):
        size = float(value.abs().max().clamp_min(torch.finfo(value.dtype).tiny))
        found[name] = float((given[name] - value).abs().max()) / size
    return found
