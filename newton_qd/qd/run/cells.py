"""The cells of an archive: a grid, or a centroidal Voronoi tessellation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.checkpoint import Checkpoint

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


def require_same_task(
    config: EvolveConfig, stored: Checkpoint, centroids: jax.Array, size: int
) -> None:
    """Checks that an environment is that of a run to resume, as far as files show it.

    A module may register another environment of the same name.

    Args:
        config: Settings of the run.
        stored: Its checkpoint.
        centroids: (cells, D) centres of the cells for this environment.
        size: Weights of a policy for this environment.

    Raises:
        ConfigError: Policies have other sizes, or descriptors have other limits.
    """
    name = f"{config.env_name!r}, whose"
    again = "the environment of the run to resume, whose"
    if stored.genotypes.shape[1] != size:
        given = Fact(f"{name} policy has {size:,} weights")
        allowed = f"{again} policy has {stored.genotypes.shape[1]:,}"
        raise ConfigError(message("env_name", given, allowed))
    old, new = (
        np.stack([cells.min(axis=0), cells.max(axis=0)])
        for cells in (stored.centroids, np.asarray(centroids))
    )
    # Another machine may find another tessellation: about a cell's width is allowed.
    width = 0.0 if config.grid else len(centroids) ** (-1 / centroids.shape[1])
    error = 1e-4 * abs(new).max() + width * (new[1] - new[0])
    if old.shape != new.shape or (abs(old - new) > error).any():
        shown = [f"cells go from {low} to {high}" for low, high in (old, new)]
        given, allowed = Fact(f"{name} {shown[1]}"), f"{again} {shown[0]}"
        raise ConfigError(message("env_name", given, allowed))


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
