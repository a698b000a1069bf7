"""The switch for how networks are computed: every backend gives the eager numbers, and nothing else changes."""

import copy
import importlib.util
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.tignn.conftest import make_body, make_trajectory, unit_model
from tests.tignn.liquid_bodies import make_flow, make_liquid
from tests.tignn.particle_bodies import engine_for, equal_liquid, stirred
from zsdt.errors import OptionError
from zsdt.evaluation.degeneracy import degeneracy
from zsdt.interop.inference import InferenceBackend, TorchNetwork, _network, backends, with_backend
from zsdt.interop.onnx_files import write_onnx
from zsdt.interop.onnx_networks import step_tensors
from zsdt.tignn.engine import roll_out
from zsdt.tignn.inference import InferenceOptions
from zsdt.tignn.liquid_engine import LiquidEngine
from zsdt.tignn.liquid_features import LiquidScales
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.node_engine import NodeEngine
from zsdt.tignn.options import Bracket, Energy, TignnOptions
from zsdt.tignn.particle_pairs import LANES, refresh_list

SLOW_SWITCH = "set ZSDT_SLOW_TESTS=1"
SLOW = bool(os.environ.get("ZSDT_SLOW_TESTS"))
SMALL = {"width": 16, "passes": 3, "local_passes": 2}
FORMS = [
    {"bracket": Bracket.exact},
    {"bracket": Bracket.soft, "global_context": False},
    {"bracket": Bracket.none, "hidden_layers": 3, "history": 2},
    {"bracket": Bracket.exact, "shared_weights": True, "symmetric": True},
    {"bracket": Bracket.exact, "energy": Energy.physical, "staggered": False},
]


def solid(dtype=torch.float64, **changes):
    model = unit_model(TignnOptions(**SMALL, **changes))
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(0.6)
    return NodeEngine(model, dtype=dtype)


def liquid(dtype=torch.float64, **changes):
    torch.manual_seed(3)
    scales = LiquidScales(0.1, 1e-2, 1e-2, 1e-3, 0.004, 1e-3)
    model = LiquidModel(TignnOptions(**SMALL, **changes), scales)
    with torch.no_grad():
        for p in model.parameters():
            p.mul_(0.3)
    return LiquidEngine(model, dtype=dtype)


def apart(one, other, trajectory, frames=4):
    """Largest difference of two rollouts over the largest value of a field (positions: displacement)."""
    a, b = roll_out(one, trajectory, frames).fields, roll_out(other, trajectory, frames).fields
    size = {name: np.abs(a[name] - a[name][0] if name == "position" else a[name]).max() for name in a}
    return max(np.abs(a[name] - b[name]).max() / size[name] for name in a)


@pytest.mark.parametrize("changes", FORMS)
def test_the_kernel_gives_the_eager_numbers_of_a_solid(changes):
    trajectory = make_trajectory(make_body())
    engine = solid(**changes)
    fast = with_backend(engine, InferenceBackend.kernel)
    assert apart(engine, fast, trajectory) < 1e-11
    single = solid(torch.float32, **changes)
    assert apart(single, with_backend(single, "kernel"), trajectory) < 1e-5
    state = fast.start(trajectory.at(0), trajectory.load[0])
    account = fast.account(fast.step(state, trajectory.load[0], trajectory.load[1]))
    state = engine.start(trajectory.at(0), trajectory.load[0])
    for name, value in engine.account(engine.step(state, trajectory.load[0], trajectory.load[1])).items():
        assert account[name] == pytest.approx(value, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    "changes",
    [{"bracket": Bracket.exact}, {"bracket": Bracket.soft}, {"bracket": Bracket.none, "global_context": False},
     {"bracket": Bracket.exact, "energy": Energy.physical}],
)  # fmt: skip
def test_the_kernel_gives_the_eager_numbers_of_a_liquid_whose_graph_changes(changes):
    flow = make_flow(make_liquid(), frames=5)
    fast = with_backend(liquid(**changes), "kernel")
    assert apart(liquid(**changes), fast, flow) < 1e-9
    larger = make_flow(make_liquid(radius=0.03), frames=5)  # buffers must grow
    assert apart(liquid(**changes), fast, larger) < 1e-9
    assert apart(liquid(**changes), fast, flow) < 1e-9


def test_the_kernel_allocates_nothing_after_its_first_step():
    trajectory = make_trajectory(make_body())
    fast = with_backend(solid(), "kernel")
    fast.prepare(trajectory.body)
    state, loads = fast.start(trajectory.at(0), trajectory.load[0]), trajectory.load[:2]

    def places():
        rooms = [fast.model.first.processor._room, fast.model.first.bracket.edges._room]
        rooms += fast.model.look._rooms.values()
        return [t.data_ptr() for room in rooms for t in room._kept.values()]

    state = fast.step(state, *loads)
    before = places()
    for _ in range(3):
        state = fast.step(state, *loads)
    assert len(before) > 6 and places() == before


@pytest.mark.parametrize("make, flow", [(solid, False), (liquid, True)])
def test_an_accelerated_network_follows_to_another_precision_and_goes_back_to_eager(make, flow):
    trajectory = make_flow(make_liquid(), frames=4) if flow else make_trajectory(make_body())
    fast = with_backend(make(torch.float32), "kernel")
    double = type(fast)(copy.deepcopy(fast.model), dtype=torch.float64)
    wanted = type(fast)(copy.deepcopy(make(torch.float32).model), dtype=torch.float64)
    assert apart(wanted, double, trajectory) < 1e-9
    audited, plain = degeneracy(fast, trajectory), degeneracy(make(torch.float32), trajectory)
    assert audited["probe_energy_residual"] < 1e-9 and audited.keys() == plain.keys()
    assert apart(make(torch.float32), with_backend(fast, "eager"), trajectory) == 0.0
    assert apart(make(torch.float32), with_backend(with_backend(fast, "kernel"), "kernel"), trajectory) < 1e-5


def test_two_steps_from_one_state_do_not_disturb_each_other():
    trajectory = make_trajectory(make_body())
    fast = with_backend(solid(), "kernel")
    fast.prepare(trajectory.body)
    state = fast.start(trajectory.at(0), trajectory.load[0])
    one = fast.step(state, trajectory.load[0], trajectory.load[1])
    kept = {name: value.copy() for name, value in fast.read(one).items()}
    fast.step(one, 5 * trajectory.load[1], -3 * trajectory.load[2])
    for name, value in fast.read(one).items():
        assert np.array_equal(value, kept[name])


def test_other_runtimes_give_the_eager_numbers(monkeypatch, tmp_path):
    missing = [p for p in ("onnx", "onnxscript", "onnxruntime", "openvino") if importlib.util.find_spec(p) is None]
    if missing or not SLOW:
        pytest.skip(f"{', '.join(missing)} not installed" if missing else f"tracing takes ten seconds: {SLOW_SWITCH}")
    written = tmp_path / "network.onnx"

    def write_once(path, network, card):
        if not written.exists():  # tracing takes ten seconds, and the file is the same for both
            write_onnx(written, network, card)
        shutil.copy(written, path)

    monkeypatch.setattr("zsdt.interop.inference.write_onnx", write_once)
    trajectory, engine = make_trajectory(make_body()), solid(torch.float32)
    for name in ("onnx", "openvino"):
        assert name in backends(engine)
        assert apart(solid(torch.float32), with_backend(engine, name), trajectory, 3) < 1e-5


def test_torch_compile_gives_the_eager_numbers():
    if "compiled" not in backends(solid(torch.float32)) or not SLOW:
        pytest.skip(f"needs a C++ compiler and most of a minute: {SLOW_SWITCH}")
    # In a process of its own: the checks of shapes that run in tests are no code that can be compiled.
    script = (
        "from tests.interop.test_inference import *\n"
        "trajectory, engine = make_trajectory(make_body()), solid(torch.float32)\n"
        "print(apart(engine, with_backend(engine, 'compiled'), trajectory, 3))"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=root)
    assert float(done.stdout.split()[-1]) < 1e-5


def test_the_network_can_live_on_another_device():
    trajectory = make_trajectory(make_body())
    engine = solid(torch.float32)
    engine.prepare(trajectory.body)
    state = engine.start(trajectory.at(0), trajectory.load[0]).state
    loads = [torch.as_tensor(x, dtype=torch.float32) for x in trajectory.load[:2]]
    for device in ("cpu", "meta"):  # tensors of `meta` have no numbers, but refuse to meet those of another device
        file = TorchNetwork(_network(engine), device=device)
        found = file.run(step_tensors(file.inputs, engine.batch, state, *loads))
        assert {value.device.type for value in found.values()} == {device}
        assert found["stress_next"].shape == (trajectory.body.nodes, 6)
        if device == "cpu":
            wanted = engine.model(engine.batch, state, *loads).state.velocity
            assert torch.allclose(found["velocity_next"], wanted, rtol=1e-5, atol=1e-7)


def test_a_gpu_gives_the_eager_numbers():
    if not torch.cuda.is_available():
        pytest.skip("torch finds no GPU here")
    options = InferenceOptions(InferenceBackend.eager, device="cuda")
    for make, trajectory in ((solid, make_trajectory(make_body())), (liquid, make_flow(make_liquid(), frames=4))):
        assert apart(make(torch.float32), with_backend(make(torch.float32), options), trajectory, 3) < 1e-4


def particle_pair():
    body = equal_liquid()
    single = with_backend(engine_for(body), "kernel")
    single.prepare(body)
    return body, engine_for(body), single


def test_single_precision_moves_particles_as_double_does_and_closes_the_account():
    body, double, single = particle_pair()
    load = body.mass[:, None] * np.array([1.5, -0.5, 0.2])
    states = [engine.start(stirred(body), load) for engine in (double, single)]
    first = single.account(states[1])
    for _ in range(5):
        states = [e.step(s, load, load) for e, s in zip((double, single), states, strict=True)]
        for name in ("position", "velocity", "strain", "heat"):
            wanted, found = (getattr(s, name) for s in states)
            assert np.abs(found - wanted).max() < 1e-5 * np.abs(wanted).max()
    last = single.account(states[1])
    closes = [
        a["kinetic"] + a["potential"] + a["internal"] - a["work_of_ports"] - a["integrator"] for a in (first, last)
    ]
    assert last["heat"] > 0.1 * first["kinetic"]
    assert closes[1] == pytest.approx(closes[0], abs=1e-10 * last["heat"])


def test_single_precision_twice_is_the_same_to_the_last_bit():
    body, _, single = particle_pair()
    still, ends = np.zeros_like(body.points), []
    for _ in range(2):
        state = single.start(stirred(body), still)
        for _ in range(3):
            state = single.step(state, still, still)
        ends.append(state)
    assert np.array_equal(ends[0].velocity, ends[1].velocity) and np.array_equal(ends[0].heat, ends[1].heat)


def test_rows_of_the_neighbour_list_are_filled_with_the_particle_itself():
    body = equal_liquid()
    engine = engine_for(body)
    w = engine.scratch
    assert refresh_list(engine.constants, body.points.copy(), w) == 1
    for i in range(body.nodes):
        row, bare = w.neighbour[w.offset[i] : w.offset[i + 1]], w.sorted[w.bare[i] : w.bare[i + 1]]
        assert len(row) % LANES == 0 and len(row) - len(bare) < LANES
        assert np.array_equal(row[: len(bare)], bare) and (row[len(bare) :] == i).all()


def test_what_does_not_suit_is_refused_in_words():
    body = equal_liquid()
    particle = engine_for(body)
    assert backends(particle) == ["eager", "kernel"]
    assert with_backend(particle, "kernel").single and not particle.single
    for wrong, word in (("onnx", "kernel"), ("faster", "known are")):
        with pytest.raises(OptionError, match=word):
            with_backend(particle, wrong)
    with pytest.raises(OptionError, match="double"):
        with_backend(solid(), "onnx")
    for backend, device in ((InferenceBackend.kernel, "cuda"), (InferenceBackend.eager, "cuda")):
        if device == "cuda" and torch.cuda.is_available() and backend is InferenceBackend.eager:
            continue
        with pytest.raises(OptionError, match="cpu"):
            with_backend(solid(torch.float32), InferenceOptions(backend, device))
    with pytest.raises(OptionError, match="compiled loop"):
        with_backend(particle, InferenceOptions(InferenceBackend.eager, "cuda"))
    assert replace(InferenceOptions(), device="cpu").backend is InferenceBackend.kernel
