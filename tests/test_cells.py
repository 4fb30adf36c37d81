"""The choice of cells of a repertoire."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.qd.emitters.cells import draw_cells

KEY = jax.random.key(5)


def test_only_wanted_cells_are_drawn_from_a_large_archive() -> None:
    wanted = jax.random.uniform(KEY, (2**16,)) < 0.3
    cells = draw_cells(KEY, wanted, 300_000)
    assert np.asarray(wanted)[np.asarray(cells)].all()


def test_wanted_cells_are_drawn_equally_often() -> None:
    wanted = jnp.asarray([False, True, True, False, True, False])
    counts = np.bincount(draw_cells(KEY, wanted, 30_000), minlength=6)
    assert not counts[[0, 3, 5]].any()
    np.testing.assert_allclose(counts[[1, 2, 4]], 10_000, atol=300)


def test_without_a_wanted_cell_all_are_drawn() -> None:
    counts = np.bincount(draw_cells(KEY, jnp.zeros(4, bool), 4_000))
    np.testing.assert_allclose(counts, 1_000, atol=120)
