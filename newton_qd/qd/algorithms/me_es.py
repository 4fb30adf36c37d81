"""ME-ES of QDax."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.algorithms.critic_options import require_batch_size
from newton_qd.qd.algorithms.options import Options
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:
    import jax

    from newton_qd.types import ScoringFunction


@dataclasses.dataclass(frozen=True, kw_only=True)
class MEESOptions(Options):
    """Options of ME-ES (Colas et al. 2020); QDax's ``MEESConfig``.

    Attributes:
        sample_number: Samples for each gradient; ``--batch-size`` sets it.
        sample_sigma: Standard deviation of the samples, in units of policy weights
            [-].
        sample_mirror: Whether each sample has a mirror image.
        sample_rank_norm: Whether samples are weighted by their ranks.
        num_optimizer_steps: Generations after which a new parent is chosen.
        adam_optimizer: Whether to use Adam instead of plain gradient ascent.
        learning_rate: Learning rate [-].
        l2_coefficient: Weight of the penalty on large policy weights [-].
        novelty_nearest_neighbors: Number of nearest neighbours in the novelty.
        last_updated_size: Number of newest elites that can be parents.
        exploit_num_cell_sample: Number of fittest elites that can be parents.
        explore_num_cell_sample: Number of most novel elites that can be parents.
        use_explore: Whether some generations follow novelty.
        use_exploit: Whether some generations follow fitness.
    """

    sample_number: int | None = None
    sample_sigma: float = 0.02
    sample_mirror: bool = True
    sample_rank_norm: bool = True
    num_optimizer_steps: int = 10
    adam_optimizer: bool = True
    learning_rate: float = 0.01
    l2_coefficient: float = 0.02
    novelty_nearest_neighbors: int = 10
    last_updated_size: int = 5
    exploit_num_cell_sample: int = 2
    explore_num_cell_sample: int = 5
    use_explore: bool = True
    use_exploit: bool = True

    def check(self) -> None:
        """Checks that samples differ, and that generations follow something.

        Raises:
            ValueError: They do not.
        """
        checks.number("sample_sigma", self.sample_sigma, above=0)
        if not (self.use_explore or self.use_exploit):
            names, given = "use_explore, use_exploit", (False, False)
            raise ValueError(message(names, given, "at least one of them true"))


class _FromOne:
    """ME-ES with an initial population of any size; ME-ES itself starts from one."""

    def __init__(self, emitter: Any) -> None:
        self.emit = emitter.emit
        self.state_update = emitter.state_update
        self._emitter = emitter

    def init(self, key: jax.Array, genotypes: jax.Array, **told: Any) -> Any:
        """Returns the state before the second generation."""
        return self._emitter.init(key=key, genotypes=genotypes[:1], **told)


def _make(context: EmitterContext, options: MEESOptions) -> Any:
    """ME-ES: evolution strategies from elites (Colas et al. 2020).

    Raises:
        ConfigError: The options or the size of a generation do not fit together.
    """
    from qdax.core.emitters.mees_emitter import MEESConfig, MEESEmitter

    samples = context.config.batch_size
    require_batch_size(context.config, "sample_number", options.sample_number)
    if options.sample_mirror and samples % 2:
        allowed = "even numbers for 'me-es' with sample_mirror"
        raise ConfigError(message("batch_size", samples, allowed))
    _check_parents(options, len(context.centroids))
    emitter = MEESEmitter(
        MEESConfig(**{**dataclasses.asdict(options), "sample_number": samples}),
        # The novelty archive has one descriptor for each generation.
        total_generations=max(
            context.config.iterations + 1, options.novelty_nearest_neighbors
        ),
        scoring_fn=_neutral(context.score, finite=not options.sample_rank_norm),
        num_descriptors=context.task.descriptor_length,
    )
    return _FromOne(emitter)


def _neutral(score: ScoringFunction, *, finite: bool) -> ScoringFunction:
    """Returns a scoring function whose failed samples lead a search nowhere.

    The novelty of a NaN is a NaN, and would rank above all others.

    Args:
        score: Scoring function of the samples.
        finite: Whether fitnesses must be finite, because they are no ranks.

    Returns:
        The same function. A sample without a finite fitness and descriptor gets the
        mean descriptor of the others, and with ``finite`` their lowest fitness.
    """
    import jax.numpy as jnp

    from newton_qd.qd.scoring.gradient_scores import finite_scores

    def scored(
        genotypes: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, Any]]:
        fitnesses, found, extra = score(genotypes, key)
        sound = finite_scores(fitnesses, found)
        kept = jnp.where(sound[:, None], found, 0)
        mean = jnp.sum(kept, axis=0) / jnp.maximum(jnp.sum(sound), 1)
        if finite:
            lowest = jnp.min(jnp.where(sound, fitnesses, jnp.inf))
            lowest = jnp.where(jnp.any(sound), lowest, 0)
            fitnesses = jnp.where(sound, fitnesses, lowest)
        return fitnesses, jnp.where(sound[:, None], found, mean), extra

    return scored


def _check_parents(options: MEESOptions, cells: int) -> None:
    """Checks that parents are chosen from as many elites as there can be.

    Raises:
        ConfigError: They are not.
    """
    newest = min(cells, options.last_updated_size)
    # JAX traces both ways to choose a parent, also the one that is not used
    for name, most, why in (
        ("explore_num_cell_sample", cells, "the cells"),
        ("exploit_num_cell_sample", newest, "the cells, and last_updated_size"),
    ):
        given = getattr(options, name)
        if given > most:
            allowed = f"at most {most}: {why}"
            raise ConfigError(message(f"options: {name}", given, allowed))


def _evaluations(config: EvolveConfig, options: MEESOptions) -> int:
    """Returns the number of samples of a gradient, plus 1 for the new individual."""
    del options
    return config.batch_size + 1


ME_ES = AlgorithmSpec(
    name="me-es",
    summary="ME-ES: evolution strategies that start from elites; `--batch-size` is the "
    "number of samples for each gradient",
    make=_make,
    options=MEESOptions,
    varies=False,
    least=1,
    evaluates=True,
    evaluations=_evaluations,
    smallest=2,
    double=False,
    goes_on=False,  # the size of the novelty archive
)
