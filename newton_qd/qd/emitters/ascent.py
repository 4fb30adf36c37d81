"""Elites that climb along the gradient of their mean return."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.envs.state import select
from newton_qd.gradients.episode import Episode
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.cells import draw_elites
from newton_qd.qd.emitters.restarts import LONGEST_LIFE, due_for_restart
from newton_qd.qd.scoring.gradient_scores import genotype_matrix
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire, RNGKey

Slope: TypeAlias = Callable[[jax.Array, RNGKey], tuple[jax.Array, jax.Array]]
"""Maps weights (N, size) and a key to gradients (N, size), and whether each is lost."""

LOST = "climbers_overflowed"
"""Name of what tells which gradients are lost; other emitters have ``overflowed``."""


def mean_slope(episode: Episode, worlds: int) -> Slope:
    r"""Returns the gradient of the mean fitness over several start states.

    Near a stiff contact, the gradient of one world can be much longer than those of the
    others. So a gradient that is longer than the median norm is shortened to it, see
    :func:`limited_mean`. A world with a fault, or with a gradient that is not finite,
    does not count.

    Args:
        episode: Episode whose genotypes are weights (size,).
        worlds: Number W of start states of each policy.

    Returns:
        Function of weights (N, size) and a key, from which the start states are drawn.
        It returns gradients (N, size), and whether all worlds of a policy were lost
        (N,).

    Raises:
        TypeError: ``episode`` is no ``Episode``.
        ValueError: ``worlds`` is not an integer from 1.
    """
    checks.instance("episode", episode, Episode, "an Episode")
    checks.integer("worlds", worlds)

    def slope(weights: jax.Array, key: RNGKey) -> tuple[jax.Array, jax.Array]:
        keys = jax.random.split(key, worlds)
        found = jax.vmap(episode.gradient, (None, 0))(weights, keys)
        sound = ~(found.faulty | found.overflowed[..., 0])
        mean = limited_mean(found.gradients[:, :, 0], sound)
        return mean, ~jnp.any(sound, axis=0)

    return slope


def limited_mean(gradients: jax.Array, sound: jax.Array) -> jax.Array:
    r"""Returns the mean of gradients after the long ones were shortened.

    .. math:: \frac{1}{W} \sum_w \min\left(1, \frac{n}{|g_w|}\right) g_w

    The sum is over the W worlds that count, and n is the median of their norms. For an
    even number of worlds, it is the lower one of the two norms in the middle, so that
    it limits the longer one of two gradients.

    Args:
        gradients: (W, N, size) gradients of W worlds.
        sound: (W, N) whether a world counts.

    Returns:
        (N, size) means; 0 where no world counts.
    """
    sound = sound[..., None]
    # scaled first, because the square of a large gradient may overflow
    largest = jnp.max(jnp.abs(gradients), axis=-1, keepdims=True)
    units = gradients / jnp.where(largest > 0, largest, 1)
    norms = largest * jnp.linalg.norm(units, axis=-1, keepdims=True)
    count = jnp.sum(sound, axis=0, keepdims=True)
    order = jnp.sort(jnp.where(sound, norms, jnp.inf), axis=0)
    median = jnp.take_along_axis(order, jnp.maximum(count - 1, 0) // 2, axis=0)
    allowed = jnp.where(sound, jnp.minimum(norms, median), 0)
    factors = allowed / jnp.where(norms > 0, norms, 1)
    return jnp.sum(factors * gradients, axis=0) / jnp.maximum(count[0], 1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AscentState:
    """Climbers between two generations.

    Attributes:
        weights: (K, size) weights of the climbers.
        motion: (K, size) running mean of their directions.
        steps: (K,) lengths of their steps.
        lost: (K,) whether the last gradient of a climber was lost.
        generation: () number of generations so far.
        key: Key of the next generation.
    """

    weights: jax.Array
    motion: jax.Array
    steps: jax.Array
    lost: jax.Array
    generation: jax.Array
    key: jax.Array


class AscentEmitter(Emitter):
    r"""Emits elites that climb along the gradient of their mean return.

    A climber :math:`\theta` begins at a random elite. In each generation, it makes one
    step along the gradient g, and is then emitted (in the first one without a step):

    .. math:: m \leftarrow \beta m + (1 - \beta) \frac{g}{|g|}, \qquad
        \theta \leftarrow \theta + s \frac{m}{|m|}.

    After its lifetime, or if its gradient was lost, it begins again at another elite.
    The length s of its steps is drawn log-uniformly from a range at each beginning. A
    climber may cross several cells of the archive; in each, it can become the elite.
    """

    def __init__(
        self,
        slope: Slope,
        *,
        climbers: int,
        lifetime: int,
        shortest: float,
        longest: float,
        momentum: float = 0.7,
    ) -> None:
        """Sets the climbers and their steps.

        Args:
            slope: Gradient of the return, such as :func:`mean_slope`.
            climbers: Number K of climbers.
            lifetime: Steps of a climber.
            shortest: Shortest step, in units of the genotype.
            longest: Longest step.
            momentum: Share of the former directions [-], below 1.

        Raises:
            TypeError: ``slope`` is not a function, or a length is not a number.
            ValueError: A number is out of its range.
        """
        checks.function("slope", slope, "a function of weights and a key")
        checks.integer("climbers", climbers)
        checks.integer("lifetime", lifetime, most=LONGEST_LIFE)
        checks.number("shortest", shortest, above=0)
        checks.number("longest", longest, least=shortest)
        checks.number("momentum", momentum, least=0, below=1)
        self._slope = slope
        self._climbers = climbers
        self._lifetime = lifetime
        self._range = shortest, longest
        self._momentum = momentum

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one generation."""
        return self._climbers

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> PyTree:
        """Begins at random elites.

        Raises:
            GradientsError: Genotypes are not one array.
        """
        genotype_matrix(genotypes)
        del genotypes, fitnesses, descriptors, extra_scores
        key, begin_key = jax.random.split(key)
        none = jnp.zeros((self._climbers,), bool)
        start = self._begun(repertoire, begin_key)
        state = AscentState(*start, none, jnp.zeros((), jnp.int32), key)
        return varying_alike((state, repertoire))[0]

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Returns the climbers, and whether each lost its gradient, (climbers,)."""
        del repertoire, key
        return emitter_state.weights, {LOST: emitter_state.lost}

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: jax.Array | None = None,
        descriptors: jax.Array | None = None,
        extra_scores: ExtraScores | None = None,
    ) -> PyTree:
        """Begins again at the end of a lifetime, and makes a step."""
        del genotypes, fitnesses, descriptors, extra_scores
        state = emitter_state
        key, begin_key, slope_key = jax.random.split(state.key, 3)
        due = due_for_restart(state.generation, self._lifetime, self._climbers)
        due |= state.lost
        own = state.weights, state.motion, state.steps
        weights, motion, steps = select(due, self._begun(repertoire, begin_key), own)
        slopes, lost = self._slope(weights, slope_key)
        share = self._momentum
        motion = share * motion + (1 - share) * _units(slopes)
        weights = weights + steps[:, None] * _units(motion)
        number = state.generation + 1
        # a gradient that is never lost may say so with a constant
        return varying_alike(AscentState(weights, motion, steps, lost, number, key))

    def _begun(
        self, repertoire: Repertoire, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns weights, motion and lengths of the steps of new climbers."""
        cell_key, step_key = jax.random.split(key)
        cells = draw_elites(repertoire, cell_key, self._climbers)
        weights = repertoire.genotypes[cells]
        drawn = jax.random.uniform(step_key, (self._climbers,), weights.dtype)
        shortest, longest = self._range
        steps = shortest * (longest / shortest) ** drawn
        return weights, jnp.zeros_like(weights), steps


def _units(rows: jax.Array) -> jax.Array:
    """Returns rows (N, size) with norm 1; 0 stays 0."""
    largest = jnp.max(jnp.abs(rows), axis=1, keepdims=True)
    scaled = rows / jnp.where(largest > 0, largest, 1)
    norms = jnp.linalg.norm(scaled, axis=1, keepdims=True)
    return scaled / jnp.where(norms > 0, norms, 1)
