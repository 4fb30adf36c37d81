"""An environment whose episodes aim at a descriptor, and an actor that is told it.

The descriptor-conditioned actor follows DCRL-ME (Faldor et al. 2024, "Synergizing
Quality-Diversity with descriptor-conditioned reinforcement learning"). The reward
follows QDAC (Grillotti et al. 2024, "Quality-Diversity actor-critic"): a Lagrangian
between the return and the distance to a target descriptor.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.scoring.rollout import Policy
from newton_qd.qd.scoring.task import Task
from newton_qd.types import Action, PyTree, RNGKey, StateLike

_FALL = 30.0  # steps away from the target that a fall costs
_SMALL = 1e-3  # the distance to a target is smooth below this


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AimedState:
    """A world that aims at a descriptor.

    Attributes:
        state: State of the world.
        target: (D,) the descriptor, from -1 to 1 inside the limits of the task.
        error: (D,) what the episode is away from the target, in the same units.
        weights: (2,) weights of the reward, and of the distance to the target [-].
        reward: () weighted sum of the reward and of what came nearer to the target.
    """

    state: PyTree
    target: jax.Array
    error: jax.Array
    weights: jax.Array
    reward: jax.Array

    @property
    def obs(self) -> jax.Array:
        """(no + 2 D + 1,) observation, target, error and weight of the distance."""
        parts = (self.state.obs, self.target, self.error, self.weights[..., 1:])
        return jnp.concatenate(parts, axis=-1)

    @property
    def done(self) -> jax.Array:
        """() 1 if the episode has ended, else 0."""
        return self.state.done

    @property
    def info(self) -> dict[str, jax.Array]:
        """Data of the wrappers."""
        return self.state.info


@dataclasses.dataclass(frozen=True, eq=False)
class AimedEnv:
    r"""Rewards return and nearness to a target descriptor.

    The error of an episode after t of T steps is

    .. math:: e_t = \frac{1}{T} \sum_{i<t} m_i - \frac{t}{T} d \quad \text{or} \quad
        e_t = p_t - d

    for a target d, if the descriptor is the mean of the state descriptors m, or the
    final position p. A step is rewarded with :math:`w_1 r + w_2 T (|e_t| -
    |e_{t+1}|)`. Summed over the episode, the second term is :math:`w_2 T (|e_0| -
    |e_T|)`. For a mean, :math:`e_0` is 0, and :math:`|e_T|` is the distance between the
    episode's descriptor and the target. It has a gradient through the physics. The end
    of an episode by a fall costs as much as 30 steps away from the target; without
    that, a fall would be the way to come no further away.

    Attributes:
        task: Task with a descriptor that has a gradient.
        episode_length: Control steps of an episode.
    """

    task: Task
    episode_length: int

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return self.task.env.action_size

    @property
    def observation_size(self) -> int:
        """Length of an observation with target, error and weight."""
        return self.task.env.observation_size + 2 * self.task.descriptor_length + 1

    @functools.cached_property
    def _scale(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle and half of the extent of the descriptor, (D,) each."""
        low, high = self.task.limits
        return (low + high) / 2, (high - low) / 2

    @functools.cached_property
    def _final(self) -> bool:
        """Whether the descriptor depends on the end of the episode alone."""
        return self.task.reads_end

    def scaled(self, descriptors: jax.Array) -> jax.Array:
        """Returns descriptors (..., D) in units of targets."""
        middle, half = self._scale
        return (descriptors - middle) / half

    def reset(self, rng: RNGKey) -> AimedState:
        """Starts an episode that aims at the middle of the descriptor space."""
        first = self.task.env.reset(rng)
        middle = jnp.zeros(self.task.descriptor_length, first.obs.dtype)
        return self.aimed(first, middle, jnp.ones(2, first.obs.dtype))

    def aimed(
        self, first: StateLike, target: jax.Array, weights: jax.Array
    ) -> AimedState:
        """Returns the start of an episode.

        Args:
            first: Initial state of the world.
            target: (D,) target.
            weights: (2,) weights of reward and distance.
        """
        error = jnp.zeros_like(target)
        if self._final:
            error = self.scaled(first.info["state_descriptor"]) - target
        return AimedState(first, target, error, weights, jnp.zeros_like(first.reward))

    def step(self, state: AimedState, action: Action) -> AimedState:
        """Advances by one step."""
        after = self.task.env.step(state.state, action)
        reached = self.scaled(after.info["state_descriptor"]) - state.target
        error = reached if self._final else state.error + reached / self.episode_length
        nearer = self.episode_length * (_length(state.error) - _length(error))
        fall = _FALL * self.task.descriptor_length**0.5
        # an episode that reaches its length is done, and did not fall
        fell = after.done > after.info.get("truncation", 0)
        paid = nearer - jnp.where(fell, fall, 0).astype(nearer.dtype)
        reward = state.weights[0] * after.reward + state.weights[1] * paid
        return AimedState(after, state.target, error, state.weights, reward)


def _length(error: jax.Array) -> jax.Array:
    """Returns the length of an error, smooth at 0."""
    return jnp.sqrt(jnp.sum(jnp.square(error)) + _SMALL**2)


@dataclasses.dataclass(frozen=True, eq=False)
class ConditionedPolicy:
    """A policy that depends on a target: the target moves the first layer's bias.

    This is a perceptron whose inputs are observation and target. For one target, it is
    a policy of the archive.

    Attributes:
        policy: Policy of the archive.
        targets: Length of a target.

    Raises:
        ValueError: The first layer of the policy is not known.
    """

    policy: Policy
    targets: int

    def __post_init__(self) -> None:
        """Finds the first layer.

        Raises:
            ValueError: It is not known.
        """
        _ = self._bias

    @functools.cached_property
    def _bias(self) -> np.ndarray:
        """Places of the first layer's bias in a vector of weights.

        Raises:
            ValueError: The first layer is not known.
        """
        bias = Whitening.of(self.policy).bias
        if bias is None:
            given = Fact(type(self.policy.network).__name__)
            allowed = "a policy of make_policy, whose first layer is known"
            raise ValueError(message("policy", given, allowed))
        return bias

    @property
    def size(self) -> int:
        """Number of weights, with those of the target."""
        return self.policy.size + self.targets * len(self._bias)

    def unconditioned(self, weights: jax.Array) -> jax.Array:
        """Returns the weights (size,) of an actor that does what a policy does."""
        more = jnp.zeros((self.size - self.policy.size,), weights.dtype)
        return jnp.concatenate([weights, more])

    def specialized(self, actor: jax.Array, target: jax.Array) -> jax.Array:
        """Returns the weights of the actor's policy for a target (D,)."""
        weights, more = jnp.split(actor, [self.policy.size])
        shift = target @ more.reshape(self.targets, -1)
        return weights.at[self._bias].add(shift)

    def act(self, actor: jax.Array, observation: jax.Array) -> jax.Array:
        """Returns the action (nu,) of the actor for an observation of ``AimedEnv``."""
        size = observation.shape[-1] - 2 * self.targets - 1
        target = observation[size : size + self.targets]
        weights = self.specialized(actor, target)
        return self.policy.of_weights(weights, observation[:size])


def no_measure(before: StateLike, after: StateLike) -> jax.Array:
    """Returns no measures: the reward of ``AimedEnv`` has everything."""
    del before
    return jnp.zeros((0,), after.reward.dtype)
