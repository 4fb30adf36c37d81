"""Settings of actors that learn over short horizons; importing them imports no JAX."""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticSettings:
    """How an actor and its critic learn.

    Attributes:
        worlds: Worlds of each actor.
        window: Control steps of an update.
        rate: Learning rate of the actor [-].
        critic_rate: Learning rate of the critic [-].
        clip: Largest norm of the adjoint of the state of a world.
        noise: Standard deviation of the noise of actions [-].
        critic: Widths of the critic's hidden layers.
        discount: Discount of a control step [-].
        trace: Lambda of the critic's TD(lambda) targets [-].
        epochs: Times that the critic sees a window.
        batches: Optimizer steps of the critic in each epoch.

    Raises:
        ValueError: A value is out of its range.
    """

    worlds: int = 16
    window: int = 8
    rate: float = 5e-3
    critic_rate: float = 2e-3
    clip: float = 100.0
    noise: float = 0.1
    critic: tuple[int, ...] = (64, 64)
    discount: float = 0.97
    trace: float = 0.95
    epochs: int = 2
    batches: int = 4

    def __post_init__(self) -> None:
        """Checks every value.

        Raises:
            ValueError: A value is out of its range.
        """
        object.__setattr__(self, "critic", tuple(self.critic))
        for name in ("worlds", "window", "epochs", "batches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {self._of(name)}")
        if self.batches > self.worlds * self.window:
            raise ValueError(
                f"batches must be at most worlds * window = "
                f"{self.worlds * self.window}, got {self.batches}"
            )
        for name in ("rate", "critic_rate", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and above 0, got {self._of(name)}"
                )
        if not 0 <= self.noise < math.inf:
            raise ValueError(f"noise must be at least 0, got {self.noise!r}")
        if not 0 <= self.discount < 1:
            raise ValueError(f"discount must be in [0, 1), got {self.discount!r}")
        if not 0 <= self.trace <= 1:
            raise ValueError(f"trace must be in [0, 1], got {self.trace!r}")

    def _of(self, name: str) -> str:
        return repr(getattr(self, name))
