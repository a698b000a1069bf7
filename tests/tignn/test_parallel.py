"""One training in two processes learns what one process learns, but for the order in which floats are added."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.tignn.conftest import make_body, make_trajectory
from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.errors import OptionError
from zsdt.tignn import liquid_data, node_data, parallel
from zsdt.tignn.choice import read_table
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.liquid_train import LiquidTraining
from zsdt.tignn.model import NodeModel
from zsdt.tignn.options import Bracket, TignnOptions, TrainingOptions
from zsdt.tignn.train import EngineTraining, NodeTraining, train_engine
from zsdt.trajectory import DatasetEntry, write_index, write_trajectory

OPTIONS = TignnOptions(width=8, passes=1, local_passes=1, rank=1, bracket=Bracket.soft)
FAST = TrainingOptions(steps=12, batch=3, check_every=3, checkpoint_every=12, holdout_count=1, unroll=2, noise=0.01)


def solids() -> list:
    """Beams of different sizes: graphs of a batch have different numbers of nodes."""
    return [make_trajectory(make_body(n, seed=k), seed=k) for k, n in enumerate([(3, 1, 1), (4, 1, 2), (2, 2, 2)])]


def solid_training() -> tuple[EngineTraining, node_data.SampleStream]:
    torch.manual_seed(0)
    model = NodeModel(OPTIONS, node_data.scales_of(solids(), OPTIONS))
    stream = node_data.SampleStream([node_data.clip_of(t, OPTIONS) for t in solids()], model.scales, OPTIONS, FAST)
    return NodeTraining(model, FAST), stream


def liquid_training() -> tuple[EngineTraining, liquid_data.LiquidStream]:
    flows = [make_flow(make_liquid(r, 0.02, k), seed=k, name=f"flow_{k}") for k, r in enumerate((0.014, 0.018))]
    clips = [liquid_data.clip_of(flow, OPTIONS) for flow in flows]
    torch.manual_seed(0)
    model = LiquidModel(OPTIONS, liquid_data.scales_of(clips))
    return LiquidTraining(model, FAST), liquid_data.LiquidStream(clips, model.scales, FAST)


def gradient(module: EngineTraining, stream) -> torch.Tensor:
    """Of one late step (with push-forward), all weights in one row."""
    module.model.zero_grad()
    module.training_step(stream.sample(10), 10).backward()
    return torch.cat([p.grad.flatten() for p in module.model.parameters() if p.grad is not None])


@pytest.mark.parametrize("make", [solid_training, liquid_training])
def test_gradients_of_two_shares_average_to_that_of_the_batch(make, monkeypatch: pytest.MonkeyPatch) -> None:
    module, stream = make()
    whole = gradient(module, stream)
    noted: list[list[float]] = [[], []]

    def of_rank(rank: int, reduce) -> torch.Tensor:
        monkeypatch.setattr(parallel, "place", lambda: (rank, 2))
        monkeypatch.setattr(parallel.distributed, "all_reduce", reduce)
        return gradient(module, stream)

    for rank in (0, 1):  # what each process would send to the other
        of_rank(rank, lambda total, rank=rank: noted[rank].append(float(total)))
    assert noted[0] and noted[0] != noted[1], "shares of different size, so that their weights matter"
    shares = []
    for rank in (0, 1):
        sums = iter([a + b for a, b in zip(*noted, strict=True)])
        shares.append(of_rank(rank, lambda total, sums=sums: total.fill_(next(sums))))
    mean = 0.5 * (shares[0] + shares[1])
    assert torch.linalg.norm(shares[0] - whole) > 1e-2 * torch.linalg.norm(whole)
    assert torch.linalg.norm(mean - whole) < 1e-5 * torch.linalg.norm(whole)


@pytest.mark.skipif(sys.platform != "linux", reason="Processes of torch are started as on Linux.")
def test_two_processes_give_the_loss_curve_of_one(tmp_path: Path) -> None:
    entries = []
    for trajectory in solids():
        write_trajectory(tmp_path / f"{trajectory.name}.h5", trajectory)
        entries.append(DatasetEntry(f"{trajectory.name}.h5", trajectory.name, "train", "hand", "test"))
    write_index(tmp_path, entries)
    curves = []
    for devices in (1, 2):
        out = tmp_path / f"out_{devices}"
        figures = train_engine(tmp_path, OPTIONS, replace(FAST, devices=devices), out, tmp_path / f"scratch_{devices}")
        assert figures["steps"] == 12
        rows = read_table(out / "training.csv")
        curves.append(np.array([[v for k, v in row.items() if k != "cpu_seconds"] for row in rows]))
    assert curves[0].shape[0] == 4 and np.ptp(curves[0][:, 1]) > 0
    assert np.abs(curves[1] / curves[0] - 1.0).max() < 1e-4


def test_more_processes_than_graphs_are_refused() -> None:
    with pytest.raises(OptionError, match="devices = 4 must lie between 1 and batch = 3"):
        replace(FAST, devices=4)
