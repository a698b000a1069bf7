"""The node form of a liquid as the engine of a twin: steps of the network's own length, frames of the camera's.

A network of this form knows one time step, that of its training data (4 ms); a picture comes every 16.7 ms. A frame is
as many whole steps as fit into it and a part of one more. The part is a step cut short: the network's increments of
velocity and energy grow linearly over its step, and positions follow by the same trapezoid as in a whole one
(`q+ = q + dt (v + v+)/2`, DESIGN 4.2). So velocities are off by no more than `s (1 - s)/2 dt^2 |v''|` a frame (s: the
part of a step), second order in the step, and motions of constant velocity or acceleration not at all.

The other way, steps on a clock of their own with the remainder carried into the next frame, needs 4 instead of 5 steps
in most frames, but then a step reaches beyond the frame: into a push of the vessel that nobody has seen yet, and past
the time for which a picture corrects it. Here a frame ends with a state of its own time, which what is seen may move.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError, RunRejected
from zsdt.tignn.engine import NodeField
from zsdt.tignn.liquid_engine import LiquidEngine, LiquidRun
from zsdt.tignn.liquid_features import LiquidState
from zsdt.trajectory import Body

WHOLE = 1e-6  # of a step: a smaller part is rounding


@dataclass(frozen=True)
class NodeLiquid:
    """State at a frame: position [n, 3] m, velocity [n, 3] m/s, energy [n, 1] J/kg, and the account so far."""

    position: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]
    energy: Float[np.ndarray, "n 1"]
    account: dict[str, float]


class LiquidNodeEngine:
    """See the module; `Engine` for the methods, `zsdt.twin.liquid_ports.LiquidPorts` for those of a twin.

    The radius graph is renewed in every step, as in a rollout. What the network drove out of its range (faster than
    sound, further than the vessel is long, no number) is refused, not begun again: it would go there again.
    """

    begins_again = False

    def __init__(self, steps: LiquidEngine):
        self.steps, self.name = steps, steps.name

    def prepare(self, body: Body) -> None:
        """Walls and graph for steps of the network's own length. Raises: DataError where the body is no liquid."""
        self.body, step = body, self.steps.model.scales.frame_dt
        self.steps = copy.copy(self.steps)  # whoever shares the network has a body of his own
        self.steps.prepare(replace(body, frame_dt=step))
        count = body.frame_dt / step
        self.whole = math.floor(count + WHOLE)
        self.part = max(count - self.whole, 0.0) if count - self.whole > WHOLE else 0.0

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> NodeLiquid:
        """State at the first frame from position, velocity and, where it is known, internal_energy."""
        nothing = np.zeros((len(fields["position"]), 1))
        return self._state(self.steps.start({"internal_energy": nothing, **fields}, load))

    def step(
        self, state: NodeLiquid, load: Float[np.ndarray, "nodes 3"], load_next: Float[np.ndarray, "nodes 3"]
    ) -> NodeLiquid:
        """State one frame later; the load [N] runs linearly from `load` to `load_next`.

        Raises: RunRejected where the network's liquid flies apart.
        """
        run = LiquidRun(LiquidState(state.position, state.velocity, state.energy), state.account)
        ends = np.minimum(np.arange(self.whole + 2) / (self.whole + self.part), 1.0)  # of the steps, in frames
        loads = [load + end * (load_next - load) for end in ends]
        try:
            for k in range(self.whole):
                run = self.steps.step(run, loads[k], loads[k + 1])
            if self.part:
                run = self._cut_short(run, self.steps.step(run, loads[-2], loads[-1]))
        except RunRejected as error:
            raise RunRejected(
                error.cause,
                f"{error} The network '{self.name}' does not carry this liquid: train it longer, or take "
                "tignn.form=particle.",
            ) from error
        return self._state(run)

    def _cut_short(self, before: LiquidRun, after: LiquidRun) -> LiquidRun:
        """The part of a step: increments grow linearly, positions with the mean velocity until then."""
        a, b, s = before.state, after.state, self.part
        dt = self.steps.body.frame_dt
        velocity = a.velocity + s * (b.velocity - a.velocity)
        position = a.position + s * (b.position - a.position) - 0.5 * s * (1 - s) * dt * (b.velocity - a.velocity)
        position = self.steps.body.keep_inside(position, velocity)[0]
        state = LiquidState(position, velocity, a.energy + s * (b.energy - a.energy))
        sums = {name: value + s * (after.account[name] - value) for name, value in before.account.items()}
        return LiquidRun(state, sums | self.steps.energies(state))

    def read(self, state: NodeLiquid) -> dict[str, NodeField]:
        """Position m, velocity m/s, internal energy J/kg."""
        return {"position": state.position, "velocity": state.velocity, "internal_energy": state.energy}

    def account(self, state: NodeLiquid) -> dict[str, float]:
        """See `LiquidEngine.account`."""
        return dict(state.account)

    def _state(self, run: LiquidRun) -> NodeLiquid:
        return NodeLiquid(run.state.position, run.state.velocity, run.state.energy, run.account)

    # ---- ports ------------------------------------------------------------------------------------------------

    def displace(
        self, state: NodeLiquid, move: Float[np.ndarray, "n 3"], push: Float[np.ndarray, "n 3"]
    ) -> tuple[NodeLiquid, float]:
        """The state with positions changed by `move` [m] and velocities by `push` [m/s], nobody nearer to a wall than
        in a rollout; and the work [J] of it: the change of kinetic and potential energy."""
        if not (move.any() or push.any()):
            return state, 0.0
        position = self.steps.body.keep_inside(state.position + move, state.velocity)[0]
        new = self._anew(state, position, state.velocity + push, state.energy)
        return new, sum(new.account[name] - state.account[name] for name in ("kinetic", "potential"))

    def thicken(self, viscosity: float) -> None:
        """The liquid has this dynamic viscosity [Pa s] from now on; the network sees it in every particle."""
        body = self.steps.body
        body.liquid = replace(body.liquid, viscosity=viscosity)

    def pressure(self, state: NodeLiquid) -> None:
        """None: this form has velocity and internal energy alone."""

    def come_to_rest(self, state: NodeLiquid) -> NodeLiquid:
        """The state without velocity, its kinetic energy turned into heat, particle by particle."""
        heat = 0.5 * np.square(state.velocity).sum(axis=1, keepdims=True)
        return self._anew(state, state.position, np.zeros_like(state.velocity), state.energy + heat)

    def _anew(self, state: NodeLiquid, position: np.ndarray, velocity: np.ndarray, energy: np.ndarray) -> NodeLiquid:
        account = state.account | self.steps.energies(LiquidState(position, velocity, energy))
        return NodeLiquid(position, velocity, energy, account)


def twin_engine_of(engine: object, folder: object) -> LiquidNodeEngine:
    """The engine of a twin from one that was trained in the node form.

    folder: named in the error. Raises: DataError where it is of another form.
    """
    if not isinstance(engine, LiquidEngine):
        raise DataError(
            f"The engine in {folder} is of the form '{getattr(engine, 'name', engine)}', which no twin of a glass runs "
            "with; train one with tignn.form=particle, or with tignn.form=node on liquids."
        )
    found = LiquidNodeEngine(engine)
    if hasattr(engine, "folder"):
        vars(found)["folder"] = engine.folder  # its limits of trust lie there
    return found
