"""Elites that are evaluated again, with evaluations that are not finite."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.reevaluation import corrected_fitnesses, reevaluate
from newton_qd.types import ScoringFunction

EMPTY = -np.inf
CENTROIDS = np.array([[0.125], [0.375], [0.625], [0.875]], np.float32)


def archive(elites: int) -> Archive:
    """An archive of four cells, of which the last ones are empty."""
    fitnesses = np.where(np.arange(4) < elites, np.float32(1), np.float32(EMPTY))
    return Archive(np.zeros((4, 2), np.float32), fitnesses, CENTROIDS.copy(), CENTROIDS)


def scoring(rows: list[list[tuple[float, float]]]) -> ScoringFunction:
    """Scores of each elite: fitness and descriptor of one evaluation after another."""
    calls = iter(np.array(rows, np.float32).transpose(1, 0, 2))

    def score(genotypes: Any, key: jax.Array) -> Any:
        del genotypes, key
        found = next(calls)
        return found[:, 0], found[:, 1:], {}

    return score


# the median of these descriptors is in cell 2; a fault may move it to another one
SOUND = [(3.0, 0.3), (5.0, 0.6), (4.0, 0.7)]


@pytest.mark.parametrize(
    ("faults", "fitness"),
    [
        ([(EMPTY, np.nan)], 3.5),
        ([(EMPTY, np.nan)] * 2, 3.0),
        ([(EMPTY, 0.1)] * 2, 3.0),
        ([(EMPTY, 0.2), (EMPTY, np.nan)], 3.0),
    ],
)
def test_descriptors_of_faults_do_not_count(faults: list, fitness: float) -> None:
    rows = [faults + SOUND]
    found = corrected_fitnesses(
        archive(1), scoring(rows), jax.random.key(0), len(rows[0])
    )
    np.testing.assert_array_equal(found, [EMPTY, EMPTY, fitness, EMPTY])


def test_elites_without_a_sound_evaluation_are_left_out() -> None:
    """The fitness of the last one is finite, but its descriptor never is."""
    rows = [SOUND, [(EMPTY, 0.1)] * 3, [(9.0, np.nan)] * 3]
    found = reevaluate(
        archive(3), scoring(rows), jax.random.key(0), reevaluations=3, offset=1.0
    )
    assert found is not None
    assert found.max_fitness == found.mean_fitness == 4
    assert found.coverage == 25 and found.qd_score == 5


def test_sound_evaluations_count_with_their_medians() -> None:
    rows = [[(1.0, 0.1), (3.0, 0.9), (2.0, 0.4)], [(7.0, 0.1), (7.0, 0.1), (8.0, 0.9)]]
    found = corrected_fitnesses(archive(2), scoring(rows), jax.random.key(0), 3)
    np.testing.assert_array_equal(found, [7, 2, EMPTY, EMPTY])
