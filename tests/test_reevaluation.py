"""Elites that are evaluated again, with evaluations that are not finite."""

from __future__ import annotations

import dataclasses
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
        ([(np.nan, 0.2), (np.inf, 0.2)], 3.0),
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


def test_after_a_fault_the_others_count_with_their_median() -> None:
    """Their mean descriptor is in another cell."""
    rows = [[(EMPTY, 0.9), (1.0, 0.1), (3.0, 0.1), (2.0, 0.9)]]
    found = corrected_fitnesses(archive(1), scoring(rows), jax.random.key(0), 4)
    np.testing.assert_array_equal(found, [1.5, EMPTY, EMPTY, EMPTY])


def test_each_evaluation_has_its_own_key() -> None:
    keys = []

    def score(genotypes: Any, key: jax.Array) -> Any:
        keys.append(jax.random.key_data(key).tolist())
        return np.ones(len(genotypes)), np.zeros((len(genotypes), 1)), {}

    corrected_fitnesses(archive(1), score, jax.random.key(0), 3)
    given = jax.random.key_data(jax.random.split(jax.random.key(0), 3))
    assert keys == given.tolist()


def test_the_fittest_elite_of_a_cell_counts() -> None:
    rows = [[(7.0, 0.1)], [(2.0, 0.1)]]
    found = corrected_fitnesses(archive(2), scoring(rows), jax.random.key(0), 1)
    np.testing.assert_array_equal(found, [7, EMPTY, EMPTY, EMPTY])


@pytest.mark.parametrize("shape", [(4,), (4, 1)])
def test_repertoires_of_qdax_are_archives(shape: tuple[int, ...]) -> None:
    """Their fitnesses are columns, and their genotypes may be a pytree."""
    own = archive(1)

    @dataclasses.dataclass
    class Repertoire:
        genotypes: Any
        fitnesses: np.ndarray
        centroids: np.ndarray

    genotypes = {"weights": own.genotypes}
    given = Repertoire(genotypes, own.fitnesses.reshape(shape), CENTROIDS)
    key, calls = jax.random.key(0), len(SOUND)
    found = reevaluate(given, scoring([SOUND]), key, reevaluations=calls, offset=1.0)
    same = reevaluate(own, scoring([SOUND]), key, reevaluations=calls, offset=1.0)
    assert found == same and found is not None and found.qd_score == 5.0


def test_what_is_no_archive_is_refused() -> None:
    key = jax.random.key(0)
    with pytest.raises(TypeError, match=r"archive: got .*; allowed: an Archive, or a"):
        reevaluate(np.zeros(4), scoring([SOUND]), key, offset=0.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="key: got 0; allowed: one key"):
        reevaluate(archive(1), scoring([SOUND]), 0, offset=0.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="score: got 3; allowed: a scoring function"):
        reevaluate(archive(1), 3, key, offset=0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="archive: got no elites; allowed: one"):
        reevaluate(archive(0), scoring([SOUND]), key, offset=0.0)
    with pytest.raises(ValueError, match="reevaluations: got 0; allowed: integers"):
        reevaluate(archive(1), scoring([SOUND]), key, offset=0.0, reevaluations=0)
