"""One generation as pure functions of an archive and an emitter's state."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.qd.emitters.cells import break_ties
from newton_qd.qd.run import quality
from newton_qd.qd.scoring.gradient_scores import finite_scores
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire


@dataclasses.dataclass(frozen=True, eq=False)
class Generation:
    """A generation of one algorithm, around the evaluation of its individuals.

    Attributes:
        emitter: Emitter of QDax.
        key: Key of the emitter's first state.
        takes_faulty: Whether the emitter gets the fitness ``-inf`` of a faulty
            individual. If not, it gets the worst finite fitness.
        offset: Number that makes returns positive.
    """

    emitter: Any
    key: jax.Array
    takes_faulty: bool
    offset: float

    def propose(
        self, repertoire: Repertoire, emitter: PyTree, key: jax.Array
    ) -> PyTree:
        """Returns the next genotypes (N, size), and the emitter's data about them.

        Raises:
            TypeError: The emitter returns something else.
        """
        _, key = jax.random.split(key)
        found = self.emitter.emit(repertoire, emitter, key)
        if not isinstance(found, (tuple, list)) or len(found) != 2:
            allowed = "genotypes and a dictionary, as an emitter of QDax returns them"
            kind = Fact(type(found).__name__)
            raise TypeError(
                message(f"{type(self.emitter).__name__}.emit", kind, allowed)
            )
        genotypes, remembered = found
        name = f"{type(self.emitter).__name__}.emit: genotypes"
        checks.instance(name, genotypes, (jax.Array, np.ndarray), "an array (N, size)")
        # With JAX x64, QDax draws its noise in double precision.
        return genotypes.astype(jnp.float32), remembered

    def enter(
        self, repertoire: Repertoire, genotypes: Genotype, scores: PyTree
    ) -> PyTree:
        """Returns the archive with individuals that no emitter hears of."""
        return self._added(repertoire, genotypes, scores)[0]

    def begin(
        self, repertoire: Repertoire, genotypes: Genotype, scores: PyTree
    ) -> PyTree:
        """Returns archive, emitter's state and metrics after the initial population."""
        repertoire, told = self._added(repertoire, genotypes, scores)
        emitter = self.emitter.init(key=self.key, **told)
        # the median is compared with true returns, so it has no price of scatter
        fitnesses = scores[2].get("unscattered", scores[0])
        finite = jnp.where(jnp.isfinite(fitnesses), fitnesses, jnp.nan)
        metrics = self._measured(repertoire, scores, jnp.nanmedian(finite))
        return repertoire, _strongly_typed(emitter), metrics

    def tell(
        self,
        repertoire: Repertoire,
        emitter: PyTree,
        genotypes: Genotype,
        remembered: ExtraScores,
        scores: PyTree,
        initial: jax.Array,
    ) -> PyTree:
        """Returns archive, emitter's state and metrics after another generation.

        Args:
            repertoire: The archive.
            emitter: State of the emitter.
            genotypes: (N, size) the individuals.
            remembered: The emitter's data about them.
            scores: Their scores.
            initial: () median fitness of the initial population.
        """
        repertoire, told = self._added(repertoire, genotypes, scores)
        told["extra_scores"] = {**told["extra_scores"], **remembered}
        emitter = self.emitter.state_update(emitter, **told)
        metrics = self._measured(repertoire, scores, initial)
        for name, lost in remembered.items():
            if name.endswith("overflowed"):  # of one emitter, or of several
                metrics["rejected"] += jnp.sum(lost)
        return repertoire, emitter, metrics

    def _added(
        self, repertoire: Repertoire, genotypes: Genotype, scores: PyTree
    ) -> tuple[Any, dict]:
        """Returns the archive with a generation added, and the emitter's arguments."""
        fitnesses, found, extra = scores
        # an algorithm's own scores may be finite where the descriptor is not
        sound = finite_scores(fitnesses, found)
        fitnesses = jnp.where(sound, fitnesses, -jnp.inf)
        found = jnp.where(jnp.isfinite(found), found, 0)
        kept = break_ties(fitnesses, found, repertoire.centroids)
        repertoire = repertoire.add(genotypes, found, kept, {})
        if not self.takes_faulty:
            fitnesses = jnp.where(sound, fitnesses, -self.offset)
        return repertoire, {
            "repertoire": repertoire,
            "genotypes": genotypes,
            "fitnesses": fitnesses,
            "descriptors": found,
            "extra_scores": extra,
        }

    def _measured(
        self, repertoire: Repertoire, scores: PyTree, initial: jax.Array
    ) -> PyTree:
        """Returns the metrics of the archive, and the number of rejected individuals.

        Coverage is in percent. The other metrics are explained in ``quality``.
        """
        from qdax.utils.metrics import default_qd_metrics

        metrics = default_qd_metrics(repertoire, qd_offset=self.offset)
        found = repertoire.fitnesses[:, 0]
        return {
            **metrics,
            "rejected": jnp.sum(~finite_scores(*scores[:2]) | _lost(scores)),
            "mean_fitness": quality.mean_fitness(found),
            "initial_fitness": initial,
            "qd_gain": quality.qd_gain(found, initial),
        }


def _lost(scores: PyTree) -> jax.Array:
    """Returns whether a gradient of each individual is not finite, (N,)."""
    fitnesses, found, extra = scores
    if "overflowed" not in extra:
        return jnp.zeros(fitnesses.shape, bool)
    return jnp.any(extra["overflowed"].reshape(len(found), -1), axis=1)


def _strongly_typed(tree: PyTree) -> PyTree:
    """Removes weak types, which would make JAX compile the next generation again."""

    def strong(leaf: Any) -> jax.Array:
        leaf = jnp.asarray(leaf)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return leaf
        return jax.lax.convert_element_type(leaf, leaf.dtype)

    return jax.tree.map(strong, tree)
