"""Tasks made by hand: names, limits and length of the descriptor."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, point_task, run

from newton_qd.qd import (
    ConfigError,
    EvolveConfig,
    Task,
    evolve,
    load_run,
    make_task,
)
from newton_qd.qd.run.cells import cell_centroids

CONFIG = EvolveConfig(
    env_name="pointmaze",
    iterations=1,
    batch_size=16,
    episode_length=5,
    hidden=(4,),
    centroids=8,
    reevaluations=1,
)


def latent(data: Any, mask: Any) -> Any:
    """A descriptor (N, 3) of whole episodes of exactly five steps."""
    seen = (data.state_desc * (1 - mask)[..., None]).reshape(len(mask), -1)
    return jnp.tanh(seen @ jnp.ones((10, 3)))


def task_of(config: EvolveConfig) -> Task:
    return dataclasses.replace(
        make_task(config),
        descriptor_extractor=latent,
        limits=(-np.ones(3, np.float32), np.ones(3, np.float32)),
        labels=("a", "b", "c"),
    )


@pytest.mark.parametrize(
    "name", ["me-actor-critic", "me-conditioned", "cma-maega-actor-critic", "dcrl-me"]
)
def test_steering_needs_the_length_of_the_state_descriptor(name: str) -> None:
    with pytest.raises(ConfigError, match=r"length 3; allowed: length 2, that of"):
        evolve(CONFIG.replace(algorithm=name), task_factory=task_of, progress=False)


@pytest.mark.parametrize("name", ["me", "me-es"])
@pytest.mark.parametrize("starts", [1, 2])
def test_descriptors_are_as_long_as_the_limits(name: str, starts: int) -> None:
    """JAX would broadcast a single component into both columns of the archive."""

    def task_of(config: EvolveConfig) -> Task:
        def single(data: Any, mask: Any) -> Any:
            return latent(data, mask)[:, :1]

        return dataclasses.replace(make_task(config), descriptor_extractor=single)

    config = CONFIG.replace(algorithm=name, starts=starts)
    with pytest.raises(ConfigError, match=r"of length 1; allowed: length 2, as the"):
        evolve(config, task_factory=task_of, progress=False)


def test_a_run_is_no_longer_than_the_episodes_of_its_environment() -> None:
    longer = CONFIG.replace(episode_length=6)
    with pytest.raises(
        ConfigError, match=r"^episode_length: got 6; allowed: at most 5"
    ):
        evolve(longer, task_factory=lambda _: task_of(CONFIG), progress=False)


def test_map_elites_takes_any_length() -> None:
    result = evolve(CONFIG, task_factory=task_of, progress=False)
    assert result.archive.filled.any()


@pytest.mark.parametrize("labels", [("left",), ("left", "right", "middle")])
def test_a_name_for_each_component(labels: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match=r"labels: got \d names, and limits of shape"):
        dataclasses.replace(point_task(SMALL), labels=labels)


@pytest.mark.parametrize("kind", [tuple, list])
def test_limits_may_be_sequences(kind: type) -> None:
    limits: Any = kind((kind((0, 0.0)), kind((1.0, 1))))
    task = dataclasses.replace(point_task(SMALL), limits=limits)
    assert cell_centroids(SMALL, task.limits, jax.random.key(0)).shape == (16, 2)
    for found, known in zip(task.limits, point_task(SMALL).limits, strict=True):
        assert found.dtype == known.dtype and found.tolist() == known.tolist()


@pytest.mark.parametrize(
    "limits", [None, (("a", "b"), (1, 2)), ((0, (0, 1)), (1, 1)), (None, None)]
)
def test_limits_that_are_no_numbers(limits: Any) -> None:
    with pytest.raises(ConfigError, match=r"^limits: got .*; allowed: lowest and"):
        dataclasses.replace(point_task(SMALL), limits=limits)


def test_traced_limits_are_refused() -> None:
    """The cells of an archive and the price of scatter need their values."""
    task = point_task(SMALL)

    def narrow(high: jax.Array) -> jax.Array:
        dataclasses.replace(task, limits=(jnp.zeros(2), high))
        return high

    with pytest.raises(ConfigError, match=r"limits: got .*jax.jit .*; allowed: values"):
        jax.jit(narrow)(jnp.ones(2))


def test_limits_of_one_length() -> None:
    limits = np.zeros(2, np.float32), np.ones(3, np.float32)
    with pytest.raises(ConfigError, match="labels: got 2 names"):
        dataclasses.replace(point_task(SMALL), limits=limits)


@pytest.mark.parametrize("cells", [{"grid": (4, 4)}, {"centroids": 8}])
def test_an_archive_belongs_to_one_descriptor(cells: Any, tmp_path: Path) -> None:
    small = SMALL.replace(**{"grid": None, **cells})

    def narrow(config: EvolveConfig) -> Task:
        limits = np.zeros(2, np.float32), np.full(2, 0.5, np.float32)
        return dataclasses.replace(point_task(config), limits=limits)

    def longer(config: EvolveConfig) -> Task:
        limits = np.zeros(3, np.float32), np.ones(3, np.float32)
        return dataclasses.replace(
            narrow(config), limits=limits, labels=("a", "b", "c")
        )

    run(small.replace(iterations=1), out=tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    for task_factory in (narrow, longer) if small.grid is None else (narrow,):
        with pytest.raises(ConfigError, match=r"got centres of cells from \[0\."):
            load_run(tmp_path, task_factory=task_factory)
        again = {"out": tmp_path, "resume": True, "progress": False}
        with pytest.raises(ConfigError, match=r"^checkpoint: got centres of cells"):
            evolve(small.replace(iterations=2), task_factory=task_factory, **again)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    assert load_run(tmp_path, task_factory=point_task).iteration == 1
