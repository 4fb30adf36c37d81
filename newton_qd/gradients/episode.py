"""One episode of one world: its fitness and its descriptor."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from types import NoneType
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.options import check_count
from newton_qd.envs.state import State, select
from newton_qd.extractors import Trajectories
from newton_qd.gradients.flow import GradientOptions, passed_back
from newton_qd.types import Params

Policy = Callable[[Any, jax.Array], jax.Array]
"""Maps the parameters of a policy and an observation (no,) to an action (nu,)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """What an episode came to.

    Attributes:
        fitness: () sum of the rewards up to the first ``done``.
        descriptor: (D,) descriptor of the episode.
        faulty: () whether the world was at fault before the episode ended, or
            fitness or descriptor are not finite: they mean nothing then.
        transitions: Empty, or the fields of QDax's ``QDTransition`` by name,
            (T, ...) each.
    """

    fitness: jax.Array
    descriptor: jax.Array
    faulty: jax.Array
    transitions: dict[str, jax.Array] = dataclasses.field(default_factory=dict)


class Episode(Protocol):
    """Runs one episode of one world; see :func:`make_episode`."""

    def __call__(
        self, genotype: Any, start: jax.Array | State, params: Params = None, /
    ) -> Outcome:
        """Returns what the episode came to.

        Args:
            genotype: Whose policy acts, or the actions.
            start: Key of the reset, or the state that the episode begins from.
            params: Physical parameters of the world; ``None``: as in its files.
        """
        ...


def make_episode(
    env: Any,
    policy: Policy | None,
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array] | None,
    *,
    episode_length: int,
    unravel: Callable[[Any], Any] = lambda genotype: genotype,
    options: GradientOptions | None = None,
    transitions: bool = False,
) -> Episode:
    """Builds the function that runs one episode.

    It is differentiable in the genotype, in the state that the episode begins from and
    in the physical parameters of the world.

    Args:
        env: Environment of one world without auto-reset; with
            ``info["state_descriptor"]`` where a descriptor is extracted.
        policy: Maps parameters and an observation to an action; ``None``: the
            parameters are the actions themselves, (episode_length, nu) or as many
            numbers in another shape.
        descriptor_extractor: Maps ``(data, mask)`` to descriptors (1, D), with
            ``data.state_desc`` (1, T, nd) and ``mask`` (1, T) equal to 1 after the
            end of the episode; ``newton_qd.tables.descriptor_extractor`` has those of
            tasks. ``None``: the descriptor is empty.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters, once an episode.
        options: What becomes of the gradient on its way back; ``None``: no care is
            taken of its memory, and it is exact.
        transitions: Whether to return the steps, for algorithms that learn from
            them. An episode that ends early is followed by another one then, which
            counts for nothing else.

    Returns:
        Function of the genotype, of the key of the reset or a first state, and of
        physical parameters, if any. Under ``jax.vmap`` the worlds share the launches,
        and so do the rows of a Jacobian.

    Raises:
        TypeError: ``env`` is no environment, or ``options`` something else.
        ValueError: ``episode_length`` is not an integer from 1.
    """
    check_count("episode_length", episode_length)
    if not hasattr(env, "step"):
        raise TypeError(f"env={env!r}: allowed: an environment, as create() makes it")
    if not isinstance(options, (GradientOptions, NoneType)):
        raise TypeError(f"options={options!r}: allowed: None, or GradientOptions")
    kept = options or GradientOptions(checkpoint_every=None)
    return _Run(
        env, policy, descriptor_extractor, episode_length, unravel, kept, transitions
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Run:
    """The function that ``make_episode`` returns, whose arguments its fields are."""

    env: Any
    policy: Policy | None
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array] | None
    episode_length: int
    unravel: Callable[[Any], Any]
    options: GradientOptions
    transitions: bool

    def __call__(
        self, genotype: Any, start: jax.Array | State, params: Params = None, /
    ) -> Outcome:
        """Runs the episode."""
        parameters = self.unravel(genotype)
        is_key = isinstance(start, (jax.Array, np.ndarray))
        first = self.env.reset(start) if is_key else start
        self._check_first(first)
        dtype, steps = first.reward.dtype, self.episode_length
        rows: dict[str, Any] = {}
        if not self.options.exact:
            rows["factor"] = self.options.factors(steps).astype(dtype)
        if self.policy is None:
            rows["action"] = self._plan(parameters)
        no = jnp.zeros((), bool)
        (_, fitness, _, bad), (readings, over, taken) = _scan(
            functools.partial(self._advance, parameters, first, params),
            (first, jnp.zeros((), dtype), no, no),
            rows,
            steps,
            self.options.checkpoint_every,
        )
        descriptor = jnp.zeros((0,), dtype)
        if self.descriptor_extractor is not None:
            data, mask = Trajectories(readings[None]), over[None].astype(readings.dtype)
            descriptor = self.descriptor_extractor(data, mask)[0]
        bad = bad | ~jnp.isfinite(fitness) | ~jnp.all(jnp.isfinite(descriptor))
        return Outcome(fitness, descriptor, bad, taken)

    def _check_first(self, first: Any) -> None:
        """Raises for what no episode can begin from."""
        if not hasattr(first, "reward"):
            raise TypeError(
                f"start: {type(first).__name__} given; allowed: a key of jax.random, "
                "or a state of the environment"
            )
        if jnp.ndim(first.reward):
            raise ValueError(
                f"start: a state of a batch of shape {jnp.shape(first.reward)} given; "
                "allowed: of one world, under jax.vmap for more"
            )
        described = self.descriptor_extractor is not None or self.transitions
        if described and "state_descriptor" not in first.info:
            raise ValueError(
                "env: its states have no state descriptor; allowed: QD tasks, as "
                "ant_uni, or descriptor_extractor=None without transitions"
            )

    def _plan(self, parameters: Any) -> jax.Array:
        """Open-loop actions (episode_length, nu)."""
        shape = (self.episode_length, self.env.action_size)
        if np.size(parameters) != math.prod(shape):
            raise ValueError(
                f"genotype: shape {np.shape(parameters)} given; allowed: actions of "
                f"shape {shape} for each world"
            )
        return jnp.asarray(parameters).reshape(shape)

    def _advance(
        self, parameters: Any, first: State, params: Params, carry: tuple, row: Any
    ) -> tuple[tuple, tuple]:
        """One control step; hands on state, fitness, whether it is over, and faults."""
        begin, fitness, over, bad = carry
        state = begin
        if "factor" in row:
            state = passed_back(state, row["factor"], self.options.clip)
        if self.policy is None:
            action = row["action"]
        else:
            action = self.policy(parameters, state.obs)
        # an environment of one's own may have a step without parameters
        own = () if params is None else (params,)
        state = self.env.step(state, action, *own)
        steps = _transition(begin, action, state) if self.transitions else {}
        # The sum runs in time order here, not in a reduction over time, so that a
        # row's return does not depend on the size of the batch.
        fitness = jnp.where(over, fitness, fitness + state.reward)
        bad = bad | (~over & at_fault(state))
        reading = None
        if self.descriptor_extractor is not None:
            reading = begin.info["state_descriptor"]
        ended = state.done > 0
        if self.transitions:
            state = select(ended, first, state)
        return (state, fitness, over | ended, bad), (reading, over, steps)


def _scan(
    body: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    rows: Any,
    steps: int,
    every: int | None,
) -> tuple[Any, Any]:
    """``jax.lax.scan`` that keeps a carry every so many steps for its gradient."""
    if every is None:
        return jax.lax.scan(body, carry, rows, length=steps)
    if every == 1:
        body = jax.checkpoint(body, prevent_cse=False)
        return jax.lax.scan(body, carry, rows, length=steps)
    every = min(every, steps)
    segments = steps // every
    cut = segments * every

    def segment(carry: Any, rows: Any, length: int = every) -> tuple[Any, Any]:
        return jax.lax.scan(body, carry, rows, length=length)

    heads = jax.tree.map(lambda x: x[:cut].reshape(segments, every, *x.shape[1:]), rows)
    kept = jax.checkpoint(segment, prevent_cse=False)
    carry, readings = jax.lax.scan(kept, carry, heads, length=segments)
    readings = jax.tree.map(lambda x: x.reshape(cut, *x.shape[2:]), readings)
    if cut == steps:
        return carry, readings
    tail = jax.tree.map(lambda x: x[cut:], rows)
    kept = jax.checkpoint(functools.partial(segment, length=steps - cut))
    carry, last = kept(carry, tail)
    return carry, jax.tree.map(lambda *x: jnp.concatenate(x), readings, last)


def _transition(begin: Any, action: jax.Array, end: Any) -> dict[str, jax.Array]:
    """The fields of QDax's ``QDTransition`` for one step."""
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


def at_fault(state: Any) -> jax.Array:
    """Whether the physics contained a value that is not finite."""
    if "fault" in state.info:
        return state.info["fault"] != 0
    return jnp.zeros((), bool)
