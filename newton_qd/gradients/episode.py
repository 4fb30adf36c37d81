"""Episodes of an environment: their results and the gradients of these results."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.env import Env
from newton_qd.envs.inputs import require_key
from newton_qd.envs.state import at_fault, select
from newton_qd.extractors import check_extractor
from newton_qd.gradients import episode_input
from newton_qd.gradients.compiled import compiled_once, without_compiled
from newton_qd.gradients.exact import EpisodeGradient, EpisodeGradients, differentiate
from newton_qd.gradients.flow import EXACT, GradientOptions, passed_back, scan_keeping
from newton_qd.gradients.mixed import (
    MixedGradients,
    check_mixture,
    mixed_gradients,
)
from newton_qd.gradients.outcome import Outcome, Tally, finished, transition
from newton_qd.gradients.plans import run_plan
from newton_qd.gradients.scores import gradient_scores, scores
from newton_qd.moved import moved_name
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.types import (
    DescriptorExtractor,
    Environment,
    ExtraScores,
    Genotype,
    Params,
    PolicyFunction,
    PyTree,
    RNGKey,
    ScoringFunction,
    StateLike,
)

_MOVED = {
    "make_episode": "newton_qd.gradients.make_episode",
}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)


Start: TypeAlias = RNGKey | StateLike
"""Start of an episode: a key of the reset, or a state of one world."""

_Same = TypeVar("_Same")


def itself(genotype: _Same) -> _Same:
    """Returns the genotype: its parameters are the genotype itself."""
    return genotype


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """One episode of an environment with a policy, and its gradients.

    Every method is a pure function and works with ``jax.jit`` and ``jax.vmap``. Outside
    of ``jax.jit``, the first call of a method compiles it. An episode is immutable. It
    compares and hashes by identity, so it can be a static argument of jitted functions.
    A call runs one world. It is differentiable with respect to the genotype, the
    initial state and the physical parameters of the world, and sees the end of the
    episode where ``done`` has a gradient: see
    :func:`~newton_qd.gradients.with_smooth_termination`. The other methods take N
    genotypes, a pytree with leaves (N, ...). All N episodes have the same start.

        episode = Episode(env, policy, extractor, episode_length=100)
        outcome = episode(genotype, key)
        found = jax.jit(episode.gradient)(genotypes, key)
        score = jax.jit(episode.scoring(episode.gradient))

    Attributes:
        env: Environment of one world without auto-reset. A descriptor needs
            ``info["state_descriptor"]``, and its gradient needs a smooth one: see
            :func:`~newton_qd.gradients.with_smooth_descriptor`.
        policy: Maps parameters and an observation to an action; ``None``: the
            parameters are the actions, (episode_length, nu) or as many numbers in
            another shape.
        descriptor_extractor: Maps ``(data, mask)`` to descriptors (1, D), with
            ``data.state_desc`` (1, T, nd) and ``mask`` (1, T) equal to 1 after the
            end of the episode. ``newton_qd.tables.descriptor_extractor`` has the
            extractors of tasks. ``None``: the descriptor is empty, and only the fitness
            has a gradient.
        episode_length: Control steps. Rewards count up to the first ``done``.
        options: Windows, clipping, discounting and memory of the gradient. By default
            it is exact, and the way back stores one state per control step. Options
            never change the value of the episode.
        unravel: Maps a genotype to the parameters, once per episode.
        transitions: Whether to return the steps, for algorithms that learn from them.
            If an episode ends early, another one then follows. It has no effect on
            fitness and descriptor.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``episode_length`` is not an integer from 1, or above that of the
            environment, or the extractor is for another state descriptor.
    """

    env: Environment
    policy: PolicyFunction | None = None
    descriptor_extractor: DescriptorExtractor | None = None
    _: dataclasses.KW_ONLY
    episode_length: int
    options: GradientOptions = EXACT
    unravel: Callable[[Genotype], PyTree] = itself
    transitions: bool = False

    def __post_init__(self) -> None:
        """Checks every value."""
        checks.integer("episode_length", self.episode_length)
        checks.environment(self.env)
        for name, needed in (
            ("policy", "a function of parameters and an observation"),
            ("descriptor_extractor", "a function of transitions and a mask"),
            ("unravel", "a function of a genotype"),
        ):
            optional = name != "unravel"
            checks.function(name, getattr(self, name), needed, optional=optional)
        check_extractor(self.env, self.descriptor_extractor)
        episode_input.check_length(self.env, self.episode_length)
        checks.instance("options", self.options, GradientOptions, "GradientOptions")
        checks.flag("transitions", self.transitions)

    def __getstate__(self) -> dict[str, Any]:
        """Returns what pickle stores."""
        return without_compiled(self.__dict__)

    @compiled_once
    def __call__(
        self, genotype: Genotype, start: Start, params: Params = None, /
    ) -> Outcome:
        """Runs the episode in one world.

        Args:
            genotype: Genotype of the policy, or the actions.
            start: Key of the reset, or the initial state.
            params: Physical parameters of the world; ``None``: the default ones.

        Raises:
            TypeError: ``start`` is neither a key nor a state.
            ValueError: ``start`` is several keys or a state of several worlds or of
                another precision, it has no state descriptor but a descriptor is
                extracted, or there is no policy and the genotype is not a plan of
                actions.
        """
        parameters = self.unravel(genotype)
        is_key = isinstance(start, (jax.Array, np.ndarray))
        if is_key and isinstance(self.env, Env):
            require_key("start", start)
        first: Any = self.env.reset(start) if is_key else start
        described = self.descriptor_extractor is not None or self.transitions
        episode_input.check_first(self.env, first, described)
        kept = self.options.exact and self.options.checkpoint_every in (None, 1)
        if self.policy is None and kept and not self.transitions:
            if isinstance(self.env, Env):
                described = self.descriptor_extractor is not None
                plan = self._plan(parameters)
                ran = run_plan(self.env, first, plan, params, described=described)
                return finished(self.descriptor_extractor, *ran, {})
        dtype, steps = first.reward.dtype, self.episode_length
        rows: dict[str, jax.Array | np.ndarray] = {}
        if not self.options.exact:
            rows["factor"] = self.options.factors(steps).astype(dtype)
        if self.policy is None:
            rows["action"] = self._plan(parameters)
        no = jnp.zeros((), bool)
        likes = [x for x in jax.tree.leaves((parameters, first, params)) if x.size]
        carry = split_as(likes, (first, Tally.zero(dtype), no))
        (_, tally, bad), (readings, over, taken) = scan_keeping(
            functools.partial(self._advance, parameters, carry[0], params),
            carry,
            rows,
            steps,
            self.options.checkpoint_every,
        )
        fitness = tally.fitness
        return finished(self.descriptor_extractor, fitness, readings, over, bad, taken)

    @compiled_once
    def gradient(
        self, genotypes: Genotype, start: Start, params: Params = None
    ) -> EpisodeGradients:
        """Runs N episodes, with the gradients of fitness and descriptor.

        All rows of the Jacobian go back through the episode together: one launch of the
        physics' adjoint has N (1 + D) worlds. The values are bitwise equal to those of
        the episode without gradients.

        Args:
            genotypes: Leaves (N, ...).
            start: One key of the reset, or one state, for all episodes.
            params: Physical parameters of all worlds; ``None``: the default ones.

        Raises:
            TypeError: ``start`` is neither a key nor a state.
            ValueError: ``start`` or a genotype is wrong, as in a call of the episode.
        """
        episode_input.check_genotypes(genotypes)
        axes = (0, None, None, None)
        return jax.vmap(self._differentiated, axes)(genotypes, None, start, params)

    @compiled_once
    def directional(
        self,
        genotypes: Genotype,
        weights: jax.Array,
        start: Start,
        params: Params = None,
    ) -> EpisodeGradients:
        """Runs N episodes, with the gradients of weighted sums of their results.

        The result is that of :meth:`gradient` multiplied by weights. (With ``clip`` it
        is not: then the adjoint of a weighted sum is clipped.) It costs only as many
        rows as there are sums: one launch of the physics' adjoint has N R worlds.

        Args:
            genotypes: Leaves (N, ...).
            weights: (N, R, 1 + D) weights, first of the fitness, then of each component
                of the descriptor.
            start: One key of the reset, or one state, for all episodes.
            params: Physical parameters of all worlds; ``None``: the default ones.

        Returns:
            Gradients with one row per sum, leaves (N, R, ...), and ``overflowed``
            (N, R).

        Raises:
            TypeError: ``start`` is neither a key nor a state.
            ValueError: ``start`` or a genotype is wrong, as in a call of the episode,
                or ``weights`` have another shape.
        """
        episode_input.check_weights(genotypes, weights)
        axes = (0, 0, None, None)
        return jax.vmap(self._differentiated, axes)(genotypes, weights, start, params)

    @compiled_once
    def mixed(
        self,
        genotypes: Genotype,
        key: RNGKey,
        params: Params = None,
        *,
        samples: int = 16,
        sigma: float = 0.02,
        tolerance: float = math.inf,
        noise_by_genotype: bool = False,
    ) -> MixedGradients:
        """Runs N episodes, with gradients of first and zeroth order under noise.

        It estimates the gradient of the mean of f(x + w), where w is normal noise with
        standard deviation ``sigma``. The estimate is alpha times the mean gradient of
        the samples plus (1 - alpha) times the mean of (f(x + w) - f(x - w)) w /
        (2 sigma^2), in pairs of w and -w. Alpha follows from the inverse variances of
        the two. It is smaller if the two differ by more than the tolerance. This is the
        alpha-order gradient of Suh et al. 2022, "Do differentiable simulators give
        better policy gradients?". Its error bound of the zeroth order is here the
        standard error.

        Args:
            genotypes: Leaves (N, ...).
            key: Key of the shared reset and of the noise.
            params: Physical parameters of all worlds; ``None``: the default ones.
            samples: Pairs of samples for each genotype, at least 2. One launch has
                2 N ``samples`` worlds.
            sigma: Standard deviation of the noise, in the units of the genotype.
            tolerance: Allowed error of the estimate if first and zeroth order disagree,
                in units of the gradient. Infinite: only inverse variances count. Then a
                wrong first order with little noise gets a large weight.
            noise_by_genotype: Whether the noise of an individual follows from the key
                and its genotype, not from its place. A search whose key stays the same
                then has other noise for each new genotype.

        Raises:
            TypeError: A setting has the wrong type, or ``key`` is not a key.
            ValueError: A setting is out of its range, or a genotype is wrong, as in a
                call of the episode.
        """
        episode_input.check_genotypes(genotypes)
        check_mixture(samples, sigma, tolerance)
        checks.flag("noise_by_genotype", noise_by_genotype)
        require_key("key", key)
        return mixed_gradients(
            jax.vmap(self, (0, None, None))(genotypes, key, params),
            lambda around: self.gradient(around, key, params),
            genotypes,
            jax.random.fold_in(key, 1),
            samples=samples,
            sigma=sigma,
            tolerance=tolerance,
            noise_by_genotype=noise_by_genotype,
        )

    def scoring(self, gradient: EpisodeGradient | None = None) -> ScoringFunction:
        """Returns the episode as QDax's scoring function, for any algorithm of QDax.

        Args:
            gradient: Maps genotypes and a key to gradients: :meth:`gradient`, or
                ``functools.partial(episode.mixed, sigma=0.05)``; ``None``: no
                gradients.

        Returns:
            Function of genotypes, leaves (N, ...), and one key of the reset. It returns
            fitnesses (N,), descriptors (N, D) and a dictionary. The fitness is ``-inf``
            if the world had a fault. With gradients, the dictionary contains:
            ``gradients``, every leaf of the genotypes with an axis 1 + D at the end,
            first the fitness; ``normalized_grads``, the same with Euclidean norm 1 over
            a genotype (0 stays 0); ``faulty`` (N,) and ``overflowed`` (N, 1 + D), which
            mark gradients that were set to 0. Without gradients, it contains
            ``transitions`` if the episode returns them: the fields of QDax's
            ``QDTransition`` by name, (N, T, ...).

        Raises:
            TypeError: ``gradient`` is not a function.
        """
        if gradient is None:
            return self._score
        checks.function("gradient", gradient, "a method that returns gradients")
        return lambda genotypes, key: gradient_scores(gradient(genotypes, key))

    @compiled_once
    def _score(
        self, genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        """Returns fitnesses (N,), descriptors (N, D), and transitions, if any."""
        episode_input.check_genotypes(genotypes)
        return scores(jax.vmap(self, (0, None))(genotypes, key))

    def _differentiated(
        self,
        genotype: Genotype,
        weights: jax.Array | None,
        start: Start,
        params: Params,
    ) -> EpisodeGradients:
        """Returns one episode with gradients of R sums; ``None``: of all components."""
        return differentiate(lambda x: self(x, start, params), genotype, weights)

    def _plan(self, parameters: PyTree) -> jax.Array:
        """Returns open-loop actions (episode_length, nu).

        Raises:
            ValueError: The parameters are not a plan of actions.
        """
        shape = (self.episode_length, self.env.action_size)
        found = jax.tree.leaves(parameters)
        if len(found) != 1 or np.size(found[0]) != math.prod(shape):
            shapes = [str(np.shape(leaf)) for leaf in found]
            given = Fact(f"shape {checks.listed(shapes, 'none')}")
            allowed = f"actions of shape {shape} for each world"
            raise ValueError(message("genotype", given, allowed))
        return jnp.asarray(found[0]).reshape(shape)

    def _advance(
        self,
        parameters: PyTree,
        first: StateLike,
        params: Params,
        carry: tuple[Any, Tally, jax.Array],
        row: dict[str, jax.Array],
    ) -> tuple[tuple, tuple]:
        """Runs one control step; carries the state, the fitness so far, and faults."""
        begin, tally, bad = carry
        state = begin
        if "factor" in row:
            state = passed_back(state, row["factor"], self.options.clip)
            going = passed_back(tally.going, row["factor"], None)  # slope of done
            tally = dataclasses.replace(tally, going=going)
        if self.policy is None:
            action = row["action"]
        else:
            action = self.policy(parameters, state.obs)
        # the step of a user's environment may have no parameters
        step: Callable[..., StateLike] = self.env.step
        state = step(state, action) if params is None else step(state, action, params)
        state = split_as([begin.reward], state)
        steps = transition(begin, action, state) if self.transitions else {}
        over, tally = tally.over, tally.add(state.reward, state.done)
        bad = bad | (~over & at_fault(state))
        reading = None
        if self.descriptor_extractor is not None:
            reading = begin.info["state_descriptor"]
        if self.transitions:
            state = select(state.done > 0, first, state)
        return (state, tally, bad), (reading, over, steps)
