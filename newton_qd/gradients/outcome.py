"""Results of a step and of an episode of one world."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from newton_qd.checks import Fact, message
from newton_qd.extractors import Trajectories
from newton_qd.types import Action, DescriptorExtractor, StateLike


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Tally:
    r"""The fitness of an episode so far.

    The fitness is

    .. math:: \sum_t r_t \prod_{s<t} (1 - d_s),

    summed up to the first ``done``. Where ``done`` has a gradient, the fitness has it
    too: the nearer a step is to an end, the less count the rewards after it. Rewards
    after the end count as 0, so the step that ends the episode adds no slope.

    Attributes:
        fitness: () sum of the rewards so far; (N,) if each step has N of them.
        going: () 1 before the first ``done``, else 0.
    """

    fitness: jax.Array
    going: jax.Array

    @staticmethod
    def zero(dtype: jnp.dtype) -> Tally:
        """Returns the tally before the first step."""
        return Tally(jnp.zeros((), dtype), jnp.ones((), dtype))

    @property
    def over(self) -> jax.Array:
        """() whether the episode has ended."""
        return self.going == 0

    def add(self, reward: jax.Array, done: jax.Array) -> Tally:
        """Returns the tally after one more step.

        The sum is in time order. A reduction over time would depend on the batch size.

        Args:
            reward: () reward of the step, or (N,) several of them.
            done: () above 0 if the step ends the episode, else 0.
        """
        over, dtype = self.over, self.going.dtype
        # after the end, reward and done may be NaN
        slope = jnp.where(over, 0, done).astype(dtype)
        # 0 or 1, with the gradient of done
        ends = (slope > 0).astype(dtype) + (slope - jax.lax.stop_gradient(slope))
        return Tally(self.fitness + self.gained(reward), self.going * (1 - ends))

    def gained(self, reward: jax.Array) -> jax.Array:
        """Returns what the fitness gains by the reward of one more step; 0 at the end.

        Args:
            reward: () reward of the step, or (N,) several of them.
        """
        return self.going * jnp.where(self.over, 0, reward)


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
        # only ``EpisodeWrapper`` knows when an episode ends because of its length
        "truncations": end.info.get("truncation", jnp.zeros_like(end.done)),
        "actions": action,
        "state_desc": begin.info["state_descriptor"],
        "next_state_desc": end.info["state_descriptor"],
    }


def finished(
    extractor: DescriptorExtractor | None,
    fitness: jax.Array,
    readings: jax.Array | None,
    over: jax.Array,
    bad: jax.Array,
    taken: dict[str, jax.Array],
) -> Outcome:
    """Returns the results of an episode of one world.

    Args:
        extractor: Descriptor extractor; ``None``: the descriptor is empty.
        fitness: () sum of the rewards.
        readings: (T, nd) state descriptors before each step; ``None``: there are none.
        over: (T,) whether the episode had ended before a step.
        bad: () whether there was a fault.
        taken: The steps.

    Raises:
        ValueError: The descriptors have the wrong shape.
    """
    descriptor = jnp.zeros((0,), fitness.dtype)
    if extractor is not None:
        assert readings is not None
        data, mask = Trajectories(readings[None]), over[None].astype(readings.dtype)
        descriptors = extractor(data, mask)
        if jnp.ndim(descriptors) != 2 or len(descriptors) != 1:
            given = Fact(f"descriptors of shape {jnp.shape(descriptors)}")
            allowed = "(n, nd), here (1, nd)"
            raise ValueError(message("descriptor_extractor", given, allowed))
        descriptor = descriptors[0]
    bad = bad | ~jnp.isfinite(fitness) | ~jnp.all(jnp.isfinite(descriptor))
    return Outcome(jnp.where(bad, -jnp.inf, fitness), descriptor, bad, taken, fitness)
