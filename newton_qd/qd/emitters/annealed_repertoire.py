"""An archive with a threshold in each cell that rises slowly."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    get_cells_indices,
)

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.emitters.cells import break_ties
from newton_qd.types import ExtraScores, Genotype


class AnnealedRepertoire(MapElitesRepertoire, kw_only=True):
    r"""Repertoire of CMA-MAE and CMA-MAEGA, together with an elitist archive.

    An individual with fitness f enters its cell if f is above the threshold t of the
    cell. The fitness of the elite does not matter. Then

    .. math:: t \leftarrow (1 - \alpha) t + \alpha f

    with the learning rate alpha. If k individuals of one batch are above t,

    .. math:: t \leftarrow (1 - \alpha)^k t + (1 - (1 - \alpha)^k) \bar f

    with their mean fitness, and the best of them enters (Fontaine & Nikolaidis,
    "Covariance Matrix Adaptation MAP-Annealing", GECCO 2023). A worse individual may
    replace an elite. ``result`` has the best individuals, so report its metrics:
    ``metrics_function=lambda repertoire: default_qd_metrics(repertoire.result, 0.0)``.

    Individuals whose fitness or descriptor is not finite never enter.

    Attributes:
        thresholds: (cells,) fitness above which an individual enters.
        result: The elitist archive: the best individual of each cell so far.
        learning_rate: Learning rate alpha in [0, 1].
    """

    thresholds: jax.Array
    result: MapElitesRepertoire
    learning_rate: float = flax.struct.field(pytree_node=False)

    def add(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        batch_of_genotypes: Genotype,
        batch_of_descriptors: jax.Array,
        batch_of_fitnesses: jax.Array,
        batch_of_extra_scores: ExtraScores | None = None,
    ) -> AnnealedRepertoire:
        """Adds a batch of individuals.

        Args:
            batch_of_genotypes: Genotypes, leaves (N, ...).
            batch_of_descriptors: (N, D) descriptors.
            batch_of_fitnesses: (N,) or (N, 1) fitnesses.
            batch_of_extra_scores: Extra scores to store, leaves (N, ...).

        Raises:
            TypeError: An argument is not an array.
            ValueError: An argument has another shape.
        """
        extra, descriptors = batch_of_extra_scores, batch_of_descriptors
        _check_batch(
            batch_of_genotypes, batch_of_fitnesses, descriptors, self.centroids
        )
        fitnesses = jnp.reshape(batch_of_fitnesses, (-1,))
        finite = jnp.isfinite(fitnesses) & jnp.all(jnp.isfinite(descriptors), axis=-1)
        cells = get_cells_indices(descriptors, self.centroids)
        enters = finite & (fitnesses > self.thresholds[cells])
        size = self.thresholds.shape[0]
        count = jax.ops.segment_sum(enters.astype(fitnesses.dtype), cells, size)
        total = jax.ops.segment_sum(jnp.where(enters, fitnesses, 0), cells, size)
        keep = (1 - self.learning_rate) ** count
        mean = total / jnp.maximum(count, 1)

        def first_of(values: jax.Array) -> jax.Array:
            return break_ties(values, descriptors, self.centroids)

        # QDax's addition, with thresholds instead of the elites' fitnesses.
        lowered = MapElitesRepertoire.add(
            self.replace(fitnesses=self.thresholds[:, None]),
            batch_of_genotypes,
            descriptors,
            first_of(jnp.where(enters, fitnesses, -jnp.inf)),
            extra,
        )
        changed = (count > 0)[:, None]
        return self.replace(
            genotypes=lowered.genotypes,
            fitnesses=jnp.where(changed, lowered.fitnesses, self.fitnesses),
            descriptors=lowered.descriptors,
            extra_scores=lowered.extra_scores,
            thresholds=keep * self.thresholds + (1 - keep) * mean,
            result=self.result.add(
                batch_of_genotypes,
                descriptors,
                first_of(jnp.where(finite, fitnesses, -jnp.inf)),
                extra,
            ),
        )

    @classmethod
    def init(  # pyright: ignore[reportIncompatibleMethodOverride]
        cls,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        centroids: jax.Array,
        extra_scores: ExtraScores | None = None,
        *,
        learning_rate: float,
        threshold_min: float,
        keys_extra_scores: tuple[str, ...] = (),
    ) -> AnnealedRepertoire:
        """Makes a repertoire from the initial population.

        ``functools.partial(AnnealedRepertoire.init, learning_rate=..., threshold_min=
        ...)`` is the ``repertoire_init`` of QDax's ``MAPElites``.

        Args:
            genotypes: Initial genotypes, leaves (N, ...).
            fitnesses: (N,) or (N, 1) their fitnesses.
            descriptors: (N, D) their descriptors.
            centroids: (cells, D) centres of the cells.
            extra_scores: Their extra scores.
            learning_rate: Learning rate alpha in [0, 1]. With 1, the threshold is the
                mean fitness of the individuals above it in the last batch with any.
                With 0, it never changes.
            threshold_min: First threshold of every cell, in units of the fitness: the
                lowest useful fitness.
            keys_extra_scores: Extra scores to store.

        Raises:
            TypeError: An argument is not an array.
            ValueError: ``learning_rate`` or ``threshold_min`` is out of its range, or
                an array has another shape.
        """
        check_annealing(learning_rate, threshold_min)
        _check_batch(genotypes, fitnesses, descriptors, centroids, least=1)
        empty = MapElitesRepertoire.init_default(
            jax.tree.map(lambda leaf: leaf[0], genotypes),
            centroids,
            jax.tree.map(lambda leaf: leaf[0], extra_scores or {}),
            keys_extra_scores,
        )
        # integers would round the thresholds
        dtype = jnp.asarray(fitnesses).dtype
        dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.float32
        repertoire = cls(
            genotypes=empty.genotypes,
            fitnesses=empty.fitnesses,
            descriptors=empty.descriptors,
            centroids=centroids,
            extra_scores=empty.extra_scores,
            keys_extra_scores=keys_extra_scores,
            thresholds=jnp.full(centroids.shape[0], threshold_min, dtype),
            # copies, so that a jitted function can donate both
            result=jax.tree.map(jnp.copy, empty),
            learning_rate=learning_rate,
        )
        return repertoire.add(genotypes, descriptors, fitnesses, extra_scores)


def check_annealing(learning_rate: float, threshold_min: float) -> None:
    """Checks the settings of the thresholds.

    Raises:
        ValueError: A setting is out of its range.
    """
    checks.number("learning_rate", learning_rate, least=0, most=1)
    checks.number("threshold_min", threshold_min)


def _check_batch(
    genotypes: Genotype,
    fitnesses: jax.Array,
    descriptors: jax.Array,
    centroids: jax.Array,
    *,
    least: int = 0,
) -> None:
    """Checks individuals; JAX would broadcast a descriptor of another length.

    Args:
        genotypes: Genotypes, leaves (N, ...).
        fitnesses: (N,) or (N, 1) fitnesses.
        descriptors: (N, D) descriptors.
        centroids: (cells, D) centres of the cells.
        least: Smallest number N of individuals.

    Raises:
        TypeError: An argument is not an array.
        ValueError: An argument has another shape.
    """
    leaves = jax.tree.leaves(genotypes)
    named = {"fitnesses": fitnesses, "descriptors": descriptors, "centroids": centroids}
    for name, value in (*(("genotypes", x) for x in leaves), *named.items()):
        if not checks.is_array(value):
            raise TypeError(message(name, value, "an array"))
    if len(centroids.shape) != 2:
        raise ValueError(message("centroids", centroids, "an array (cells, D)"))
    count = leaves[0].shape[0] if leaves and leaves[0].shape else 0
    for leaf in leaves:
        if count < least or leaf.shape[:1] != (count,):
            allowed = f"arrays (N, ...) of the same N, at least {least}"
            raise ValueError(message("genotypes", leaf, allowed))
    if fitnesses.shape not in ((count,), (count, 1)):
        allowed = f"an array (N,) or (N, 1) with N = {count}, as the genotypes"
        raise ValueError(message("fitnesses", fitnesses, allowed))
    shape = (count, centroids.shape[1])
    if descriptors.shape != shape:
        allowed = f"an array (N, D) = {shape}"
        raise ValueError(message("descriptors", descriptors, allowed))
