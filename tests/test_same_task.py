"""Whether saved results belong to a task."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.cells import cell_centroids
from newton_qd.qd.run.same_task import require_same_task

KEY = jax.random.key(0)
WEIGHTS = 3
REFUSED = (
    r"^results: got centres of cells from \[.*; allowed: cells from \[0\. 0\.\] to"
)


def check(centroids: jax.Array, config: EvolveConfig, *highest: float) -> None:
    cells = np.asarray(centroids)
    stored = Archive(
        genotypes=np.zeros((len(cells), WEIGHTS), np.float32),
        fitnesses=np.zeros(len(cells), np.float32),
        descriptors=np.zeros_like(cells),
        centroids=cells,
    )
    require_same_task("results", stored, config, limits(*highest), WEIGHTS)


def limits(*highest: float) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(len(highest), np.float32), np.array(highest, np.float32)


def test_limits_of_each_component_are_compared() -> None:
    """However large those of another component are."""
    config = EvolveConfig(env_name="point", grid=(10, 10), centroids=None)
    begun = cell_centroids(config, limits(1000, 1), KEY)
    check(begun, config, 1000, 1)
    with pytest.raises(ConfigError, match=REFUSED):
        check(begun, config, 1000, 1.05)


def test_another_tessellation_of_few_cells_is_taken() -> None:
    """Their centres lie side by side, or one above the other."""
    for cells in ([[0.25, 0.5], [0.75, 0.5]], [[0.5, 0.25], [0.5, 0.75]]):
        config = EvolveConfig(env_name="point", grid=None, centroids=len(cells))
        check(jnp.array(cells), config, 1, 1)


@pytest.mark.parametrize("cells", [5, 64])
def test_a_tessellation_is_taken_within_its_limits(cells: int) -> None:
    """Its centres may be those of another machine."""
    config = EvolveConfig(env_name="point", grid=None, centroids=cells)
    for seed in range(2):
        begun = cell_centroids(config, limits(1, 1), jax.random.key(seed))
        check(begun, config, 1, 1)
        for highest in ((2.0, 2.0), (1.0, 0.5)):
            with pytest.raises(ConfigError, match=REFUSED):
                check(begun, config, *highest)


def test_an_error_is_one_line_for_long_descriptors() -> None:
    config = EvolveConfig(env_name="point", grid=None, centroids=8)
    begun = jax.random.uniform(KEY, (8, 20))
    with pytest.raises(ConfigError, match="centres of cells") as caught:
        check(begun, config, *[30.0] * 20)
    assert "\n" not in str(caught.value)
