"""Random bodies and states for the tests of the node form."""

import numpy as np
import pytest
import torch

from zsdt.graph import brick_grid
from zsdt.scene import Foam
from zsdt.tignn.features import NodeState, Scales, body_batch, cast
from zsdt.tignn.model import NodeModel
from zsdt.tignn.options import TignnOptions
from zsdt.trajectory import Body, Trajectory

torch.set_num_threads(1)


def make_body(counts: tuple[int, int, int] = (4, 2, 2), pitch: float = 0.05, seed: int = 0) -> Body:
    """Brick grid with a few random extra edges, so that nothing rests on a regular graph."""
    grid = brick_grid(counts, pitch)
    draw = np.random.default_rng(seed)
    nodes = len(grid.points)
    extra = np.sort(draw.integers(nodes, size=(5, 2)), axis=1)
    pairs = np.unique(np.concatenate([grid.pairs, extra[extra[:, 0] < extra[:, 1]]]), axis=0)
    return Body(
        points=grid.points,
        pairs=pairs,
        cells=grid.cells,
        clamped=grid.points[:, 0] < 1e-9,
        mass=draw.uniform(0.5, 1.5, nodes) * 18.44 * pitch**3,
        frame_dt=1 / 60,
        pitch=pitch,
        material=Foam(),
    )


def make_trajectory(body: Body, frames: int = 8, seed: int = 0, energies: bool = True) -> Trajectory:
    """Smooth random motion: not physics, but of the right shape and size."""
    draw = np.random.default_rng(seed)
    times = body.frame_dt * np.arange(frames)
    shape = body.points[:, :1] * draw.normal(size=(body.nodes, 3)) * 0.02
    part = (times / times[-1])[:, None, None]
    phase = 1 + part + part**2
    stress = draw.normal(size=(body.nodes, 6)) * 50.0
    fields = {
        "position": body.points + shape * phase,
        "velocity": shape * (1 + 2 * part) / times[-1],
        "stress": stress * phase,
    }
    if energies:
        fields["elastic_energy"] = np.abs(stress[:, :1]) * 0.1 * phase**2
        fields["dissipated_energy"] = np.abs(stress[:, 1:2]) * 0.05 * phase
    load = np.zeros((frames, body.nodes, 3))
    load[:, -1, 2] = -0.1 * np.arange(frames)
    meta = {"name": f"made_{seed}", "regime": "hand", "family": "test"}
    return Trajectory(body=body, times=times, fields=fields, load=load, meta=meta)


@pytest.fixture
def body() -> Body:
    return make_body()


def random_state(body: Body, options: TignnOptions, seed: int = 0) -> NodeState:
    """State with numbers of order one times the scales that `unit_model` uses."""
    draw = torch.Generator().manual_seed(seed)

    def normal(columns: int) -> torch.Tensor:
        return torch.randn(body.nodes, columns, generator=draw, dtype=torch.float64)

    free = torch.as_tensor(~body.clamped, dtype=torch.float64)[:, None]
    thermal = normal(2).abs() if options.energy.value == "physical" else torch.zeros(body.nodes, 0).double()
    return NodeState(0.01 * normal(3) * free, normal(3) * free, normal(6), normal(3 * options.history), thermal)


def unit_model(options: TignnOptions, seed: int = 0) -> NodeModel:
    """Random weights in float64, larger than the initial ones so that no term hides."""
    torch.manual_seed(seed)
    increments = {"d_velocity": 0.1, "d_pressure": 0.1, "d_deviator": 0.1, "d_thermal": 0.1}
    scales = Scales(strain=0.2, rate=20.0, frame_dt=1 / 60, node_volume=1.25e-4, **increments)
    model = NodeModel(options, scales).double().eval()
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(1.3)
    return model


def loads_of(body: Body, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed + 100)
    load = torch.zeros(body.nodes, 3, dtype=torch.float64)
    load[-3:] = torch.randn(3, 3, generator=draw, dtype=torch.float64)
    return load, 1.5 * load


def batch_in_double(body: Body):
    return body_batch(body, torch.float64)


__all__ = ["batch_in_double", "cast", "loads_of", "make_body", "make_trajectory", "random_state", "unit_model"]
