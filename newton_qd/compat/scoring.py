"""Shared code of the scoring functions of all releases of QDax."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp

from newton_qd import registry
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State, at_fault
from newton_qd.extractors import folded_sum
from newton_qd.gradients.outcome import transition
from newton_qd.types import DescriptorExtractor, ExtraScores, Genotype, PyTree, RNGKey

if TYPE_CHECKING:
    from qdax.core.neuroevolution.networks.networks import MLP

Scores = tuple[jax.Array, jax.Array, ExtraScores]


class PolicyNetwork(Protocol):
    """A policy that gets its parameters as an argument, such as a module of Flax."""

    def apply(self, variables: PyTree, obs: jax.Array, /) -> PyTree:
        """Returns the actions for observations."""
        ...


def make_policy_network_play_step_fn_brax(
    env: Env, policy_network: PolicyNetwork
) -> Callable[[State, Genotype, RNGKey], tuple[State, Genotype, RNGKey, PyTree]]:
    """Makes the function of one step with a policy.

    Args:
        env: Environment with a state descriptor.
        policy_network: Flax module from observations to actions.

    Returns:
        Function of a state, parameters and a key. It returns the next state, the
        unchanged parameters and key, and a ``QDTransition``. It raises a ``ValueError``
        for a state without a state descriptor.
    """
    from qdax.core.neuroevolution.buffers.buffer import QDTransition

    def play_step(
        state: State, params: Genotype, key: RNGKey
    ) -> tuple[State, Genotype, RNGKey, PyTree]:
        if "state_descriptor" not in state.info:
            given = Fact("an environment with no state descriptor")
            raise ValueError(message("env", given, "QD tasks, such as ant_uni"))
        actions = policy_network.apply(params, state.obs)
        following = env.step(state, actions)
        taken = QDTransition(**transition(state, actions, following))
        return following, params, key, taken

    return play_step


def get_mask_from_transitions(data: PyTree) -> jax.Array:
    """Marks the steps after the end of an episode.

    Args:
        data: Transitions with ``dones`` (N, T).

    Returns:
        (N, T) 1 if an earlier step is done, else 0.
    """
    ended = jax.lax.cummax(data.dones, axis=1)
    return jnp.concatenate([jnp.zeros_like(ended[:, :1]), ended[:, :-1]], axis=1)


def evaluate(
    play_step: Callable[..., tuple],
    carry: tuple[PyTree, ...],
    in_axes: tuple[int | None, ...],
    episode_length: int,
    descriptor_extractor: DescriptorExtractor,
) -> Scores:
    """Runs one episode for each of N policies, in parallel.

    Args:
        play_step: Maps the carry, as arguments, to the carry and a transition.
        carry: States, parameters and other arguments of ``play_step``.
        in_axes: 0 for each part of the carry with one entry per policy; ``None`` for a
            part that all policies share.
        episode_length: Number of steps T.
        descriptor_extractor: Maps transitions (N, T, ...) and their mask to
            descriptors (N, D).

    Returns:
        Fitnesses (N,), descriptors (N, D), and ``{"transitions": ...}``. The order of
        the sums does not depend on N. The fitness is ``-inf`` if the world had a fault
        before the episode ended; the carry begins with the state.

    Raises:
        ValueError: An episode has more than one world.
    """

    def episode(*carry: PyTree) -> PyTree:
        def body(
            carry: tuple[PyTree, ...], _: None
        ) -> tuple[tuple[PyTree, ...], PyTree]:
            *carry_list, transition = play_step(*carry)
            return tuple(carry_list), (transition, at_fault(carry_list[0]))

        return jax.lax.scan(body, carry, None, length=episode_length)[1]

    data, faults = jax.vmap(episode, in_axes=in_axes)(*carry)
    if data.dones.ndim != 2:  # individuals and steps
        given = Fact(f"a batch of shape {data.dones.shape[2:]} for each individual")
        allowed = "one world: newton_qd.create without batch_size"
        raise ValueError(message("env", given, allowed))
    mask = get_mask_from_transitions(data)
    before_end = mask == 0
    # not times 0, because 0 times nan is nan, and a reward may be nan after the end
    fitnesses = folded_sum(jnp.where(before_end, data.rewards, 0), 1)
    fitnesses = jnp.where((faults & before_end).any(axis=1), -jnp.inf, fitnesses)
    return fitnesses, descriptor_extractor(data, mask), {"transitions": data}


def population_size(params: Genotype) -> int:
    """Returns the number of individuals: the length of the first axis of a leaf."""
    return jax.tree.leaves(params)[0].shape[0]


def reset_function(
    env: Env,
    key: jax.Array,
    deterministic: bool,
    play_reset_fn: Callable[[jax.Array], State] | None,
) -> Callable[[jax.Array], State]:
    """Returns the reset of evaluations: all in the same state, or each in its own."""
    if deterministic:
        state = env.reset(key)
        return lambda _: state
    return env.reset if play_reset_fn is None else play_reset_fn


def default_task(
    env_name: str, episode_length: int, hidden: tuple[int, ...]
) -> tuple[Env, MLP]:
    """Makes an environment, and QDax's default perceptron for it."""
    from qdax.core.neuroevolution.networks.networks import MLP

    env = registry.create(env_name, episode_length=episode_length, brax_views=True)
    policy_network = MLP(
        layer_sizes=(*hidden, env.action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )
    return env, policy_network
