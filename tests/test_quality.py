"""Scores of small archives that were filled by hand."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.qd.run import quality
from newton_qd.qd.run.folder import COLUMNS, complete_metrics

EMPTY = -np.inf
# Four of five cells are filled; one elite is worse than an untrained policy (2).
ONE = np.array([1.0, 3.0, EMPTY, 6.0, 2.0])
OTHER = np.array([EMPTY, 5.0, 9.0, 4.0, EMPTY])
NONE = np.full(5, EMPTY)


def test_scores_of_one_archive() -> None:
    assert quality.coverage(ONE) == 80
    assert quality.best(ONE) == 6
    assert quality.mean_fitness(ONE) == 3
    assert quality.offset_qd_score(ONE, 10.0) == 52
    assert quality.qd_gain(ONE, 2.0) == (3 - 2) + (6 - 2)
    # 5 of 5 cells times the distance of 8 between untrained and best known
    assert quality.normalized_qd_score(ONE, 2.0, 10.0) == pytest.approx(5 / 8 / 5)
    # such as means of JAX
    two, ten = np.array(2.0), jnp.float32(10)
    assert quality.normalized_qd_score(ONE, two, ten) == pytest.approx(5 / 8 / 5)


def test_scores_of_an_empty_archive() -> None:
    assert quality.coverage(NONE) == quality.qd_gain(NONE, 2.0) == 0
    assert quality.offset_qd_score(NONE, 10.0) == 0
    assert quality.normalized_qd_score(NONE, 0.0, 1.0) == 0
    assert quality.best(NONE) == EMPTY
    assert np.isnan(quality.mean_fitness(NONE))
    np.testing.assert_array_equal(quality.ccdf(NONE, np.zeros(2)), 0)


def test_a_full_archive_of_the_best_policy_has_score_one() -> None:
    assert quality.normalized_qd_score(np.full(7, 4.5), -1.5, 4.5) == 1
    with pytest.raises(ValueError, match=r"best_known: got 1.0; allowed: above .* 2"):
        quality.normalized_qd_score(ONE, 2.0, 1.0)
    with pytest.raises(ValueError, match=r"best_known: got 2.0; allowed: above .* 2"):
        quality.normalized_qd_score(ONE, 2.0, 2.0)


def test_an_offset_moves_the_old_score_only() -> None:
    """Half of the cells with twice the quality: the old score prefers the others."""
    many, good = np.full(8, 1.0), np.array([2.0] * 4 + [EMPTY] * 4)
    assert quality.offset_qd_score(many, 100.0) > quality.offset_qd_score(good, 100.0)
    assert quality.qd_gain(many, 0.0) == quality.qd_gain(good, 0.0)
    moved = quality.qd_gain(good + 50, 50.0)
    assert moved == quality.qd_gain(good, 0.0)


def test_common_cells_compare_the_same_cells() -> None:
    common = quality.common_cells([ONE, OTHER])
    np.testing.assert_array_equal(common, [False, True, False, True, False])
    means = quality.common_mean_fitness([ONE, OTHER])
    np.testing.assert_allclose(means, [4.5, 4.5])
    assert np.isnan(quality.common_mean_fitness([ONE, NONE])).all()
    np.testing.assert_allclose(quality.common_mean_fitness([ONE]), [3.0])


def test_the_distribution_starts_at_the_coverage() -> None:
    thresholds = np.array([-1e9, 2.0, 3.0, 6.0, 6.5])
    found = quality.ccdf(ONE, thresholds)
    np.testing.assert_allclose(found, [80, 60, 40, 20, 0])


def test_wrong_shapes_are_refused() -> None:
    listed: Any = [1.0, 2.0]
    with pytest.raises(TypeError, match=r"fitnesses: got \[1.0, 2.0\]; .* \(cells,\)"):
        quality.coverage(listed)
    for score in (quality.coverage, quality.best, quality.mean_fitness):
        with pytest.raises(ValueError, match=r"fitnesses: got .* shape \(0,\), "):
            score(ONE[:0])
    column = ONE[:, None]
    for refused in (
        lambda: quality.mean_fitness(column),
        lambda: quality.offset_qd_score(column, 1.0),
        lambda: quality.qd_gain(column, 1.0),
        lambda: quality.normalized_qd_score(column, 0.0, 1.0),
        lambda: quality.ccdf(column, np.zeros(2)),
    ):
        with pytest.raises(ValueError, match=r"shape \(5, 1\), .*; of an .* of QDax"):
            refused()
    with pytest.raises(ValueError, match=r"untrained: got an array .* one number"):
        quality.qd_gain(ONE, np.zeros(5))
    with pytest.raises(ValueError, match=r"thresholds: got an array of shape \(\)"):
        quality.ccdf(ONE, np.array(0.0))
    for archives, given in (([], "none"), ([ONE, ONE[:4]], r"shapes \[\(5,\), \(4,\)")):
        for compare in (quality.common_cells, quality.common_mean_fitness):
            with pytest.raises(ValueError, match=f"archives: got {given}"):
                compare(archives)


def test_scores_are_the_same_under_jit() -> None:
    @jax.jit
    def scores(fitnesses: jax.Array) -> list[jax.Array]:
        return [
            quality.coverage(fitnesses),
            quality.best(fitnesses),
            quality.mean_fitness(fitnesses),
            quality.qd_gain(fitnesses, 2.0),
        ]

    found = scores(jnp.asarray(ONE, jnp.float32))
    np.testing.assert_allclose(found, [80, 6, 3, 5], rtol=1e-6)


def test_metrics_of_an_earlier_version_are_completed() -> None:
    rows = np.arange(14.0).reshape(2, 7)
    whole = complete_metrics(rows)
    assert whole.shape == (2, len(COLUMNS))
    np.testing.assert_array_equal(whole[:, :7], rows)
    assert np.isnan(whole[:, 7:]).all()
    assert complete_metrics(whole).shape == whole.shape
    with pytest.raises(ValueError, match="columns of metrics: got 8; allowed: 7, 10"):
        complete_metrics(whole[:, :8])
