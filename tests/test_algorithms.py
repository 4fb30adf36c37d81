"""The algorithms of ``evolve``: what they find, and that a stop changes nothing."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, evolve_module, interrupt_after, point_task, run
from test_steady import compiled

import newton_qd.compat
from newton_qd.qd.algorithms import ALGORITHMS
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.emitters import GradientLineEmitter
from newton_qd.qd.run.checkpoint import (
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.task import make_task

__all__ = ["compiled"]  # a fixture

CRITIC = {
    "critic_hidden_layer_size": (8,),
    "num_critic_training_steps": 2,
    "num_pg_training_steps": 2,
    "batch_size": 16,
    "replay_buffer_size": 1024,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "me": {},
    "cma-me": {"emitters": 2},
    "pga-me": CRITIC,
    "dcrl-me": CRITIC,
    "me-es": {"num_optimizer_steps": 2, "sample_sigma": 0.1, "learning_rate": 0.1},
    "me-gradient": {},
    "me-ascent": {"climbers": 4, "climb_steps": 3},
    "me-actor-critic": {
        **{"actors": 2, "branches": 1, "copies": 4, "updates": 1, "lifetime": 3},
        **{"worlds": 2, "window": 4, "batches": 2, "critic": (8,)},
        "episodes_after": 2,
    },
    "ascii-me": {"epochs": 2},
    "ascii-me-exact": {"epochs": 2, "branches": 4, "window": 4},
    "me-conditioned": {"worlds": 2, "window": 4, "batches": 2, "critic": (8,)},
    "omg-mega": {},
    "cma-mega": {"points": 2},
    "cma-maega": {"points": 2, "adam": 0.05},
    "cma-maega-actor-critic": {
        **{"points": 2, "probes": 3, "walks": 1, "worlds": 2, "window": 4},
        **{"batches": 2, "critic": (8,)},
    },
}


def count_after_generations(
    patch: pytest.MonkeyPatch, compiled: list[str]
) -> list[int]:
    """List of the number of compiled programs after each generation to come."""
    counts: list[int] = []
    advance = Search.advance

    def advance_and_count(self: Search, state: Any) -> Any:
        state = advance(self, state)
        counts.append(len(compiled))
        return state

    patch.setattr(Search, "advance", advance_and_count)
    return counts


def test_every_algorithm_is_tested() -> None:
    assert set(OPTIONS) == {spec.name for spec in ALGORITHMS}


@pytest.mark.parametrize("name", [spec.name for spec in ALGORITHMS if spec.double])
def test_a_generation_changes_no_type_under_x64(name: str, x64: None) -> None:
    given: Any = OPTIONS[name]
    config = SMALL.replace(algorithm=name, options=given)
    search, key = Search(config, point_task(config)), jax.random.key(0)
    generation, empty = search._generation, search.empty().repertoire
    genotypes = jnp.zeros((config.batch_size, empty.genotypes.shape[1]), jnp.float32)
    scores = jax.eval_shape(search._scoring(), genotypes, key)
    before = jax.eval_shape(generation.begin, empty, genotypes, scores)[:2]
    proposed = jax.eval_shape(generation.propose, *before, key)
    initial = jnp.zeros((), jnp.float32)
    after = jax.eval_shape(generation.tell, *before, *proposed, scores, initial)[:2]
    types = functools.partial(jax.tree.map, lambda x: (x.shape, x.dtype))
    assert types(after) == types(before)


@pytest.mark.slow
@pytest.mark.parametrize(
    "env_name", list(dict.fromkeys(name for spec in ALGORITHMS for name in spec.tuned))
)
def test_defaults_of_an_environment_are_accepted(env_name: str) -> None:
    task = make_task(EvolveConfig(env_name=env_name))
    names = [spec.name for spec in ALGORITHMS if spec.gradients is not None]
    assert len(names) == 9
    for name in names:
        config = EvolveConfig(
            env_name=env_name,
            algorithm=name,
            batch_size=64,
            episode_length=8,
            hidden=(4,),
            grid=(4,) * task.descriptor_length,
        )
        assert Search(config, task).empty().metrics.shape[0] == 0, name


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("name", OPTIONS)
def test_a_stop_changes_nothing(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    compiled: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = EvolveConfig(
        env_name="pointmaze",
        iterations=6,
        batch_size=16,
        episode_length=20,
        hidden=(4,),
        grid=(8, 8),
        algorithm=name,
        reevaluations=0,
        options=OPTIONS[name],  # pyright: ignore[reportArgumentType]
    )
    common: dict[str, Any] = {"progress": False, "checkpoint_seconds": 1e9}
    monkeypatch.setattr(evolve_module, "archive_png", lambda *arguments: b"picture")
    try:
        # one search for both, which is traced once; the third run makes its own
        search = Search(config, make_task(config))
        with monkeypatch.context() as patch:
            patch.setattr(evolve_module, "Search", lambda *_: search)
            with patch.context() as first:
                counts = count_after_generations(first, compiled)
                whole = evolve(config, out=tmp_path / "whole", **common)
            interrupt_after(patch, 3)
            assert evolve(config, out=tmp_path / "parts", **common).interrupted
        common["progress"] = True
        evolve(config, out=tmp_path / "parts", resume=True, **common)
    finally:
        newton_qd.compat.uninstall()
    shown = capsys.readouterr().err
    assert "resuming" in shown and "other results" not in shown
    for file in ("checkpoint.bin", "archive.npz", "metrics.csv"):
        left, right = (tmp_path / run / file for run in ("whole", "parts"))
        assert left.read_bytes() == right.read_bytes(), file
    # Nothing is compiled after the first generation.
    assert counts[0] < counts[1] and counts[1:] == counts[1:2] * config.iterations
    metrics = whole.metrics
    for column in ("qd_score", "coverage", "max_fitness"):
        assert metrics[column][-1] > metrics[column][0], column
    # What is differentiated counts, too: two parents, four climbers, two solution
    # points, the episodes of two actors in two worlds each.
    more = {"me-gradient": 2, "me-actor-critic": 4, "cma-mega": 2, "cma-maega": 2}
    more |= {"me-ascent": 4}
    # two parents, each once for its actions and once for the gradient
    more |= {"ascii-me-exact": 4, "me-conditioned": 1}
    # two solution points, and the 64 control steps of their actors
    more |= {"cma-maega-actor-critic": 2 + 4}
    each = 16 + {"me-es": 1, **more}.get(name, 0)
    np.testing.assert_array_equal(np.diff(metrics["evaluations"]), each)
    first = each if name.startswith(("cma-mega", "cma-maega")) else 16
    assert metrics["evaluations"][0] == first
    assert not metrics["rejected"].any()


@pytest.mark.slow
def test_initial_weights_are_scaled() -> None:
    def norm(options: dict[str, Any]) -> float:
        config = SMALL.replace(algorithm="me-gradient", iterations=0, options=options)
        archive = run(config.replace(grid=(1, 2))).archive
        return float(np.linalg.norm(archive.genotypes[archive.filled], axis=1).max())

    assert norm({"initial_scale": 0.01}) < 0.1 < norm({})


@pytest.mark.parametrize(
    "name", ["me-gradient", pytest.param("cma-mega", marks=pytest.mark.slow)]
)
def test_faulty_individuals_are_counted(name: str) -> None:
    """``PointEnv`` is faulty far right; gradients do not lead out of the archive."""
    config = SMALL.replace(
        algorithm=name,
        iterations=6,
        options={"longest": 9.0}
        if name == "me-gradient"
        else {"points": 2, "sigma_g": 2.0},
    )
    result = run(config)
    assert result.metrics["rejected"].sum() > 0
    archive = result.archive
    assert np.isfinite(archive.genotypes).all()
    assert np.isfinite(archive.fitnesses[archive.filled]).all()


def test_lost_gradients_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    emit = GradientLineEmitter.emit

    def lossy(self: Any, *given: Any) -> Any:
        offspring, told = emit(self, *given)
        return offspring, {"overflowed": ~told["overflowed"]}

    monkeypatch.setattr(GradientLineEmitter, "emit", lossy)
    metrics = run(SMALL.replace(algorithm="me-gradient", iterations=2)).metrics
    # of two parents, in every generation but the first
    np.testing.assert_array_equal(metrics["rejected"], [0, 2, 2])


@pytest.mark.usefixtures("sigint")
@pytest.mark.slow
def test_a_checkpoint_of_another_emitter_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SMALL.replace(algorithm="cma-me", options={"emitters": 2}, iterations=2)
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        run(config, out=out)
    path = out / "checkpoint.bin"
    whole = load_checkpoint(path)
    assert whole.emitter
    longer = (np.append(whole.emitter[0], 0), *whole.emitter[1:])
    for emitter, message in (
        ((), "holds 0 arrays of the algorithm 'cma-me'"),
        (longer, r"array 0 of the algorithm 'cma-me' has shape \(\d+,\)"),
    ):
        save_checkpoint(path, type(whole)(**{**vars(whole), "emitter": emitter}))
        with pytest.raises(CheckpointError, match=message):
            run(config, out=out, resume=True)
