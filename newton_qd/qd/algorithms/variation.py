"""The iso+line variation, which most algorithms use."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:
    from collections.abc import Callable

    from qdax.core.emitters.emitter import Emitter
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.types import Genotype, RNGKey


def isoline(
    config: EvolveConfig,
) -> Callable[[Genotype, Genotype, RNGKey], Genotype]:
    """Returns the iso+line variation (Vassiliades and Mouret 2018) of a run."""
    from qdax.core.emitters.mutation_operators import isoline_variation

    return functools.partial(
        isoline_variation, iso_sigma=config.iso_sigma, line_sigma=config.line_sigma
    )


def isoline_emitter(config: EvolveConfig, batch_size: int) -> Emitter:
    """Returns the emitter of iso+line variations of MAP-Elites."""
    if config.tournament > 1:
        from newton_qd.qd.emitters.tournament import TournamentEmitter

        return TournamentEmitter(
            isoline(config), batch_size=batch_size, tournament=config.tournament
        )
    from qdax.core.emitters.standard_emitters import MixingEmitter

    return MixingEmitter(
        mutation_fn=_no_mutation,
        variation_fn=isoline(config),
        variation_percentage=1.0,
        batch_size=batch_size,
    )


def with_isoline(emitter: Emitter, config: EvolveConfig, *others: Emitter) -> Emitter:
    """Completes a generation with iso+line variations.

    Args:
        emitter: Emitter of a part of a generation.
        config: Settings of the run.
        *others: Emitters of other parts.
    """
    from qdax.core.emitters.multi_emitter import MultiEmitter

    parts = [emitter, *others]
    rest = config.batch_size - sum(part.batch_size for part in parts)
    if rest:
        parts.append(isoline_emitter(config, rest))
    return MultiEmitter(tuple(parts)) if len(parts) > 1 else emitter


def with_own_isoline(emitter: MultiEmitter, config: EvolveConfig) -> MultiEmitter:
    """Returns an emitter of QDax with the iso+line variations of a run.

    QDax's emitters with a critic make their own, which have no tournament.

    Args:
        emitter: Emitter whose last part are iso+line variations.
        config: Settings of the run.
    """
    *others, last = emitter.emitters
    emitter.emitters = (*others, isoline_emitter(config, last.batch_size))
    return emitter


def part_of(config: EvolveConfig, share: float) -> int:
    """Returns the number of individuals that are a share of a generation, at most."""
    # rounded, because 0.29 * 100 is below 29
    return int(round(share * config.batch_size, 6))


def parents_in(config: EvolveConfig, share: float, branches: int) -> int:
    """Returns the number of parents whose offspring are a share of a generation.

    Args:
        config: Settings of the run.
        share: Option of this name: the share [-].
        branches: Option of this name: offspring of each parent.

    Raises:
        ConfigError: A generation is too small, or a value is out of its range.
    """
    checks.number("options: share", share, above=0, most=1, error=ConfigError)
    checks.integer("options: branches", branches, most=None, error=ConfigError)
    parents = part_of(config, share) // branches
    if parents < 1:
        least = f"{branches} / batch_size = {branches} / {config.batch_size}"
        allowed = f"at least {least}, the offspring of a parent"
        raise ConfigError(message("options: share", share, allowed))
    return parents


def _no_mutation(genotypes: Genotype, key: RNGKey) -> Genotype:
    del key
    return genotypes
