"""Actors that learn from whole episodes with gradients of the physics."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.envs.state import at_fault, select
from newton_qd.gradients.outcome import Tally
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic, Learner
from newton_qd.qd.emitters.ascent import limited_mean
from newton_qd.types import Environment, PyTree


@dataclasses.dataclass(frozen=True, eq=False)
class EpisodeLearning:
    r"""How actors go on after they have learnt over short windows.

    An actor follows the exact gradient of whole episodes, without a critic and without
    a limit of the adjoint. With the aim :math:`w`, it maximizes the mean over its
    worlds of

    .. math:: w \cdot \sum_t g_t (r_t, m_t), \qquad g_t = \prod_{s<t} (1 - d_s),

    where a fall ends the sum, and ``done`` may have a gradient
    (:func:`~newton_qd.gradients.with_smooth_termination`). If the descriptor is a mean
    over the T control steps of an episode, the sum of the measures is
    :math:`T \sum_t g_t m_t / \sum_t g_t` instead. So a fall changes it only as it
    changes the descriptor. Each world has weights of
    its own (Plappert et al. 2018, "Parameter space noise for exploration"), which makes
    the return smoother. Near a stiff contact, the gradient of one world can be much
    longer than those of the others, so long ones are shortened to the median norm
    (:func:`~newton_qd.qd.emitters.ascent.limited_mean`).

    Attributes:
        method: Learning method of the actors so far. Its worlds, noise of actions,
            optimizer and whitening are kept.
        env: Environment of one world without auto-reset.
        after: Generations after which actors learn from episodes.
        updates: Updates of each actor before each time that it produces offspring.
        weight_noise: Standard deviation of the noise of weights, in units of the
            genotype.
        averaged: Whether the descriptor is a mean over the steps of an episode.

    Raises:
        TypeError: A value has a wrong type.
        ValueError: A number is out of its range.
    """

    method: ActorCritic
    env: Environment
    after: int
    updates: int
    weight_noise: float
    averaged: bool = False

    def __post_init__(self) -> None:
        """Checks the arguments.

        Raises:
            TypeError: A value has a wrong type.
            ValueError: A number is out of its range.
        """
        checks.instance("method", self.method, ActorCritic, "an ActorCritic")
        checks.environment(self.env)
        checks.integer("after", self.after, least=0)
        checks.integer("updates", self.updates, most=None)
        checks.number("weight_noise", self.weight_noise, least=0)
        checks.flag("averaged", self.averaged)

    def update(
        self, learner: Learner, scale: tuple[jax.Array, jax.Array], key: jax.Array
    ) -> tuple[Learner, jax.Array]:
        """Runs one episode in each world, and makes one step of the actor.

        Args:
            learner: The actor. Its critic and the states of its worlds stay.
            scale: Mean and deviation of observations.
            key: Key of the noise.

        Returns:
            The actor after the step, and whether the gradients of all worlds were lost
            (). If they were, the actor does not change.
        """
        # else the gradient would be the sum over all devices
        learner, scale, key = varying_alike((learner, scale, key))

        def plain(weights: jax.Array) -> jax.Array:
            return self.method.whitening.plain(weights, scale)

        weights, pull = jax.vjp(plain, learner.weights)
        slopes, sound = self.slopes(weights, learner, key)
        (slope,) = pull(limited_mean(slopes[:, None], sound[:, None])[0])
        failed = ~jnp.any(sound) | ~jnp.all(jnp.isfinite(slope))
        optimizer, _ = self.method.optimizers
        change, moments = optimizer.update(-slope, learner.moments[0])
        learned = dataclasses.replace(
            learner,
            weights=learner.weights + change,
            moments=(moments, learner.moments[1]),
        )
        return select(failed, learner, learned), failed

    def slopes(
        self, weights: jax.Array, learner: Learner, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the gradients of the episodes of all worlds.

        Args:
            weights: (size,) weights for plain observations.
            learner: The actor, whose aim and initial states count.
            key: Key of the noise.

        Returns:
            Gradients (W, size), and whether an episode and its gradient are sound (W,);
            if not, the gradient is 0.
        """
        settings, number = self.method.settings, self.method.settings.worlds
        action_key, weight_key = jax.random.split(key)
        shape = (number, self.method.episode_length, self.env.action_size)
        noise = settings.noise * jax.random.normal(action_key, shape, weights.dtype)
        other = jax.random.normal(weight_key, (number, weights.size), weights.dtype)
        weights = weights + self.weight_noise * other
        worth = jax.value_and_grad(self._worth, has_aux=True)
        (values, faulty), slopes = jax.vmap(worth, in_axes=(0, None, 0, 0))(
            weights, learner.aim, learner.first, noise
        )
        finite = jnp.isfinite(values) & jnp.all(jnp.isfinite(slopes), axis=1)
        sound = finite & ~faulty
        return jnp.where(sound[:, None], slopes, 0), sound

    def _worth(
        self, weights: jax.Array, aim: jax.Array, first: PyTree, noise: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Returns what an episode is worth for an aim (), and whether it is faulty."""

        def advance(carry: PyTree, noise: jax.Array) -> tuple[PyTree, None]:
            state, tally, bad = carry
            action = self.method.policy(weights, state.obs) + noise
            after = self.env.step(state, jnp.clip(action, -1, 1))
            measures = self.method.measure(state, after)
            gains = jnp.concatenate([after.reward[None], measures, one[None]])
            bad = bad | (~tally.over & at_fault(after))
            return (after, tally.add(gains, after.done), bad), None

        one = jnp.ones((), noise.dtype)
        nothing = Tally(jnp.zeros(aim.size + 1, noise.dtype), one)
        begin = first, nothing, jnp.zeros((), bool)
        begin, weights, noise = varying_alike((begin, weights, noise))
        (_, tally, bad), _ = jax.lax.scan(advance, begin, noise)
        sums, steps = tally.fitness[:-1], tally.fitness[-1]
        if self.averaged:
            sums = sums.at[1:].multiply(len(noise) / steps)
        return sums @ aim, bad
