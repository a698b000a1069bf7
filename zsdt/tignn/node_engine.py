"""The trained node form as an `Engine`, and its artifact folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsdt.errors import DataError, RunRejected
from zsdt.files import atomic_path
from zsdt.tignn.bracket import Rates
from zsdt.tignn.engine import NodeField, register_engine
from zsdt.tignn.features import GraphBatch, NodeState, Scales, body_batch
from zsdt.tignn.model import NodeModel, Step, start_state
from zsdt.tignn.options import Bracket, Energy, Form, TignnOptions
from zsdt.trajectory import Body

KIND = "node"


@dataclass
class NodeRun:
    """State of a rollout: the network's state, the loads' work and the account so far (J, or learned units)."""

    state: NodeState
    account: dict[str, float]


class NodeEngine:
    """Predicts a body with a `NodeModel`, one step a frame."""

    def __init__(self, model: NodeModel, name: str = "local-tignn", dtype: torch.dtype = torch.float32):
        self.model = model.to(dtype).eval()
        self.name, self.dtype = name, dtype
        self.body: Body | None = None
        self._batch: GraphBatch | None = None

    def prepare(self, body: Body) -> None:
        """Builds the graph of the body."""
        self.body, self._batch = body, body_batch(body, self.dtype)

    @property
    def batch(self) -> GraphBatch:
        """Tensors of the prepared body."""
        if self._batch is None:
            raise DataError("The engine was not prepared for a body; call prepare(body) first.")
        return self._batch

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> NodeRun:
        """State at the first frame."""
        assert self.body is not None
        state = start_state(self.batch, self.body.points, fields, self.model.options)
        return NodeRun(state, self._energies(state, {}, None))

    def step(
        self, state: NodeRun, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> NodeRun:
        """State one frame later.

        Raises: RunRejected where a value is not finite, or a node is further than a body length from its place at rest.
        """
        loads = [torch.as_tensor(x, dtype=self.dtype) for x in (load, load_next)]
        with torch.inference_mode():
            step = self.model(self.batch, state.state, *loads)
            self._check(step.state)
            return NodeRun(step.state, self._energies(state.state, state.account, step))

    def _check(self, state: NodeState) -> None:
        assert self.body is not None
        furthest = float(torch.linalg.vector_norm(state.displacement, dim=1).max())
        if not np.isfinite(furthest + float(state.velocity.sum()) + float(state.stress.sum())):
            raise RunRejected("not_finite", "A value of the network's state is not a number any more.")
        length = float(np.linalg.norm(np.ptp(self.body.points, axis=0)))
        if furthest > length:
            raise RunRejected(
                "left_range",
                f"A node is {furthest:.3g} m from its place at rest, and the body only {length:.3g} m long.",
            )

    def read(self, state: NodeRun) -> dict[str, NodeField]:
        """Position m, velocity m/s, stress Pa, and energy densities J/m3 where the state has them."""
        assert self.body is not None
        now = state.state
        found = {
            "position": self.body.points + now.displacement.double().numpy(),
            "velocity": now.velocity.double().numpy(),
            "stress": now.stress.double().numpy(),
        }
        if now.thermal.shape[1]:
            thermal = now.thermal.double().numpy()
            found |= {"elastic_energy": thermal[:, :1], "dissipated_energy": thermal[:, 1:]}
        return found

    def account(self, state: NodeRun) -> dict[str, float]:
        """Physical energy: joules per kind and work of the ports. Learned, exact: change of the learned energy, work
        of the ports and entropy produced, in the network's own units. Empty for a plain decoder."""
        return dict(state.account)

    def _energies(self, before: NodeState, account: dict[str, float], step: Step | None) -> dict[str, float]:
        options = self.model.options
        if options.energy is Energy.physical:
            return self._physical_account(before, account, step)
        if options.bracket is Bracket.none:
            return {}
        names = ("learned_energy_change", "learned_port_work", "learned_entropy_produced")
        totals = {name: account.get(name, 0.0) for name in names}
        for rates in step.rates if step is not None else []:
            for name, value in zip(names, learned_budget(rates), strict=True):
                totals[name] += value
        return totals

    def _physical_account(self, before: NodeState, account: dict[str, float], step: Step | None) -> dict[str, float]:
        """Energies [J] of the new state; load and weight are ports and work at the mean velocity of the step."""
        now = before if step is None else step.state
        batch = self.batch
        found = {
            "kinetic": float((0.5 * batch.mass * now.velocity.square()).sum()),
            "elastic": float((batch.volume * now.thermal[:, :1]).sum()),
            "dissipated": float((batch.volume * now.thermal[:, 1:]).sum()),
            "work_of_ports": account.get("work_of_ports", 0.0),
        }
        if step is not None:
            increment = step.rates[0].port[:, :3] * (self.model.scales.d_velocity * step.magnitude)
            mean = 0.5 * (before.velocity + now.velocity)
            found["work_of_ports"] += float((batch.mass * increment * mean).sum())
        return found


def learned_budget(rates: Rates) -> tuple[float, float, float]:
    """Change of the learned energy, work of the ports, and entropy produced in one step (scaled units)."""
    if rates.energy is None or rates.entropy is None:
        return 0.0, 0.0, 0.0
    change = float((rates.energy * rates.total).sum())
    work = float((rates.energy * rates.port).sum())
    produced = float((rates.entropy * (rates.reversible + rates.irreversible)).sum())
    return change, work, produced


def probe(model: NodeModel, batch: GraphBatch, state: NodeState, load: torch.Tensor, load_next: torch.Tensor) -> dict:
    """How well the bracket keeps its promises on one state, relative to the size of the terms.

    Returns `energy_residual` |e.(z' - port)| / sum |e||z'|, `entropy_production` s.z' / sum |s||z'| (must be >= 0),
    `entropy_leak` |s.(L dE)| / sum |s||L dE| (max |L dS| seen from outside), `energy_leak` |e.(M dS)| / sum
    |e||M dS|, and for soft the largest bulk |L dS| and |M dE| relative to the largest term. Run it in float64.
    """
    with torch.inference_mode():
        found: dict[str, float] = {}
        for rates in model(batch, state, load, load_next).rates:
            for name, value in probe_rates(rates).items():
                worse = min if name == "entropy_production" else max
                found[name] = worse(found.get(name, value), value)
    return found


def probe_rates(rates: Rates) -> dict[str, float]:
    """Of the brackets of one step: see `probe`; empty where nothing was decoded."""
    if rates.energy is None or rates.entropy is None:
        return {}
    e, s, tiny = rates.energy, rates.entropy, 1e-300
    internal = rates.reversible + rates.irreversible

    def share(gradient: torch.Tensor, term: torch.Tensor) -> tuple[float, float]:
        product = gradient * term
        return float(product.sum()), float(product.abs().sum()) + tiny

    change, size = share(e, internal)
    produced, heat = share(s, internal)
    leak, leaking = share(s, rates.reversible)
    drain, draining = share(e, rates.irreversible)
    found = {
        "energy_residual": abs(change) / size,
        "entropy_production": produced / heat,
        "entropy_leak": abs(leak) / leaking,
        "energy_leak": abs(drain) / draining,
    }
    if rates.ldS is not None and rates.mdE is not None:
        found["bulk_ldS"] = float(rates.ldS.abs().max() / rates.reversible.abs().max().clamp_min(tiny))
        found["bulk_mdE"] = float(rates.mdE.abs().max() / rates.irreversible.abs().max().clamp_min(tiny))
    return found


def plain(value: Any) -> Any:
    """Options as plain JSON: enums by their value, dataclasses as dicts."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


def options_from(card: dict[str, Any]) -> TignnOptions:
    """Options from the plain dict of an artifact; options of other forms and unknown keys are left aside."""
    return _filled(TignnOptions(), card)


def _filled(default: Any, card: dict[str, Any]) -> Any:
    """`default` (a dataclass) with the values of a plain dict."""
    picked: dict[str, Any] = {}
    for f in fields(default):
        if f.name in card:
            now, value = getattr(default, f.name), card[f.name]
            if is_dataclass(now):
                picked[f.name] = _filled(now, value)
            else:
                picked[f.name] = type(now)(value) if isinstance(now, Enum) else value
    return replace(default, **picked)


def card_of(options: TignnOptions, *nested: str) -> dict[str, Any]:
    """Options as plain JSON, with those of the named forms (`liquid`, ...) and without those of all others."""
    names = [f.name for f in fields(options) if f.name in nested or not is_dataclass(getattr(options, f.name))]
    card = asdict(options)
    return plain({name: card[name] for name in names})


def save_engine(model: NodeModel, folder: str | Path) -> None:
    """Writes `engine.json` and `weights.pt` of a model."""
    folder = Path(folder)
    card = {"kind": KIND, "options": card_of(model.options), "scales": asdict(model.scales)}
    with atomic_path(folder / "weights.pt") as beside:
        torch.save(model.state_dict(), beside)
    with atomic_path(folder / "engine.json") as beside:
        beside.write_text(json.dumps(card, indent=1))


def load_model(folder: str | Path) -> NodeModel:
    """The model of an artifact folder. Raises: DataError where files are missing or do not fit together."""
    folder = Path(folder)
    try:
        card = json.loads((folder / "engine.json").read_text())
        model = NodeModel(options_from(card["options"]), Scales(**card["scales"]))
        model.load_state_dict(torch.load(folder / "weights.pt", weights_only=True))
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        raise DataError(f"The trained engine in {folder} cannot be read ({error}); train it again.") from error
    return model


def _load(folder: Path) -> NodeEngine:
    model = load_model(folder)
    black_box = model.options.bracket is Bracket.none
    return NodeEngine(model, name="black box" if black_box else f"local-tignn ({model.options.bracket.value})")


assert Form.node.value == KIND
register_engine(KIND, _load)
