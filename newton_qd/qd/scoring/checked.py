"""Checks of scores, and of what an algorithm of a user gives to the search."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.gradients.outcome import Outcome
from newton_qd.qd.config import ConfigError
from newton_qd.types import ExtraScores, Genotype, RNGKey, ScoringFunction


def checked_scoring(
    score: ScoringFunction, algorithm: str, measures: int
) -> ScoringFunction:
    """Returns a scoring function whose results have the right shapes.

    JAX would broadcast a descriptor of another length into the archive.

    Args:
        score: Scoring function of an algorithm.
        algorithm: Name of the algorithm, for the error.
        measures: Length D of the descriptor.

    Returns:
        The same function. It raises ``ConfigError`` if the results are not fitnesses
        (N,), descriptors (N, D) and a dictionary.

    Raises:
        TypeError: ``score`` cannot be called.
    """
    name = f"scoring function of {algorithm!r}"
    checks.function(name, score, "a function of genotypes and a key")

    def scored(
        genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        found = score(genotypes, key)
        number = len(jax.tree.leaves(genotypes)[0])
        check_scores(name, found, number, measures, error=ConfigError)
        return found

    return scored


def check_scores(
    name: str,
    found: object,
    number: int,
    measures: int | None = None,
    *,
    error: type[ValueError] = ValueError,
) -> None:
    """Checks the results of a scoring function.

    Args:
        name: Name of the function.
        found: Its results: fitnesses (N,), descriptors (N, D) and a dictionary.
        number: Number N of individuals.
        measures: Length D of the descriptor; ``None``: any.
        error: Type of the error.

    Raises:
        ValueError: They have other types or shapes; or another ``error``.
    """
    allowed = "fitnesses (N,), descriptors (N, D) and a dictionary"
    if not isinstance(found, tuple) or len(found) != 3:
        count = f" of {len(found)}" if isinstance(found, tuple) else ""
        given = Fact(f"a {type(found).__name__}{count}")
        raise error(message(name, given, allowed))
    fitnesses, descriptors, extra = found
    if measures is None and len(jnp.shape(descriptors)) == 2:
        measures = jnp.shape(descriptors)[1]
    for what, values, shape in (
        ("fitnesses", fitnesses, (number,)),
        ("descriptors", descriptors, (number, "D" if measures is None else measures)),
    ):
        if jnp.shape(values) != shape:
            given = Fact(f"shape {jnp.shape(values)}")
            wanted = f"shape {shape}".replace("'", "")
            raise error(message(f"{name}: {what}", given, wanted))
    if not isinstance(extra, dict):
        given = Fact(f"a {type(extra).__name__} in the last place")
        raise error(message(name, given, allowed))


def check_genotypes(
    genotypes: jax.Array, algorithm: str, number: int | None, size: int
) -> None:
    """Checks what an emitter proposes.

    Args:
        genotypes: The individuals.
        algorithm: Name of the algorithm, for the error.
        number: Individuals of a generation; ``None``: any.
        size: Weights of each.

    Raises:
        ConfigError: They have another shape.
    """
    shape = genotypes.shape
    if len(shape) != 2 or shape[0] != (number or shape[0]) or shape[1] != size:
        name, given = f"emitter of {algorithm!r}", f"genotypes of shape {shape}"
        rows = "N" if number is None else number
        allowed = f"({rows}, {size}): batch_size individuals, and the weights of each"
        raise ConfigError(message(name, Fact(given), allowed))


def why_empty(found: Outcome, own: str | None) -> str:
    """Returns the text of the error about individuals that no archive takes.

    Args:
        found: Their episodes, leaves (N, ...).
        own: Name of the algorithm, if it has a scoring function of its own.
    """
    returns = ~np.isfinite(np.asarray(found.reward_sum))
    descriptors = ~np.isfinite(np.asarray(found.descriptor)).all(axis=-1)
    faults = np.asarray(found.faulty) & ~returns & ~descriptors
    if own is not None and not (returns | descriptors | faults).all():
        return (
            f"the scoring function of {own!r} gives no individual of the initial "
            "population a finite fitness and descriptor"
        )
    return (
        "no individual of the initial population has a finite return and "
        f"descriptor: of {len(returns)} individuals, the return is not finite in "
        f"{returns.sum()}, the descriptor is not finite in {descriptors.sum()}, "
        f"and the physics had a fault in {faults.sum()}"
    )
