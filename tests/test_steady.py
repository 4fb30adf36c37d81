"""A long run costs what its first generations cost: no compilation, no memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from point_runs import SMALL, point_task

from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.task import make_task

STATM = Path("/proc/self/statm")
PAGE = 4096  # bytes


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """List that grows with every program that XLA compiles."""
    seen: list[str] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if event.endswith("backend_compile_duration"):
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


def test_nothing_is_compiled_after_the_first_generation(compiled: list[str]) -> None:
    search = Search(SMALL, point_task(SMALL))
    state, counts = search.empty(), []
    for _ in range(5):
        state = search.advance(state)
        search.checkpoint(state)
        counts.append(len(compiled))
    initial, first, *others = counts
    assert 0 < initial < first
    assert others == [first] * 3


def test_a_generation_is_the_same_program_for_all_seeds() -> None:
    """What the seed draws is no constant in it, so JAX's cache has other seeds' too."""
    options = {"actors": 1, "branches": 1, "copies": 1, "worlds": 2, "window": 2}
    options = {**options, "batches": 2}
    texts = []
    for seed in (0, 1):
        config = SMALL.replace(
            seed=seed, algorithm="me-actor-critic", options={**options}
        )
        search = Search(config, point_task(config))
        empty, key = search.empty().repertoire, search._start(0)
        genotypes = search._population(jax.random.split(key, config.batch_size))
        scores = jax.eval_shape(search._score, genotypes, key)
        given = (search._drawn, empty, genotypes, scores)
        emitter = jax.eval_shape(search._begin, *given)[1]
        propose = search._ask.lower(search._drawn, empty, emitter, key)
        remembered = jax.eval_shape(search._ask, search._drawn, empty, emitter, key)[1]
        given = (search._drawn, empty, emitter, genotypes, remembered, scores)
        texts.append((propose.as_text(), search._tell.lower(*given, 0.0).as_text()))
    assert texts[0] == texts[1]


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="needs Linux's account of memory")
def test_memory_is_flat_over_a_thousand_generations() -> None:
    config = EvolveConfig(
        env_name="walker2d_uni",
        iterations=1000,
        batch_size=4,
        episode_length=2,
        hidden=(4,),
        grid=(4, 4),
    )
    search = Search(config, make_task(config))
    state, resident, arrays = search.empty(), [], []
    for generation in range(1, config.iterations + 1):
        state = search.advance(state)
        search.checkpoint(state)
        if generation % 100 == 0:
            resident.append(int(STATM.read_text().split()[1]) * PAGE / 2**20)
            arrays.append(len(jax.live_arrays()))
    assert arrays == arrays[:1] * 10
    # Python and malloc keep what they freed: a little comes and goes [MiB].
    assert max(resident[2:]) - resident[1] < 8.0, resident
