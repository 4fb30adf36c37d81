"""Results of a step and of an episode of one world."""

from __future__ import annotations

import dataclasses

import jax

from newton_qd.envs.state import at_fault
from newton_qd.types import Action, StateLike

__all__ = ["Outcome", "at_fault", "transition"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of an episode.

    Attributes:
        fitness: () sum of the rewards up to the first ``done``; ``-inf`` if ``faulty``,
            so that no fault pays and no archive takes it. Leave faulty worlds out of a
            mean.
        descriptor: (D,) descriptor of the episode. It has no meaning if ``faulty``.
        faulty: () whether the world had a fault before the episode ended, or the sum of
            the rewards or the descriptor is not finite.
        transitions: Empty, or the fields of QDax's ``QDTransition`` by name,
            (T, ...) each.
        reward_sum: () sum of the rewards as they came. It tells why a world is faulty,
            and is no fitness.
    """

    fitness: jax.Array
    descriptor: jax.Array
    faulty: jax.Array
    transitions: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    reward_sum: jax.Array | None = None

    @property
    def admitted_fitness(self) -> jax.Array:
        """() the fitness, by the name that it had when ``fitness`` was finite."""
        return self.fitness


def transition(
    begin: StateLike, action: Action, end: StateLike
) -> dict[str, jax.Array]:
    """Returns the fields of QDax's ``QDTransition`` for one step.

    Args:
        begin: State before the step.
        action: (nu,) the action.
        end: State after the step.
    """
    return {
        "obs": begin.obs,
        "next_obs": end.obs,
        "rewards": end.reward,
        "dones": end.done,
        "truncations": end.info["truncation"],
        "actions": action,
        "state_desc": begin.info["state_descriptor"],
        "next_state_desc": end.info["state_descriptor"],
    }
