"""The cells of an archive: a grid, or a centroidal Voronoi tessellation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.qd.config import ConfigError, EvolveConfig

_CVT_SAMPLES_PER_CELL = 50
_CVT_MIN_SAMPLES = 10_000


def cell_centroids(
    config: EvolveConfig, limits: tuple[np.ndarray, np.ndarray], key: jax.Array
) -> jax.Array:
    """Returns the centres (cells, D) of the cells of an archive.

    Args:
        config: Settings with a grid or a number of centroids.
        limits: Lowest and highest descriptor, (D,) each.
        key: Key of the samples of a Voronoi tessellation.

    Raises:
        ConfigError: The limits are not a finite box.
    """
    from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids

    low, high = limits
    if not (np.all(np.isfinite(low)) and np.all(low < high)):
        given = Fact(f"{config.env_name!r}, whose descriptor is from {low} to {high}")
        raise ConfigError(message("env_name", given, "a descriptor in a finite box"))
    if config.grid is None:
        centroids = _voronoi_centroids(config, low, high, key)
    else:
        centroids = compute_euclidean_centroids(
            config.grid, low.tolist(), high.tolist()
        )
    return jnp.asarray(centroids, jnp.float32)


def _voronoi_centroids(
    config: EvolveConfig, low: np.ndarray, high: np.ndarray, key: jax.Array
) -> jax.Array:
    from qdax.core.containers.mapelites_repertoire import compute_cvt_centroids
    from threadpoolctl import threadpool_limits

    cells = config.centroids
    assert cells is not None
    # With several threads, the order of sums changes. One thread keeps runs equal.
    with threadpool_limits(limits=1):
        return compute_cvt_centroids(
            num_descriptors=len(low),
            num_init_cvt_samples=max(_CVT_MIN_SAMPLES, _CVT_SAMPLES_PER_CELL * cells),
            num_centroids=cells,
            minval=low.tolist(),
            maxval=high.tolist(),
            key=key,
        )
