"""Results of a step and of an episode of one world."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from newton_qd.types import Action, StateLike


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of an episode.

    Attributes:
        fitness: () sum of the rewards up to the first ``done``.
        descriptor: (D,) descriptor of the episode.
        faulty: () whether the world had a fault before the episode ended, or fitness or
            descriptor are not finite. They have no meaning then.
        transitions: Empty, or the fields of QDax's ``QDTransition`` by name,
            (T, ...) each.
    """

    fitness: jax.Array
    descriptor: jax.Array
    faulty: jax.Array
    transitions: dict[str, jax.Array] = dataclasses.field(default_factory=dict)

    @property
    def admitted_fitness(self) -> jax.Array:
        """() fitness, or ``-inf`` if ``faulty``, so that no archive takes it."""
        return jnp.where(self.faulty, -jnp.inf, self.fitness)


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


def at_fault(state: StateLike) -> jax.Array:
    """Returns whether the world of a state has a fault, ()."""
    if "fault" in state.info:
        return state.info["fault"] != 0
    return jnp.zeros((), bool)
