"""A tiny task without physics, and runs on it, for the tests of ``evolve``."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd import files
from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.run.evolve_result import EvolveResult
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.task import Task

evolve_module = sys.modules[evolve.__module__]

TESTS = Path(__file__).resolve().parent

FILES = ("archive.npz", "archive.png", "checkpoint.bin", "config.json", "metrics.csv")

SMALL = EvolveConfig(
    env_name="point",
    iterations=12,
    batch_size=16,
    episode_length=9,
    hidden=(4,),
    grid=(4, 4),
    reevaluations=0,
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointState:
    pipeline_state: jax.Array
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    info: dict[str, jax.Array]


class PointEnv:
    """A point that is pushed about; ``done`` outside a circle, faulty far right."""

    observation_size = 3
    action_size = 2
    fault_beyond = 1.5

    def reset(self, rng: jax.Array) -> PointState:
        position = jax.random.uniform(rng, (2,), jnp.float32, -0.1, 0.1)
        return self._state(position, jnp.zeros((), jnp.float32))

    def step(self, state: PointState, action: jax.Array) -> PointState:
        position = state.pipeline_state + jnp.float32(0.3) * action
        reward = 1.0 - jnp.sum(jnp.square(position - jnp.float32(0.5)))
        return self._state(position, reward)

    def _state(self, position: jax.Array, reward: jax.Array) -> PointState:
        bias = jnp.ones((1,), jnp.float32)
        return PointState(
            pipeline_state=position,
            obs=jnp.concatenate([position, bias]),
            reward=reward,
            done=(jnp.sum(jnp.square(position)) > 4.0).astype(jnp.float32),
            info={
                "state_descriptor": (position > 0.2).astype(jnp.float32),
                "fault": (position[0] > self.fault_beyond).astype(jnp.int32),
            },
        )


def point_task(config: EvolveConfig, env: Any = None) -> Task:
    del config
    return Task(
        env=PointEnv() if env is None else env,
        descriptor_extractor=get_feet_contact_proportion,
        limits=(np.zeros(2, np.float32), np.ones(2, np.float32)),
        labels=("left", "right"),
        reward_offset=5.0,
    )


def run(config: EvolveConfig = SMALL, **options: Any) -> EvolveResult:
    options = {"progress": False, "checkpoint_seconds": 0.0, **options}
    return evolve(config, task_factory=point_task, **options)


_MADE: dict[tuple[EvolveConfig, bool], Search] = {}


@pytest.fixture(scope="module", autouse=True)
def compile_once() -> Iterator[None]:
    """Share compiled functions between runs with the same settings."""

    def search(config: EvolveConfig, task: Task, mesh: Any) -> Search:
        key = (config, bool(jax.config.read("jax_enable_x64")))
        if type(task.env) is not PointEnv or mesh is not None:
            return Search(config, task, mesh)
        return _MADE.setdefault(key, _MADE.get(key) or Search(config, task))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evolve_module, "Search", search)
        yield


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("reference") / "run"
    assert not run(out=out).interrupted
    return out


def assert_same_results(out: Path, expected: Path) -> None:
    for name in FILES:
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name
    names = sorted(entry.name for entry in expected.iterdir())
    assert set(FILES) <= set(names)
    assert sorted(entry.name for entry in out.iterdir()) == names


def interrupt_after(
    monkeypatch: pytest.MonkeyPatch, generation: int, number: int = signal.SIGINT
) -> None:
    advance = Search.advance

    def advance_and_signal(self: Search, state: Any) -> Any:
        state = advance(self, state)
        if state.iteration == generation:
            os.kill(os.getpid(), number)
        return state

    monkeypatch.setattr(Search, "advance", advance_and_signal)


def writes_of(
    config: EvolveConfig, out: Path, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    written: list[str] = []
    replace = os.replace
    with monkeypatch.context() as patch:
        patch.setattr(
            files.os,
            "replace",
            lambda a, b: (written.append(str(b)), replace(a, b)),
        )
        run(config, out=out)
    return written


def copy(folder: Path, tmp_path: Path) -> Path:
    out = tmp_path / "copy"
    out.mkdir()
    for entry in folder.iterdir():
        (out / entry.name).write_bytes(entry.read_bytes())
    return out


def snapshot(folder: Path) -> dict[str, bytes]:
    return {entry.name: entry.read_bytes() for entry in folder.iterdir()}


def damage(content: bytes) -> dict[str, bytes]:
    positions = np.random.default_rng(0).integers(0, len(content), 30)
    flipped = {
        f"byte {i}": content[:i] + bytes([content[i] ^ 1]) + content[i + 1 :]
        for i in [0, 5, 30, *positions]
    }
    return {
        "empty": b"",
        "half": content[: len(content) // 2],
        "longer": content + b"\0",
        "other file": b"PK\3\4 something else",
        **flipped,
    }
