"""Iso+line variations whose second parent has won a tournament."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from emitter_problems import centroids
from point_runs import SMALL, point_task
from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

import newton_qd.compat
from newton_qd.qd.config import ConfigError
from newton_qd.qd.emitters.tournament import TournamentEmitter
from newton_qd.qd.run.search import Search

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

CELLS, BATCH = 5, 40_000


def archive() -> MapElitesRepertoire:
    """Five elites whose genotype is their rank, in the middle of empty cells."""
    size = len(centroids())
    fitnesses = np.full((size, 1), -np.inf, np.float32)
    genotypes = np.full((size, 1), -1, np.float32)
    ranks = np.array([3, 0, 4, 1, 2], np.float32)
    genotypes[10 : 10 + CELLS, 0] = ranks
    fitnesses[10 : 10 + CELLS, 0] = -10 + ranks**2
    return MapElitesRepertoire(
        genotypes=jnp.asarray(genotypes),
        fitnesses=jnp.asarray(fitnesses),
        descriptors=centroids(),
        extra_scores={},
        keys_extra_scores=(),
        centroids=centroids(),
    )


@pytest.mark.parametrize("tournament", [1, 2, 4])
def test_the_second_parent_is_the_fittest_of_some(tournament: int) -> None:
    def both(first: jax.Array, second: jax.Array, key: jax.Array) -> jax.Array:
        del key
        return jnp.concatenate([first, second], axis=1)

    emitter = TournamentEmitter(both, batch_size=BATCH, tournament=tournament)
    found, _ = jax.jit(emitter.emit)(archive(), None, jax.random.key(3))
    first, second = np.asarray(found).astype(int).T
    every = np.bincount(first, minlength=CELLS) / BATCH
    np.testing.assert_allclose(every, 1 / CELLS, atol=0.01)
    # The chance that all entrants have at most a rank is the power of one's chance.
    below = np.arange(CELLS + 1) / CELLS
    chances = np.diff(below**tournament)
    won = np.bincount(second, minlength=CELLS) / BATCH
    np.testing.assert_allclose(won, chances, atol=0.01)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.02


@pytest.mark.parametrize("name", ["batch_size", "tournament"])
def test_bad_numbers_are_named(name: str) -> None:
    settings: dict[str, Any] = {"batch_size": 1, "tournament": 1, name: 0}
    with pytest.raises(ValueError, match=f"^{name}: got 0; allowed: integers from 1$"):
        TournamentEmitter(lambda first, second, key: first, **settings)


@pytest.mark.parametrize(
    ("algorithm", "share"),
    [
        *(("me", 1), ("me-gradient", 0.5), ("ascii-me", 0.5), ("pga-me", 0.5)),
        *(("dcrl-me", 0.5), ("me-actor-critic", 0.5), ("me-conditioned", 0.75)),
    ],
)
def test_iso_line_variations_of_an_algorithm_have_a_tournament(
    algorithm: str, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    init = TournamentEmitter.__init__

    def noted(self: TournamentEmitter, vary: Any, **sizes: int) -> None:
        made.append(sizes)
        init(self, vary, **sizes)

    monkeypatch.setattr(TournamentEmitter, "__init__", noted)
    config = SMALL.replace(algorithm=algorithm, batch_size=64, tournament=3)
    try:
        Search(config, point_task(config)).empty()
    finally:
        newton_qd.compat.uninstall()  # pga-me and dcrl-me have installed it
    assert made == [{"batch_size": share * 64, "tournament": 3}]


@pytest.mark.parametrize("name", ["cma-me", "me-es", "omg-mega", "cma-maega"])
def test_algorithms_without_variations_have_no_tournaments(name: str) -> None:
    config = SMALL.replace(algorithm=name, tournament=2)
    allowed = f"tournament: got 2; allowed: 1 for '{name}', which has no iso"
    with pytest.raises(ConfigError, match=allowed):
        Search(config, point_task(config))
