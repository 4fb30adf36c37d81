"""Settings of actors that learn over short windows; this module imports no JAX."""

from __future__ import annotations

import dataclasses

from newton_qd import checks
from newton_qd.checks import message


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticSettings:
    """Settings of the learning of an actor and its critic.

    Attributes:
        worlds: Worlds of each actor.
        window: Control steps of an update.
        rate: Learning rate of the actor [-].
        critic_rate: Learning rate of the critic [-].
        clip: Largest norm of the adjoint of the state of a world.
        noise: Standard deviation of the noise of actions [-].
        weight_noise: Standard deviation of the noise of weights, in units of the
            genotype; each world has weights of its own for a window.
        critic: Widths of the critic's hidden layers.
        discount: Discount of a control step [-].
        trace: Lambda of the critic's TD(lambda) targets [-].
        actor_trace: Lambda of the return that the actor maximizes [-]; 1: only the last
            state of a window has a value.
        beyond_length: Whether the last state of an episode of full length has a value,
            as if the episode went on; if not, this end is worth as little as a fall.
        epochs: Number of times that the critic learns from a window.
        batches: Optimizer steps of the critic in each epoch.
        whiten: Whether an actor learns weights for whitened observations.
        termination_width: Width of the gradient of ``done`` at the limits of a healthy
            robot [m or rad]; with 0, an actor does not see that a fall is near.

    Raises:
        TypeError: A value has a wrong type.
        ValueError: A value is out of its range.
    """

    worlds: int = 16
    window: int = 8
    rate: float = 5e-3
    critic_rate: float = 2e-3
    clip: float = 100.0
    noise: float = 0.1
    weight_noise: float = 0.0
    critic: tuple[int, ...] = (64, 64)
    discount: float = 0.97
    trace: float = 0.95
    actor_trace: float = 1.0
    beyond_length: bool = False
    epochs: int = 2
    batches: int = 4
    whiten: bool = True
    termination_width: float = 0.0

    def __post_init__(self) -> None:
        """Checks every value.

        Raises:
            TypeError: A value has a wrong type.
            ValueError: A value is out of its range.
        """
        checks.flag("whiten", self.whiten)
        checks.flag("beyond_length", self.beyond_length)
        allowed = "a tuple of integers"
        checks.instance("critic", self.critic, (tuple, list), allowed)
        for index, width in enumerate(self.critic):
            checks.integer(f"critic[{index}]", width)
        object.__setattr__(self, "critic", tuple(self.critic))
        for name in ("worlds", "window", "epochs", "batches"):
            checks.integer(name, getattr(self, name), most=None)
        steps = self.worlds * self.window
        if self.batches > steps:
            allowed = f"at most worlds * window = {steps}"
            raise ValueError(message("batches", self.batches, allowed))
        for name in ("rate", "critic_rate", "clip"):
            checks.number(name, getattr(self, name), above=0)
        for name in ("noise", "weight_noise", "termination_width"):
            checks.number(name, getattr(self, name), least=0)
        checks.number("discount", self.discount, least=0, below=1)
        checks.number("trace", self.trace, least=0, most=1)
        checks.number("actor_trace", self.actor_trace, least=0, most=1)
