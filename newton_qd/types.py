"""Shared aliases and protocols, and the table of the keys of ``State.info``."""

from __future__ import annotations

import types
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeAlias

import jax

from newton_qd.moved import moved_name

RNGKey: TypeAlias = jax.Array
Action: TypeAlias = jax.Array
Observation: TypeAlias = jax.Array
Descriptor: TypeAlias = jax.Array
Mask: TypeAlias = jax.Array
Metrics: TypeAlias = dict[str, jax.Array]
Info: TypeAlias = dict[str, Any]
Params: TypeAlias = Any  # of simulated robots: physics.PhysicsParams

PyTree: TypeAlias = Any
"""Arrays in nested dicts, tuples, lists and registered dataclasses."""

Genotype: TypeAlias = PyTree
"""Variables of a search: weights of a policy, or actions. N genotypes: N in front."""

Repertoire: TypeAlias = PyTree
"""An archive of QDax: genotypes, fitnesses, descriptors and centroids of cells."""

ExtraScores: TypeAlias = dict[str, Any]
"""Further results of a scoring function, after fitness and descriptor, by name."""

ScoringFunction: TypeAlias = Callable[
    [Genotype, RNGKey], tuple[jax.Array, Descriptor, ExtraScores]
]
"""QDax's contract: maps N genotypes and a key to fitnesses (N,), descriptors (N, D)."""


PolicyFunction: TypeAlias = Callable[[PyTree, Observation], Action]
"""Maps parameters and an observation (no,) to an action (nu,)."""

_MOVED = {"Policy": "newton_qd.types.PolicyFunction"}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)


class StateDescriptors(Protocol):
    """The part of the transitions that a descriptor extractor reads."""

    @property
    def state_desc(self) -> jax.Array:
        """(n, t, nd) state descriptors before each step."""
        ...


class DescriptorExtractor(Protocol):
    """Reads the descriptors of n episodes."""

    def __call__(self, data: StateDescriptors, mask: Mask, /) -> Descriptor:
        """Maps transitions and a mask (n, t), 1 after the end, to (n, D)."""
        ...


class StateLike(Protocol):
    """The state of an episode: :class:`newton_qd.State`, or your own class."""

    @property
    def obs(self) -> Observation:
        """(no,) observation."""
        ...

    @property
    def reward(self) -> jax.Array:
        """() reward of the step that led here."""
        ...

    @property
    def done(self) -> jax.Array:
        """() 1 if the episode has ended, else 0."""
        ...

    @property
    def info(self) -> Mapping[str, PyTree]:
        """Readings by name; :data:`INFO_KEYS` lists the keys."""
        ...


class Environment(Protocol):
    """The environment of an episode: :class:`newton_qd.Env`, or your own class.

    ``step`` may take the physical parameters of the world as a third argument.
    """

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        ...

    @property
    def action_size(self) -> int:
        """Length of an action."""
        ...

    def reset(self, rng: RNGKey, /) -> StateLike:
        """Begins an episode."""
        ...

    def step(self, state: PyTree, action: Action, /) -> StateLike:
        """Advances by one control step."""
        ...


INFO_KEYS: Mapping[str, str] = types.MappingProxyType(
    {
        "fault": "() int32: 0 while the world is sound; then frozen until it is reset",
        "steps": "() control steps since the episode began",
        "truncation": "() 1 where the episode ended by its length alone, else 0",
        "state_descriptor": "(nd,) descriptor of the state that this step reached",
        "xy_position": "(2,) x and y of the torso or tip, also beyond the limits",
        "rng": "data of the key from which the next place of a target is drawn",
        "first_pipeline_state": "physics state to which an auto-reset returns",
        "first_obs": "(no,) observation to which an auto-reset returns",
        "first_state_descriptor": "(nd,) descriptor to which an auto-reset returns",
        "first_xy_position": "(2,) position to which an auto-reset returns [m]",
        "params": "physical parameters of the world, drawn at the reset",
        "eval_metrics": "EvalMetrics: sums over the first episode",
        "completed_eval_metrics": "CompletedEvalMetrics: sums over ended episodes",
    }
)
"""Every key that the environments and wrappers write into ``State.info``."""

READINGS = ("state_descriptor", "xy_position")
"""Keys of ``State.info`` that depend on the simulation; an auto-reset resets them."""
