"""Whether saved results belong to a task."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import (
    SMALL,
    PointEnv,
    compile_once,
    copy,
    point_task,
    reference,
    run,
)

from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.cells import cell_centroids
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.run.same_task import changed_elites, require_same_task

__all__ = ["compile_once", "reference"]  # fixtures

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

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


class Shifted(PointEnv):
    """The same point with another reward."""

    def _state(self, position: jax.Array, reward: jax.Array) -> Any:
        return super()._state(position, reward + 1)


def test_another_reward_is_noticed(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, more = copy(reference, tmp_path), SMALL.replace(iterations=13)

    def factory(env: Any) -> Any:
        return lambda config: point_task(config, env)

    words = "elites now have other results than in the archive. If the task has changed"
    evolve(more, out=out, resume=True, task_factory=factory(PointEnv()))
    assert words not in capsys.readouterr().err
    more = SMALL.replace(iterations=14)
    evolve(more, out=out, resume=True, task_factory=factory(Shifted()))
    error = capsys.readouterr().err
    found = re.search(r"warning: (\d+) of (\d+) " + words, error)
    assert found is not None and found[1] == found[2]
    # nothing is evaluated if no generation follows
    evolve(more, out=out, resume=True, task_factory=factory(PointEnv()))
    assert words not in capsys.readouterr().err


def test_elites_of_other_starts_are_not_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = SMALL.replace(iterations=1, new_starts=True)
    run(config, out=tmp_path)
    more = config.replace(iterations=2)
    run(more, out=tmp_path, resume=True, progress=True)
    assert "other results" not in capsys.readouterr().err


def test_another_fitness_or_another_descriptor_is_a_change() -> None:
    """Elites that fill up a generation are not counted twice."""
    stored = Archive(
        genotypes=np.arange(5, dtype=np.float32)[:, None],
        fitnesses=np.array([-np.inf, 1, 2, 3, -np.inf], np.float32),
        descriptors=np.zeros((5, 2), np.float32),
        centroids=np.zeros((5, 2), np.float32),
    )

    def score(genotypes: jax.Array, fitness: float, place: float) -> Any:
        first = genotypes == 1
        found = jnp.zeros((len(genotypes), 2)).at[:, 1:].set(place * first)
        return genotypes[:, 0] + fitness * first[:, 0], found

    for changes, count in (((0, 0), 0), ((1, 0), 1), ((0, 1), 1), ((1, 1), 1)):
        found = changed_elites(stored, lambda rows, c=changes: score(rows, *c), 8)
        assert found == (count, 3), changes
