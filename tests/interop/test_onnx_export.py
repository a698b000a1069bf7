"""An ONNX file is the network: same numbers on other bodies than the traced one, and the same rollout."""

import shutil
from dataclasses import replace
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch

from tests.tignn.conftest import make_body, make_trajectory, unit_model
from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.errors import DataError, OptionError
from zsdt.interop import onnx_export
from zsdt.interop.onnx_engine import load_onnx_engine, rollout_difference
from zsdt.interop.onnx_export import export_onnx, exportable
from zsdt.interop.onnx_files import OnnxFile, made_up
from zsdt.interop.onnx_networks import StepNetwork, step_tensors
from zsdt.perception.unet import UNet, UNetOptions
from zsdt.perception.unet_weights import save_unet
from zsdt.tignn import liquid_engine, node_engine, seed_engine
from zsdt.tignn.engine import Rollout, load_engine, roll_out
from zsdt.tignn.features import body_batch
from zsdt.tignn.liquid_features import LiquidScales
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.model import start_state
from zsdt.tignn.options import Energy, Form, TignnOptions

SMALL = {"width": 16, "passes": 1, "local_passes": 1}


@pytest.fixture
def onnx():
    """The optional packages. Shapes are not checked while a network is traced: a traced length is not a number yet."""
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason=f"the optional package {package} is not installed")
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


def calm(options: TignnOptions, folder: Path) -> Path:
    """A network whose random increments are small, so that many steps stay in range."""
    model = unit_model(options)
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(0.6)
    node_engine.save_engine(model.float(), folder)
    return folder


def masks(folder: Path, seed: int = 0) -> Path:
    """A small segmentation of two classes."""
    torch.manual_seed(seed)
    options = UNetOptions([4, 6])
    save_unet(folder, UNet(options, 2), options, {})
    return folder


def test_a_file_rolls_out_as_torch_does(tmp_path: Path, onnx: None) -> None:
    folder = calm(TignnOptions(**SMALL, history=1), tmp_path / "engine")
    trajectory = make_trajectory(make_body((5, 2, 3)), frames=24)
    report = export_onnx(folder, tmp_path / "step.onnx", trajectory)
    assert report.kind == "node" and report.frames == 24 and report.worst < 1e-4
    moved = roll_out(load_onnx_engine(tmp_path / "step.onnx"), trajectory).fields["position"]
    assert np.abs(moved[-1] - moved[0]).max() > 1e-4, "it does move"
    assert str(tmp_path) not in (tmp_path / "step.onnx").read_bytes().decode("latin1")
    # Another network is not taken for it, and a file that differs does not stay.
    other = roll_out(load_engine(calm(TignnOptions(**SMALL, history=1, rank=1), tmp_path / "other")), trajectory)
    assert max(rollout_difference(other, roll_out(load_engine(folder), trajectory)).values()) > 1e-4


def test_the_network_of_a_liquid_rolls_out_as_torch_does(tmp_path: Path, onnx: None) -> None:
    torch.manual_seed(0)
    options = TignnOptions(form=Form.node, width=16, passes=1)
    scales = LiquidScales(velocity=0.1, energy=1e-3, d_velocity=0.01, d_energy=1e-4, frame_dt=0.004, viscosity=1e-3)
    liquid_engine.save_engine(LiquidModel(options, scales), tmp_path / "engine")
    report = export_onnx(tmp_path / "engine", tmp_path / "step.onnx", make_flow(make_liquid(), frames=6))
    assert report.kind == "liquid_node" and set(report.rollout) == {"position", "velocity", "internal_energy"}
    assert report.worst < 1e-4


def test_masks_of_any_picture_size(tmp_path: Path, onnx: None, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "unet.onnx"
    report = export_onnx(masks(tmp_path / "vision"), path)
    assert report.kind == "unet" and report.worst < 1e-4
    file = OnnxFile(path)
    assert file.card == {"kind": "unet", "multiple": 4, "classes": 2}
    assert file({"picture": torch.zeros(2, 3, 20, 36)})["probability"].shape == (2, 2, 20, 36)
    with pytest.raises(DataError, match="no frame after another"):
        load_onnx_engine(path)
    # A file with the numbers of another network is found out, and does not stay.
    monkeypatch.setattr(onnx_export, "write_onnx", lambda out, network, card: shutil.copy(path, out))
    with pytest.raises(DataError, match="differs from torch"):
        export_onnx(masks(tmp_path / "other", seed=1), tmp_path / "wrong.onnx")
    assert path.is_file() and not (tmp_path / "wrong.onnx").exists()


def test_the_mean_over_symmetries_comes_along() -> None:
    options = TignnOptions(**SMALL, symmetric=True)
    body = make_body()
    trajectory = make_trajectory(body)
    model = unit_model(options).float()
    batch = body_batch(body)
    state = start_state(batch, body.points, trajectory.at(1), options)
    loads = [torch.as_tensor(trajectory.load[k], dtype=torch.float32) for k in (1, 2)]
    network = StepNetwork(model)
    with torch.no_grad():
        found = dict(
            zip(
                network.outputs,
                network(*step_tensors(list(network.inputs), batch, state, *loads).values()),
                strict=True,
            )
        )
        wanted = model(batch, state, *loads).state
    for name, value in found.items():
        true = getattr(wanted, name.removesuffix("_next"))
        assert torch.allclose(value, true, rtol=1e-4, atol=1e-4 * float(true.abs().max())), name


@pytest.mark.parametrize("kind", ["cell", "particle"])
def test_compiled_forms_are_refused_with_what_to_do(tmp_path: Path, kind: str) -> None:
    (tmp_path / "engine.json").write_text(f'{{"kind": "{kind}"}}')
    with pytest.raises(OptionError, match=r"no ONNX graph; run it with zsdt .* train tignn.form=node"):
        exportable(tmp_path)


def test_the_seeds_network_to_the_letter_is_refused(tmp_path: Path) -> None:
    (tmp_path / "engine.json").write_text(f'{{"kind": "{seed_engine.KIND}"}}')
    with pytest.raises(OptionError, match="to the letter"):
        exportable(tmp_path)


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no trained network"):
        exportable(tmp_path)
    (tmp_path / "yolo.json").write_text("{}")
    with pytest.raises(OptionError, match="YOLO"):
        exportable(tmp_path)
    (tmp_path / "engine.json").write_text("{")
    with pytest.raises(DataError, match="broken"):
        exportable(tmp_path)
    options = TignnOptions(form=Form.node, width=8, passes=1, energy=Energy.physical)
    liquid_engine.save_engine(LiquidModel(options, LiquidScales()), tmp_path / "physical")
    with pytest.raises(OptionError, match="conjugate gradients"):
        exportable(tmp_path / "physical")


def test_a_rollout_that_left_the_numbers_equals_none(tmp_path: Path) -> None:
    field = np.random.default_rng(0).normal(size=(4, 3, 3))
    one = Rollout("one", {"velocity": field}, np.zeros(3), graph_milliseconds=np.zeros(3))
    assert rollout_difference(one, one) == {"velocity": 0.0}
    lost = replace(one, fields={"velocity": np.where(np.arange(4)[:, None, None] > 2, np.nan, field)})
    assert rollout_difference(one, lost) == {"velocity": float("inf")}
    with pytest.raises(DataError, match="no field in common"):
        rollout_difference(one, replace(one, fields={}))
    assert made_up(StepNetwork(unit_model(TignnOptions(**SMALL)).float()), (1, 1, 1), 0)["to"].dtype == torch.int64
