"""Policies with weights per individual, and their evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.inputs import require_key
from newton_qd.errors import require_extra
from newton_qd.gradients.episode import Episode
from newton_qd.gradients.flow import EXACT, GradientOptions
from newton_qd.qd.config import ConfigError
from newton_qd.qd.scoring.task import Task
from newton_qd.types import (
    Environment,
    ExtraScores,
    Genotype,
    Observation,
    PyTree,
    RNGKey,
    ScoringFunction,
)


@dataclasses.dataclass(frozen=True)
class Policy:
    """A network whose weights are one vector: a multilayer perceptron or your own.

    It pickles if its network does, and is made again where it is read.

    Attributes:
        size: Number of weights.
        init: Maps a key to weights (size,).
        unravel: Maps weights (size,) to the parameters that ``apply`` takes.
        apply: Maps parameters and an observation (O,) to an action (A,); a multilayer
            perceptron gives values inside [-1, 1].
        ravel: Maps parameters to weights (size,); the inverse of ``unravel``.
        network: The Flax module that ``apply`` calls.
    """

    size: int
    init: Callable[[RNGKey], jax.Array]
    unravel: Callable[[jax.Array], PyTree]
    apply: Callable[[PyTree, Observation], jax.Array]
    ravel: Callable[[PyTree], jax.Array]
    network: Any
    # not an argument: dataclasses.replace returns a policy that is not made like this
    _made: tuple[Callable[..., Policy], Any] | None = dataclasses.field(
        default=None, init=False, compare=False, repr=False
    )

    def made_by(self, maker: Callable[..., Policy], *arguments: Any) -> Policy:
        """Returns this policy, whose functions pickle by how they were made.

        Args:
            maker: Function that made it.
            *arguments: Its arguments.
        """
        object.__setattr__(self, "_made", (maker, arguments))
        return self

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Returns what pickle stores."""
        return super().__reduce_ex__(protocol) if self._made is None else self._made

    def __copy__(self) -> Policy:
        """Returns this policy itself, which never changes."""
        return self  # one that is made again would not be equal, and compile again

    def __deepcopy__(self, memo: Any) -> Policy:
        """Returns this policy itself, which never changes."""
        return self

    def of_weights(self, weights: jax.Array, observation: Observation) -> jax.Array:
        """Returns the action (A,) of a policy with weights (size,)."""
        return self.apply(self.unravel(weights), observation)

    def weights(self, genotypes: Genotype) -> jax.Array:
        """Returns genotypes (N, size) as floating-point numbers.

        Raises:
            ValueError: They have the wrong shape.
        """
        if jnp.shape(genotypes)[1:] != (self.size,):
            given = Fact(f"shape {jnp.shape(genotypes)}")
            allowed = f"(N, {self.size}), the weights of this policy"
            raise ValueError(message("genotypes", given, allowed))
        array = jnp.asarray(genotypes)
        whole = not jnp.issubdtype(array.dtype, jnp.floating)
        return array.astype(jnp.float32) if whole else array


def make_policy(env: Environment, hidden: tuple[int, ...]) -> Policy:
    """Builds QDax's perceptron for an environment.

    Args:
        env: Environment with ``observation_size`` and ``action_size``.
        hidden: Widths of the hidden layers.

    Raises:
        MissingExtra: QDax is not installed.
        TypeError: ``env`` is not an environment, or ``hidden`` is no sequence.
        ValueError: A width is not an integer above 0.
    """
    checks.environment(env, needs="observation_size")
    checks.instance("hidden", hidden, (tuple, list), "a tuple of integers")
    for index, width in enumerate(hidden):
        checks.integer(f"hidden[{index}]", width)
    return _perceptron(env.observation_size, env.action_size, tuple(hidden))


def _perceptron(observation_size: int, action_size: int, hidden: tuple) -> Policy:
    """Builds QDax's perceptron.

    Raises:
        MissingExtra: QDax is not installed.
    """
    require_extra("qdax", "qd")
    from qdax.core.neuroevolution.networks.networks import MLP

    network = MLP(
        layer_sizes=(*hidden, action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )
    dummy = jnp.zeros((observation_size,), jnp.float32)
    example = jax.eval_shape(network.init, jax.random.key(0), dummy)
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), example)
    size, unravel = flattened(zeros)

    def init(key: RNGKey) -> jax.Array:
        require_key("key", key)
        return ravel_pytree(network.init(key, dummy))[0]

    def apply(parameters: PyTree, observation: Observation) -> jax.Array:
        return jnp.asarray(network.apply(parameters, observation))

    return Policy(
        size=size,
        init=init,
        unravel=unravel,
        apply=apply,
        ravel=lambda parameters: ravel_pytree(parameters)[0],
        network=network,
    ).made_by(_perceptron, observation_size, action_size, hidden)


def flattened(zeros: PyTree) -> tuple[int, Callable[[jax.Array], PyTree]]:
    """Returns the number of weights in parameters, and ``unravel`` of a policy.

    Args:
        zeros: Parameters of the policy; their values do not count.
    """
    flat, unravel = ravel_pytree(zeros)

    def parameters_of(weights: jax.Array) -> PyTree:
        if jnp.shape(weights) != flat.shape:
            given = Fact(f"shape {jnp.shape(weights)}")
            allowed = f"{flat.shape}, those of this policy"
            raise ValueError(message("weights", given, allowed))
        return unravel(weights)

    return flat.size, parameters_of


def episode_of(
    task: Task,
    policy: Policy,
    episode_length: int,
    *,
    options: GradientOptions = EXACT,
    transitions: bool = False,
) -> Episode:
    """Makes the episode of a task whose genotypes are weights of a policy.

    Args:
        task: Environment and descriptor.
        policy: Policy whose weights are the genotypes.
        episode_length: Control steps.
        options: Windows, clipping, discounting and memory of its gradients.
        transitions: Whether to return the steps.

    Raises:
        TypeError: ``task`` is not a ``Task``, or ``policy`` not a ``Policy``.
        ValueError: ``episode_length`` is not an integer from 1.
    """
    checks.instance("task", task, Task, "a Task, as make_task() makes it")
    checks.instance("policy", policy, Policy, "a Policy, as make_policy() makes it")
    return Episode(
        task.env,
        policy.apply,
        task.descriptor_extractor,
        episode_length=episode_length,
        options=options,
        unravel=policy.unravel,
        transitions=transitions,
    )


def make_scoring_function(
    task: Task, policy: Policy, episode_length: int, *, transitions: bool = False
) -> ScoringFunction:
    """Builds the function that evaluates a batch of individuals.

    All individuals start from the same reset state, so that the return of an individual
    depends on its weights only.

    Args:
        task: Environment and descriptor.
        policy: Policy whose weights are the genotypes.
        episode_length: Control steps of an evaluation.
        transitions: Whether to return the steps, for algorithms that learn from them.
            If an episode ends early, another one then follows. It has no effect on
            fitness and descriptor.

    Returns:
        Function of genotypes (N, size) and a key for the reset. It returns fitnesses
        (N,), descriptors (N, D) and a dictionary. The dictionary is empty or contains
        ``transitions``: the fields of QDax's ``QDTransition`` by name, (N, T, ...)
            each.
        If the world had a fault or a result is not finite, the fitness is ``-inf``, and
        archives do not take the individual. The function raises ``ValueError`` for
        genotypes that are not weights of this policy, and ``ConfigError`` for
        descriptors of another length than the limits of the task.

    Raises:
        ValueError: ``episode_length`` is not an integer from 1.
    """
    episode = episode_of(task, policy, episode_length, transitions=transitions)
    evaluate = episode.scoring()

    def score(
        genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        found = evaluate(policy.weights(genotypes), key)
        length = found[1].shape[-1]
        if length != task.descriptor_length:
            # JAX would broadcast a descriptor with one component into the archive
            given = Fact(f"descriptors of length {length}")
            allowed = f"length {task.descriptor_length}, as the limits of the task have"
            raise ConfigError(message("descriptor_extractor", given, allowed))
        return found

    return score
