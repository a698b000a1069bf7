"""What the twin of a glass asks of an engine beside prediction: ports for what is seen, whatever form the network has.

The corrections (sloshing modes, columns) speak of positions and velocities alone. How an engine takes them, what its
pressure is, and how its liquid becomes thicker differ from form to form.
"""

from __future__ import annotations

import math
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from numpy import ndarray

from zsdt.errors import OptionError
from zsdt.tignn.engine import Engine, NodeField
from zsdt.tignn.particle_engine import ParticleEngine, ParticleState
from zsdt.tignn.particle_port import displace
from zsdt.tignn.sleep import come_to_rest


@runtime_checkable
class LiquidPorts(Protocol):
    """begins_again: whether a liquid that the engine refused may be tried again from rest."""

    begins_again: bool

    def displace(self, state: Any, move: Float[ndarray, "n 3"], push: Float[ndarray, "n 3"]) -> tuple[Any, float]:
        """The state with positions changed by `move` [m] and velocities by `push` [m/s], nobody through a wall; and the
        work [J] of it."""

    def thicken(self, viscosity: float) -> None:
        """The liquid has this dynamic viscosity [Pa s] from now on."""

    def pressure(self, state: Any) -> NodeField | None:
        """Pressure [Pa] of the particles, [n, 1]; None where the network knows none."""

    def come_to_rest(self, state: Any) -> Any:
        """The state without velocity, its kinetic energy turned into heat."""


class ParticlePorts:
    """Of the sub-step form, whose sub-step shrinks where a thicker liquid asks for it."""

    begins_again = True

    def __init__(self, engine: ParticleEngine):
        self.engine = engine

    def displace(
        self, state: ParticleState, move: Float[ndarray, "n 3"], push: Float[ndarray, "n 3"]
    ) -> tuple[ParticleState, float]:
        """See `zsdt.tignn.particle_port.displace`."""
        return displace(self.engine, state, move, push)

    def thicken(self, viscosity: float) -> None:
        """See `LiquidPorts`."""
        engine = self.engine
        engine.constants = engine.constants._replace(viscosity=viscosity)
        frame_dt = engine.body.frame_dt
        steps = max(engine.steps, math.ceil(frame_dt / engine.critical_step() - 1e-9))
        engine.steps, engine.dt = steps, frame_dt / steps

    def pressure(self, state: ParticleState) -> NodeField:
        """See `LiquidPorts`."""
        return self.engine.constants.stiffness * state.strain[:, None]

    def come_to_rest(self, state: ParticleState) -> ParticleState:
        """See `zsdt.tignn.sleep.come_to_rest`."""
        return come_to_rest(self.engine, state)


def ports_of(engine: Engine) -> LiquidPorts:
    """The ports of an engine. Raises: OptionError where it has none."""
    if isinstance(engine, ParticleEngine):
        return ParticlePorts(engine)
    if isinstance(engine, LiquidPorts):  # asked by its methods: the node form stays unimported where it does not run
        return engine
    raise OptionError(
        f"The engine '{engine.name}' cannot be corrected by what is seen of a glass; take the sub-step form."
    )
