"""Elites that follow value gradients over short windows."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from qdax.core.emitters.emitter import Emitter

from newton_qd.envs.state import select
from newton_qd.qd.emitters.actor_critic_learner import (
    ActorCritic,
    Layers,
    Learner,
    _network,
    _sound,
)
from newton_qd.qd.emitters.cells import draw_cells
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ValueGradientState:
    critic: Layers
    target: Layers
    moments: PyTree
    scale: tuple[jax.Array, jax.Array]
    snapshots: jax.Array
    failed: jax.Array
    key: jax.Array


class ValueGradientEmitter(Emitter):
    def __init__(
        self,
        method: ActorCritic,
        limits: Any,
        *,
        parents: int,
        updates: int,
        snapshots: int = 1,
        keep: float = 0.0,
        normalized: bool = False,
        random_starts: bool = True,
        first: PyTree = None,
    ) -> None:
        self._method = method
        self._limits = jnp.asarray(limits, jnp.float32)
        self._parents = parents
        self._updates = updates
        self._snapshots = snapshots
        self._keep = keep
        self._normalized = normalized
        self._random_starts = random_starts
        self._first = first

    @property
    def batch_size(self) -> int:
        return self._parents * self._snapshots

    @property
    def _windows(self) -> int:
        return -(-self._method.episode_length // self._method.settings.window)

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> PyTree:
        del repertoire, extra_scores, fitnesses
        key, reset_key, scale_key, critic_key = jax.random.split(key, 4)
        first = self._starts(reset_key)
        scale = self._method.scale(scale_key, first)
        inputs = first.obs.shape[-1] + descriptors.shape[-1]
        critic = _network(critic_key, (inputs, *self._method.settings.critic, 1))
        return ValueGradientState(
            critic=critic,
            target=critic,
            moments=self._method._optimizers[1].init(critic),
            scale=scale,
            snapshots=jnp.resize(genotypes, (self.batch_size, genotypes.shape[1])),
            failed=jnp.zeros((self._parents,), jnp.int32),
            key=key,
        )

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        return emitter_state.snapshots, {"overflowed": emitter_state.failed}

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: jax.Array | None = None,
        descriptors: jax.Array | None = None,
        extra_scores: ExtraScores | None = None,
    ) -> PyTree:
        state = emitter_state
        key, cell_key, reset_key, run_key, fit_key, learn_key = jax.random.split(
            state.key, 6
        )
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        cells = draw_cells(cell_key, filled, self._parents)
        white = self._method.whitening
        weights = white.whitened(repertoire.genotypes[cells], state.scale)
        low, high = self._limits
        told = 2 * (repertoire.descriptors[cells] - low) / (high - low) - 1
        first = self._starts(reset_key)
        begun, rows, measures = self._rollout(weights, state.scale, first, run_key)
        critic, moments = self._fit(state, told, rows, fit_key)
        target = jax.tree.map(lambda n, o: 0.8 * n + 0.2 * o, critic, state.target)
        snapshots, failed = self._improved(
            weights, told, target, state.scale, first, begun, measures, learn_key
        )
        return ValueGradientState(
            critic=critic,
            target=target,
            moments=moments,
            scale=state.scale,
            snapshots=white.plain(snapshots, state.scale).reshape(self.batch_size, -1),
            failed=failed,
            key=key,
        )

    def _starts(self, key: jax.Array) -> PyTree:
        if self._random_starts:
            keys = jax.random.split(key, self._parents)
            return jax.vmap(self._method.env.reset)(keys)
        return jax.tree.map(
            lambda x: jnp.broadcast_to(x, (self._parents, *jnp.shape(x))), self._first
        )

    def _rollout(self, weights, scale, first, key):
        """Start states of windows (windows, K), rows (T, K), mean measures (K, D)."""
        settings, method = self._method.settings, self._method
        plain = method.whitening.plain(weights, scale)
        dtype = weights.dtype
        shape = (self._windows, settings.window, self._parents, method.env.action_size)
        noise = settings.noise * jax.random.normal(key, shape, dtype)

        def step(state, noise):
            action = jax.vmap(method.policy)(plain, state.obs) + noise
            after = jax.vmap(method.env.step)(state, jnp.clip(action, -1, 1))
            over = (after.done > 0) | ~_sound(after)
            measure = jax.vmap(method.measure)(state, after)
            row = state.obs, after.reward, after.done, after.obs, measure
            return select(over, first, after), row

        def window(state, noise):
            last, rows = jax.lax.scan(step, state, noise)
            return last, (state, rows)

        _, (begun, rows) = jax.lax.scan(window, first, noise)
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
        return begun, rows[:4], rows[4].mean(axis=0)

    def _fit(self, state, told, rows, key):
        settings, method = self._method.settings, self._method
        obs, rewards, dones, afters = rows
        mean, deviation = state.scale
        factor = 1 - settings.discount

        def value(critic, obs, told):
            return method._value(given(critic, told), state.scale, obs)

        many = jax.vmap(jax.vmap(value, (None, 0, 0)), (None, 0, None))
        values = many(state.target, afters, told)
        values = jnp.where(jnp.isfinite(values), values, 0)

        def back(target, row):
            reward, done, value = row
            mixed = (1 - settings.trace) * value + settings.trace * target
            target = reward + settings.discount * jnp.where(done > 0, 0, mixed)
            return target, target

        _, targets = jax.lax.scan(
            back, values[-1], (rewards, dones, values), reverse=True
        )
        number = targets.size
        told_all = jnp.broadcast_to(told, (len(obs), *told.shape)).reshape(number, -1)
        obs, targets = obs.reshape(number, -1), targets.reshape(number)
        sound = jnp.isfinite(targets) & jnp.all(jnp.isfinite(obs), axis=1)

        def error(critic, picked):
            values = jax.vmap(value, (None, 0, 0))(
                critic, obs[picked], told_all[picked]
            )
            gap = jnp.where(sound[picked], values - targets[picked], 0)
            return jnp.square(factor * gap).mean()

        optimizer = method._optimizers[1]

        def fit(carry, picked):
            critic, moments = carry
            change, moments = optimizer.update(jax.grad(error)(critic, picked), moments)
            return (optax.apply_updates(critic, change), moments), None

        count = settings.epochs * settings.batches
        picked = jax.random.randint(key, (count, 2048), 0, number)
        return jax.lax.scan(fit, (state.critic, state.moments), picked)[0]

    def _improved(self, weights, told, target, scale, first, begun, measures, key):
        settings, method = self._method.settings, self._method
        low, high = self._limits
        begun = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), begun)  # (K, windows)
        optimizer = (
            optax.chain(optax.clip_by_global_norm(1.0), optax.sgd(settings.rate * 70))
            if self._normalized
            else optax.chain(
                optax.clip_by_global_norm(1.0), optax.adam(settings.rate, b1=0.7)
            )
        )
        aim = jnp.zeros((1 + told.shape[1],), weights.dtype).at[0].set(1)

        def loss(weights, told, first, begun, measure, noise):
            plain = method.whitening.plain(weights, scale)
            critic = given(target, told)
            learner = Learner(weights, aim, critic, critic, None, None, None, None)

            def run(state, noise):
                return method._window(plain, learner, scale, first, state, noise)[0]

            returns = jax.vmap(run)(begun, noise)
            return -(1 - settings.discount) * returns.mean()

        slope = jax.vmap(jax.grad(loss))

        def learn(carry, key):
            weights, moments, failed = carry
            shape = (
                self._parents,
                self._windows,
                settings.window,
                method.env.action_size,
            )
            noise = settings.noise * jax.random.normal(key, shape, weights.dtype)
            slopes = slope(weights, told, first, begun, measures, noise)
            bad = ~jnp.all(jnp.isfinite(slopes), axis=1)
            slopes = jnp.where(bad[:, None], 0, slopes)
            if self._normalized:
                norm = jnp.linalg.norm(slopes, axis=1, keepdims=True)
                slopes = slopes / jnp.maximum(norm, 1e-8)
            change, moments = jax.vmap(optimizer.update)(slopes, moments)
            return (weights + change, moments, failed + bad), weights + change

        keys = jax.random.split(key, self._updates)
        carry = (
            weights,
            jax.vmap(optimizer.init)(weights),
            jnp.zeros((self._parents,), jnp.int32),
        )
        (_, _, failed), path = jax.lax.scan(learn, carry, keys)
        every = self._updates // self._snapshots
        return path[every - 1 :: every][: self._snapshots], failed


def given(critic: Layers, told: jax.Array) -> Layers:
    """Returns the critic for a descriptor: its first layer with another bias."""
    (kernel, bias), *rest = critic
    size = kernel.shape[0] - told.shape[0]
    return [(kernel[:size], bias + told @ kernel[size:]), *rest]
