"""DCRL-ME's emitter, whose critic also learns slopes from the physics."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from qdax.core.emitters.dcrl_emitter import DCRLConfig, DCRLEmitter, DCRLEmitterState
from qdax.core.neuroevolution.buffers.buffer import DCRLTransition, ReplayBuffer

from newton_qd.envs.state import select
from newton_qd.gradients.flow import passed_back
from newton_qd.qd.emitters.cells import draw_cells
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlopeSettings:
    worlds: int = 2048
    window: int = 32
    trace: float = 0.95
    clip: float = 100.0
    noise: float = 0.1
    width: float = 0.2
    windows: int = 4
    most: float = 0.0


class Slopes(flax.struct.PyTreeNode):
    obs: jax.Array
    actions: jax.Array
    desc: jax.Array
    slopes: jax.Array
    sound: jax.Array


class SlopedTransition(DCRLTransition):
    near: Slopes


class SlopedBuffer(flax.struct.PyTreeNode):
    steps: ReplayBuffer
    slopes: Slopes

    def insert(self, transitions: DCRLTransition) -> SlopedBuffer:
        return self.replace(steps=self.steps.insert(transitions))

    def sample(self, key: jax.Array, number: int) -> SlopedTransition:
        step_key, slope_key = jax.random.split(key)
        steps = self.steps.sample(step_key, number)
        rows = jax.random.randint(slope_key, (number,), 0, len(self.slopes.sound))
        near = jax.tree.map(lambda x: x[rows], self.slopes)
        fields = {f.name: getattr(steps, f.name) for f in dataclasses.fields(steps)}
        return SlopedTransition(**fields, near=near)


class Worlds(flax.struct.PyTreeNode):
    policies: PyTree
    desc: jax.Array
    first: PyTree
    states: PyTree
    age: jax.Array


class SlopedState(DCRLEmitterState):
    worlds: Worlds


class SlopedEmitter(DCRLEmitter):
    def __init__(
        self,
        config: DCRLConfig,
        policy_network: Any,
        actor_network: Any,
        env: Any,
        settings: SlopeSettings,
        smooth: Any,
        episode_length: int,
        reward_offset: float,
    ) -> None:
        super().__init__(config, policy_network, actor_network, env)
        self._settings = settings
        self._smooth = smooth
        self._policy = policy_network.apply
        self._length = episode_length
        self._offset = reward_offset
        plain = self._critic_loss_fn
        critic = self._critic_network.apply

        def loss(params, target_actor, target_critic, transitions, key):
            near = transitions.near

            def total(actions, index):
                return critic(params, near.obs, actions, near.desc)[:, index].sum()

            found = jnp.stack(
                [jax.grad(total)(near.actions, index) for index in range(2)]
            )
            gap = jnp.where(near.sound[:, None], found - near.slopes, 0)
            extra = jnp.square(gap).sum((0, 2)).mean()
            return (
                plain(params, target_actor, target_critic, transitions, key)
                + settings.width**2 * extra
            )

        if settings.width:
            self._critic_loss_fn = loss

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> SlopedState:
        key, reset_key, cell_key, own_key = jax.random.split(key, 4)
        state = super().init(
            own_key, repertoire, genotypes, fitnesses, descriptors, extra_scores
        )
        settings = self._settings
        first = jax.vmap(self._smooth.reset)(
            jax.random.split(reset_key, settings.worlds)
        )
        cells = draw_cells(
            cell_key, repertoire.fitnesses[:, 0] > -jnp.inf, settings.worlds
        )
        worlds = Worlds(
            policies=jax.tree.map(lambda x: x[cells], repertoire.genotypes),
            desc=jax.vmap(self._normalize_desc)(repertoire.descriptors[cells]),
            first=first,
            states=first,
            age=jnp.arange(settings.worlds) * self._length // settings.worlds,
        )
        number = settings.windows * settings.worlds * settings.window
        zeros = jnp.zeros
        slopes = Slopes(
            obs=zeros((number, first.obs.shape[-1])),
            actions=zeros((number, self._env.action_size)),
            desc=zeros((number, descriptors.shape[-1])),
            slopes=zeros((number, self._env.action_size)),
            sound=zeros((number,), bool),
        )
        kept = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
        kept["replay_buffer"] = SlopedBuffer(steps=state.replay_buffer, slopes=slopes)
        return SlopedState(**kept, worlds=worlds)

    def state_update(
        self,
        emitter_state: SlopedState,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> SlopedState:
        key, noise_key, cell_key = jax.random.split(emitter_state.key, 3)
        emitter_state = emitter_state.replace(key=key)
        if self._settings.width:
            worlds, fresh = self._window(
                emitter_state, repertoire, noise_key, cell_key
            )
            buffer = emitter_state.replay_buffer
            number = len(fresh.sound)
            slopes = jax.tree.map(
                lambda old, new: jnp.concatenate([old[number:], new]),
                buffer.slopes,
                fresh,
            )
            emitter_state = emitter_state.replace(
                worlds=worlds, replay_buffer=buffer.replace(slopes=slopes)
            )
        return super().state_update(
            emitter_state, repertoire, genotypes, fitnesses, descriptors, extra_scores
        )

    def _window(self, state, repertoire, noise_key, cell_key):
        settings, worlds = self._settings, state.worlds
        shape = (settings.worlds, settings.window, self._env.action_size)
        noise = settings.noise * jax.random.normal(noise_key, shape)

        def total(changes):
            run = lambda *x: self._run(state.target_critic_params, *x)
            values, found = jax.vmap(run)(
                worlds.policies, worlds.desc, worlds.first, worlds.states, noise, changes
            )
            return values.sum(), found

        slopes, found = jax.grad(total, has_aux=True)(jnp.zeros(shape))
        last, obs, actions, dones = found
        sound = jnp.all(jnp.isfinite(slopes), axis=-1) & jnp.all(
            jnp.isfinite(obs), axis=-1
        )
        if settings.most:
            norm = jnp.linalg.norm(slopes, axis=-1, keepdims=True)
            slopes = slopes * jnp.minimum(1, settings.most / jnp.maximum(norm, 1e-9))
        slopes = jnp.where(sound[..., None], slopes, 0)
        obs = jnp.where(sound[..., None], obs, 0)
        actions = jnp.where(sound[..., None], actions, 0)
        desc = jnp.broadcast_to(
            worlds.desc[:, None], (*shape[:2], worlds.desc.shape[-1])
        )
        rows = Slopes(obs, actions, desc, slopes, sound)
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
        age = worlds.age + settings.window
        over = (
            (age >= self._length)
            | jnp.any(dones > 0, axis=1)
            | ~jnp.all(sound, axis=1)
            | ~jnp.all(jnp.isfinite(last.obs), axis=-1)
        )
        cells = draw_cells(
            cell_key, repertoire.fitnesses[:, 0] > -jnp.inf, settings.worlds
        )
        drawn = jax.tree.map(lambda x: x[cells], repertoire.genotypes)
        told = jax.vmap(self._normalize_desc)(repertoire.descriptors[cells])
        worlds = Worlds(
            policies=select(over, drawn, worlds.policies),
            desc=select(over, told, worlds.desc),
            first=worlds.first,
            states=select(over, worlds.first, last),
            age=jnp.where(over, 0, age),
        )
        return worlds, rows

    def _run(self, critic, policy, desc, first, state, noise, changes):
        settings, discount = self._settings, self._config.discount
        ends = jnp.arange(settings.window) == settings.window - 1

        def advance(state, row):
            noise, change, end = row
            factor = jnp.asarray(discount * settings.trace, jnp.float32)
            before = passed_back(state, factor, settings.clip)
            action = jnp.clip(self._policy(policy, before.obs) + noise, -1, 1)
            action = action + change
            after = self._smooth.step(before, action)
            reward = jnp.maximum(after.reward + self._offset, 0.0)
            reward = reward * self._config.reward_scaling
            q = self._critic_network.apply(
                critic, after.obs, self._policy(policy, after.obs), desc
            )
            value = jnp.min(q)
            part = jnp.where(end, 1.0, 1 - settings.trace)
            over = after.done > 0
            gain = reward + discount * jnp.where(over, 0.0, part * value)
            lost = jnp.where(jnp.isfinite(value), value, 0)
            gain = gain - discount * after.done * jax.lax.stop_gradient(lost)
            return select(over, first, after), (gain, before.obs, action, after.done)

        last, (gains, obs, actions, dones) = jax.lax.scan(
            advance, state, (noise, changes, ends)
        )
        return gains.sum(), jax.lax.stop_gradient((last, obs, actions, dones))
