"""The algorithms of ``evolve`` that follow gradients through the physics."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

from newton_qd.gradients.exact import make_directional_gradient, make_episode_gradient
from newton_qd.gradients.flow import GradientOptions
from newton_qd.gradients.mixed import make_mixed_gradient
from newton_qd.gradients.smooth import with_smooth_descriptor
from newton_qd.qd.actor_critic import ActorCritic, ActorCriticSettings, measure_of
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.gradient_scoring import make_gradient_scoring_function
from newton_qd.qd.parts import Algorithm, Parts, isoline_emitter, settings
from newton_qd.qd.rollout import Policy, ScoringFunction
from newton_qd.qd.task import Task

# A robot that falls ends its episode, which no gradient sees: short steps only.
_FALLS: Mapping[str, Any] = {"shortest": 0.0005, "longest": 0.02, "sigma_g": 0.02}

TUNED: Mapping[str, Mapping[str, Any]] = {
    # Its return is chaotic after some ten control steps.
    "halfcheetah_uni": {"window": 10, "clip": 0.0, "longest": 1.0},
    "hopper_uni": _FALLS,
    "walker2d_uni": _FALLS,
    "humanoid_uni": _FALLS,
    "humanoid_omni": _FALLS,
    "humanoidtrap": _FALLS,
}
"""Defaults of options that differ for an environment."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlowOptions:
    """How gradients come about; every algorithm here has these options.

    Attributes:
        window: Control steps after which the gradient is cut; 0: never.
        clip: Largest norm of the adjoint of a state; 0: no limit.
        discount: Factor of the adjoint for each control step that it goes back [-].
        smooth_width: Share of a robot's weight over which the reading of a foot has a
            gradient [-]; its value stays 0 or 1.
        initial_scale: Factor of the weights of the initial population [-]: small
            feedback keeps gradients small over more control steps.
    """

    window: int = 0
    clip: float = 10.0
    discount: float = 1.0
    smooth_width: float = 0.1
    initial_scale: float = 1.0

    def flow(self) -> GradientOptions:
        """The options of a gradient, in the fastest way, that keeps intermediates.

        Raises:
            ValueError: A value is out of its range.
        """
        return GradientOptions(
            window=self.window or None,
            clip=self.clip or None,
            discount=self.discount,
            checkpoint_every=None,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class MixedOptions(FlowOptions):
    """Options of algorithms that need the gradient of every component.

    Attributes:
        samples: Pairs of samples of the mixed gradient of first and zeroth order; 0:
            the exact gradient.
        noise: Standard deviation of these samples, in units of policy weights [-].
    """

    samples: int = 0
    noise: float = 0.02

    @property
    def estimator(self) -> Any:
        """Builds the gradient, as ``make_gradient_scoring_function`` wants it."""
        if not self.samples:
            return make_episode_gradient
        return functools.partial(
            make_mixed_gradient, samples=self.samples, sigma=self.noise
        )

    @property
    def episodes(self) -> int:
        """Episodes that are differentiated for one gradient."""
        return 2 * self.samples or 1


def _tuned(kind: Any, config: EvolveConfig) -> Any:
    """Options of a run, with the defaults of its environment."""
    names = {field.name for field in dataclasses.fields(kind)}
    tuned = TUNED.get(config.env_name, {}).items()
    return settings(kind, config, **{k: v for k, v in tuned if k in names})


def _options(kind: Any, config: EvolveConfig) -> Any:
    """Options of a run that differentiates whole episodes, checked.

    Raises:
        ConfigError: There is no option of this name, or its value is not allowed.
    """
    options = _tuned(kind, config)
    try:
        options.flow()
    except (TypeError, ValueError) as error:
        raise ConfigError(f"options: {error}") from error
    return options


def _differentiable(task: Task, options: FlowOptions | ActorCriticOptions) -> Task:
    """The task with a descriptor of the same values that has a gradient."""
    env = with_smooth_descriptor(task.env, options.smooth_width, straight_through=True)
    return dataclasses.replace(task, env=env)


def _scoring(
    options: MixedOptions, config: EvolveConfig, task: Task, policy: Policy
) -> ScoringFunction:
    """Scores with the gradients of fitness and descriptor."""
    return make_gradient_scoring_function(
        _differentiable(task, options),
        policy,
        config.episode_length,
        options.flow(),
        estimator=options.estimator,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class MEGradientOptions(FlowOptions):
    """Options of MAP-Elites with gradient variations.

    Attributes:
        share: Share of a generation that follows gradients [-]; the rest are iso+line
            variations.
        branches: Offspring along each gradient.
        shortest: Shortest step, in units of policy weights [-].
        longest: Longest step.
        steered: Share of the parents that steer towards empty cells [-]; the others
            climb their fitness.
    """

    share: float = 0.5
    branches: int = 4
    shortest: float = 0.02
    longest: float = 0.5
    steered: float = 0.5

    def parents(self, config: EvolveConfig) -> int:
        """Parents of a generation whose gradient is evaluated.

        Raises:
            ConfigError: A generation is too small, or a value out of its range.
        """
        if not 0 < self.share <= 1:
            raise ConfigError(f"options: share must be in (0, 1], got {self.share!r}")
        if self.branches < 1:
            raise ConfigError(
                f"options: branches must be at least 1, got {self.branches!r}"
            )
        parents = int(self.share * config.batch_size) // self.branches
        if parents < 1:
            raise ConfigError(
                f"options: share = {self.share} of batch_size = {config.batch_size} "
                f"holds no parent with branches = {self.branches} offspring"
            )
        return parents


def _me_gradient(parts: Parts) -> Any:
    """MAP-Elites in which a share of the offspring lies along gradients of elites."""
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.qd.emitters.gradient_line import GradientLineEmitter

    config = parts.config
    options = _options(MEGradientOptions, config)
    task = _differentiable(parts.task, options)
    gradient = make_directional_gradient(
        task.env,
        parts.policy.apply,
        task.descriptor_extractor,
        episode_length=config.episode_length,
        unravel=parts.policy.unravel,
        options=options.flow(),
    )
    parents = options.parents(config)
    emitter = GradientLineEmitter(
        lambda genotypes, ways, _: gradient(genotypes, ways, parts.reset_key),
        parents=parents,
        branches=options.branches,
        shortest=options.shortest,
        longest=options.longest,
        steered=options.steered,
    )
    rest = config.batch_size - emitter.batch_size
    if not rest:
        return emitter
    return MultiEmitter((emitter, isoline_emitter(config, rest)))


def _me_gradients(config: EvolveConfig) -> int:
    return _options(MEGradientOptions, config).parents(config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticOptions(ActorCriticSettings):
    """Options of MAP-Elites with actors that learn by the gradient of the physics.

    Attributes:
        actors: Number of actors.
        branches: Times in a generation that actors have offspring.
        copies: Offspring of an actor then; the rest of the generation are iso+line
            variations.
        updates: Updates of an actor between two of these times.
        steered: Share of the actors that follow directions of the descriptor [-].
        fitness: Weight of the reward of these [-].
        lifetime: Generations after which these begin again.
        smooth_width: As in ``FlowOptions``.
        initial_scale: As in ``FlowOptions``.
    """

    actors: int = 2
    branches: int = 2
    copies: int = 8
    updates: int = 1
    steered: float = 0.5
    fitness: float = 0.1
    lifetime: int = 10
    smooth_width: float = 0.1
    initial_scale: float = 1.0

    def episodes(self, config: EvolveConfig) -> int:
        """Episodes that the control steps of a generation's updates amount to."""
        updates = self.actors * self.branches * self.updates
        return -(-updates * self.worlds * self.window // config.episode_length)


def _me_actor_critic(parts: Parts) -> Any:
    """MAP-Elites with the policies of actors that learn over short horizons."""
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.qd.emitters.actor_critic import ActorCriticEmitter

    config, policy = parts.config, parts.policy
    options = _tuned(ActorCriticOptions, config)
    task = _differentiable(parts.task, options)
    method = ActorCritic(
        task.env,
        lambda weights, obs: policy.apply(policy.unravel(weights), obs),
        measure_of(task),
        config.episode_length,
        options,
    )
    emitter = ActorCriticEmitter(
        method,
        task.env.reset(parts.reset_key),
        actors=options.actors,
        branches=options.branches,
        copies=options.copies,
        updates=options.updates,
        steered=options.steered,
        fitness=options.fitness,
        lifetime=options.lifetime,
        measures=task.descriptor_length,
    )
    rest = config.batch_size - emitter.batch_size
    if rest < 0:
        raise ConfigError(
            f"options: actors = {options.actors} times branches = {options.branches} "
            f"times copies = {options.copies} are more than batch_size = "
            f"{config.batch_size}"
        )
    if not rest:
        return emitter
    return MultiEmitter((emitter, isoline_emitter(config, rest)))


def _actor_critic_episodes(config: EvolveConfig) -> int:
    return _tuned(ActorCriticOptions, config).episodes(config)


def _actor_critic_scale(config: EvolveConfig) -> float:
    return _tuned(ActorCriticOptions, config).initial_scale


@dataclasses.dataclass(frozen=True, kw_only=True)
class OMGMEGAOptions(MixedOptions):
    """Options of OMG-MEGA.

    Attributes:
        sigma_g: Standard deviation of the coefficients of the normalized gradients, in
            units of policy weights [-].
    """

    sigma_g: float = 0.1


def _omg_mega(parts: Parts) -> Any:
    """OMG-MEGA: random steps along all gradients of elites."""
    from newton_qd.qd.emitters import OMGMEGAEmitter

    options = _options(OMGMEGAOptions, parts.config)
    return OMGMEGAEmitter(parts.config.batch_size, options.sigma_g)


def _omg_mega_scoring(
    config: EvolveConfig, task: Task, policy: Policy
) -> ScoringFunction:
    return _scoring(_options(OMGMEGAOptions, config), config, task, policy)


def _omg_mega_gradients(config: EvolveConfig) -> int:
    return config.batch_size * _options(OMGMEGAOptions, config).episodes


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMEGAOptions(MixedOptions):
    """Options of CMA-MEGA.

    Attributes:
        points: Solution points, among which a generation is divided.
        sigma_g: Initial standard deviation of the coefficients of the normalized
            gradients, in units of policy weights [-].
        adam: Learning rate of Adam [-]; 0: points move to the weighted mean of their
            best offspring.
        restart_period: Restart a point after this many generations in any case; 0:
            by its restart rule alone.
    """

    points: int = 4
    sigma_g: float = 0.1
    adam: float = 0.0
    restart_period: int = 0

    def population(self, config: EvolveConfig) -> int:
        """Individuals of a generation that belong to one solution point.

        Raises:
            ConfigError: The points do not divide a generation.
        """
        if self.points < 1 or config.batch_size % self.points:
            raise ConfigError(
                f"options: points must divide batch_size = {config.batch_size}, got "
                f"{self.points!r}"
            )
        return config.batch_size // self.points


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMAEGAOptions(CMAMEGAOptions):
    """Options of CMA-MAEGA.

    Attributes:
        learning_rate: Rate at which the threshold of a cell rises, 0 to 1 [-].
    """

    learning_rate: float = 0.01


def _arborescence(kind: Any, options: CMAMEGAOptions, parts: Parts) -> Any:
    """An emitter of solution points with the options of a run."""
    import optax

    config = parts.config
    score = _scoring(options, config, parts.task, parts.policy)
    return kind(
        lambda genotypes, _: score(genotypes, parts.reset_key),
        sigma_g=options.sigma_g,
        batch_size=options.population(config),
        num_emitters=options.points,
        optimizer=optax.adam(options.adam) if options.adam else None,
        restart_period=options.restart_period or None,
    )


def _cma_mega(parts: Parts) -> Any:
    """CMA-MEGA: CMA-ES searches for steps along the gradients of solution points."""
    from newton_qd.qd.emitters import CMAMEGAEmitter

    options = _options(CMAMEGAOptions, parts.config)
    return _arborescence(CMAMEGAEmitter, options, parts)


def _cma_maega(parts: Parts) -> Any:
    """CMA-MAEGA: the same on an annealed archive."""
    from newton_qd.qd.emitters import CMAMAEGAEmitter
    from newton_qd.qd.emitters.annealed import OnAnnealedRepertoire

    options = _options(CMAMAEGAOptions, parts.config)
    return OnAnnealedRepertoire(
        _arborescence(CMAMAEGAEmitter, options, parts),
        learning_rate=options.learning_rate,
        # The worst return that the QD score counts as positive.
        threshold_min=-parts.task.reward_offset * parts.config.episode_length,
    )


def _checked(make: Callable[[Parts], Any]) -> Callable[[Parts], Any]:
    """Makes an emitter; a value that it refuses is a wrong setting."""

    def made(parts: Parts) -> Any:
        try:
            return make(parts)
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(f"options: {error}") from error

    return made


def _points(kind: Any, config: EvolveConfig) -> int:
    options = _options(kind, config)
    return options.points * options.episodes


def _scale(kind: Any, config: EvolveConfig) -> float:
    return _options(kind, config).initial_scale


def _row(make: Any, kind: Any) -> Algorithm:
    """A row for an emitter that evaluates the gradients of its solution points."""
    return Algorithm(
        _checked(make),
        evaluations=lambda config: config.batch_size + _points(kind, config),
        gradients=functools.partial(_points, kind),
        takes_faulty=True,
        initial_scale=functools.partial(_scale, kind),
    )


GRADIENT_ALGORITHMS: Mapping[str, Algorithm] = {
    "me-gradient": Algorithm(
        _checked(_me_gradient),
        evaluations=lambda config: config.batch_size + _me_gradients(config),
        gradients=_me_gradients,
        initial_scale=functools.partial(_scale, MEGradientOptions),
    ),
    "me-actor-critic": Algorithm(
        _checked(_me_actor_critic),
        evaluations=lambda config: config.batch_size + _actor_critic_episodes(config),
        gradients=_actor_critic_episodes,
        initial_scale=_actor_critic_scale,
    ),
    "omg-mega": Algorithm(
        _checked(_omg_mega),
        evaluations=_omg_mega_gradients,
        gradients=_omg_mega_gradients,
        scoring=_omg_mega_scoring,
        takes_faulty=True,
        initial_scale=functools.partial(_scale, OMGMEGAOptions),
    ),
    "cma-mega": _row(_cma_mega, CMAMEGAOptions),
    "cma-maega": _row(_cma_maega, CMAMAEGAOptions),
}
"""Their rows of the table of algorithms."""
