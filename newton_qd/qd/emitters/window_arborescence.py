"""Gradient arborescence whose gradients are learned over short windows."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic, Learner
from newton_qd.qd.emitters.arborescence_state import ArborescenceState
from newton_qd.qd.emitters.cma_maega import CMAMAEGAEmitter
from newton_qd.qd.emitters.whitening import Scale
from newton_qd.qd.scoring.gradient_scores import Scores, normalize, read_scores
from newton_qd.types import PyTree, ScoringFunction, StateLike


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Climbers:
    """The actors of E solution points.

    Attributes:
        probes: Actors that find gradients, of the fitness and of each component of the
            descriptor, leaves (E, 1 + D, ...).
        walkers: Actors that move the points, leaves (E, ...).
        scale: Mean and deviation of observations, (E, no) each, the same E times.
    """

    probes: Learner
    walkers: Learner
    scale: Scale


class WindowArborescenceEmitter(CMAMAEGAEmitter):
    """CMA-MAEGA for large policies, as in PPGA, with gradients over short windows.

    PPGA (Batra et al. 2024, "Proximal policy gradient arborescence for quality
    diversity reinforcement learning", arXiv 2305.13795) estimates the gradients of a
    search policy with PPO. Here they come from the short-horizon actor-critic (Xu et
    al. 2022): actors that begin at the search policy maximize the return, and each
    measure, over windows through the physics. A gradient is the way of such an actor.
    CMA-ES searches for steps along them. Then another actor walks: it begins at the
    search policy too, and maximizes the sum of return and measures, weighted by the
    mean of the coefficients.

    With whitening, the gradients have length 1 in weights for whitened observations.
    """

    def __init__(
        self,
        scoring_function: ScoringFunction,
        method: ActorCritic,
        first: StateLike,
        *,
        probes: int = 4,
        walks: int = 4,
        **options: Any,
    ) -> None:
        """Sets up the search; evaluates nothing.

        Args:
            scoring_function: Scores solution points (E, size), without gradients.
            method: Learning method of the actors.
            first: Initial state of every episode.
            probes: Updates of an actor that finds a gradient.
            walks: Updates of an actor that moves a point.
            **options: Those of ``CMAMAEGAEmitter``, without ``optimizer``.

        Raises:
            TypeError: ``method`` is no actor-critic, or ``optimizer`` is given.
            ValueError: A number is out of its range.
        """
        if options.get("optimizer") is not None:
            allowed = "no optimizer: an actor moves a point"
            raise TypeError(message("optimizer", options["optimizer"], allowed))
        checks.instance("method", method, ActorCritic, "an ActorCritic")
        super().__init__(scoring_function, **options)
        checks.integer("probes", probes, most=None)
        checks.integer("walks", walks, most=None)
        self._method = method
        self._first = first
        self._probes = probes
        self._walks = walks

    def _begun(
        self, points: jax.Array, descriptor_length: int, key: jax.Array, old: Any
    ) -> Climbers:
        worlds = self._method.worlds(self._first)
        scale_key, probe_key, walk_key = jax.random.split(key, 3)
        if old is None:
            found = self._method.scale(scale_key, worlds)
            scale = jax.tree.map(lambda x: jnp.tile(x, (len(points), 1)), found)
        else:
            scale = old.scale
        aims = jnp.eye(1 + descriptor_length, dtype=points.dtype)
        weights = jax.vmap(self._method.whitening.whitened)(points, scale)
        count = len(points), len(aims)

        def begin(key: jax.Array, weights: jax.Array, aim: jax.Array) -> Learner:
            return self._method.begin(key, weights, aim, worlds)

        probes = jax.vmap(jax.vmap(begin, (0, None, 0)), (0, 0, None))
        return Climbers(
            probes=probes(jax.random.split(probe_key, count), weights, aims),
            walkers=jax.vmap(begin, (0, 0, None))(
                jax.random.split(walk_key, len(points)), weights, aims[0]
            ),
            scale=scale,
        )

    def _updated(
        self, actors: Learner, scale: Scale, key: jax.Array, updates: int
    ) -> Learner:
        """Returns actors, leaves (E, ...), after some updates."""
        actors, scale, key = varying_alike((actors, scale, key))
        count = len(scale[0])

        def learn(actors: Learner, key: jax.Array) -> tuple[Learner, None]:
            keys = jax.random.split(key, count)
            return jax.vmap(self._method.update)(actors, scale, keys)[0], None

        return jax.lax.scan(learn, actors, jax.random.split(key, updates))[0]

    def _moved(
        self, state: ArborescenceState | PyTree, means: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, Climbers]:
        climbers = state.optimizer
        walkers = dataclasses.replace(climbers.walkers, aim=normalize(means))
        walkers = self._updated(walkers, climbers.scale, key, self._walks)
        points = jax.vmap(self._method.whitening.plain)(walkers.weights, climbers.scale)
        return points, dataclasses.replace(climbers, walkers=walkers)

    def _scored(
        self, points: jax.Array, optimizer: Climbers, key: jax.Array
    ) -> tuple[Scores, Climbers]:
        white, scale = self._method.whitening, optimizer.scale
        weights = jax.vmap(white.whitened)(points, scale)
        moved = jax.vmap(jax.vmap(self._method.moved, (0, None)))
        probes = moved(optimizer.probes, weights)
        score_key, learn_key = jax.random.split(key)
        count = probes.weights.shape[1]
        # all actors of all points at once
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), probes)
        repeated = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), scale)
        rows = self._updated(rows, repeated, learn_key, self._probes)
        probes = jax.tree.map(
            lambda x: x.reshape(len(points), count, *x.shape[1:]), rows
        )
        ways = normalize(probes.weights - weights[:, None])
        # the conversion is linear, so it holds for steps too
        ways = jax.vmap(white.plain)(ways, scale)
        fitnesses, descriptors, _ = self._scoring_function(points, score_key)
        gradients = {"gradients": jnp.swapaxes(ways, 1, 2)}
        scores = read_scores(points, fitnesses, descriptors, gradients)
        return scores, dataclasses.replace(optimizer, probes=probes)
