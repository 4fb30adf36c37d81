"""What the search says of an algorithm of a user that is not right."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.qd import EvolveConfig, Options, algorithms, make_task
from newton_qd.qd.algorithms.me import ME
from newton_qd.qd.config import ConfigError
from newton_qd.qd.run.folder import COLUMNS
from newton_qd.qd.run.plot import _fitness_label
from newton_qd.qd.run.search import Search, SearchError
from newton_qd.qd.scoring.task import Task

SETTINGS = EvolveConfig(
    env_name="pointmaze",
    algorithm="own",
    batch_size=8,
    centroids=16,
    episode_length=4,
    hidden=(4,),
    iterations=2,
)
Scores = tuple[jax.Array, jax.Array, dict[str, Any]]


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task(SETTINGS)


@pytest.fixture(autouse=True)
def forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(algorithms, "_REGISTERED", {})


def search(task: Task, change: Callable[[Scores], Any]) -> Search:
    """A search whose scores are made up, and then changed."""

    def scoring(*_: Any) -> Any:
        def score(genotypes: jax.Array, key: jax.Array) -> Any:
            del key
            scores = jnp.sum(genotypes, axis=1), jnp.clip(genotypes[:, :2], -1, 1), {}
            return change(scores)

        return score

    spec = dataclasses.replace(ME, name="own", scoring=scoring)
    algorithms.register_algorithm(spec)
    return Search(SETTINGS, task)


def test_a_descriptor_that_is_not_finite_enters_no_archive(task: Task) -> None:
    """Its fitness is finite, so only the descriptor says that it is rejected."""

    def change(scores: Scores) -> Scores:
        fitnesses, found, extra = scores
        return fitnesses.at[:3].set(1e3), found.at[:3, 1].set(jnp.inf), extra

    one = search(task, change)
    state = one.advance(one.advance(one.empty()))
    held = one.checkpoint(state)
    filled = jnp.isfinite(held.fitnesses)
    assert filled.any() and held.fitnesses[filled].max() < 1e3
    assert jnp.isfinite(held.descriptors[filled]).all()
    assert held.metrics[:, COLUMNS.index("rejected")].tolist() == [3, 3]
    # of given elites, those beyond one generation were counted by their fitness alone
    given = jax.random.normal(jax.random.key(0), (20, held.genotypes.shape[1]))
    state = one.advance(one.empty(np.asarray(given)))
    assert state.metrics[0, COLUMNS.index("rejected")] == 3 + 3 + 3


def test_weights_of_the_initial_population_are_scaled(task: Task) -> None:
    spec = dataclasses.replace(ME, name="own", initial_scale=lambda options: 0.0)
    algorithms.register_algorithm(spec)
    one = Search(SETTINGS, task)
    held = one.checkpoint(one.advance(one.empty()))
    assert np.isfinite(held.fitnesses).any() and not held.genotypes.any()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s: (s[0], s[1][:, :1], s[2]), "descriptors: got shape (8, 1); allowed"),
        (lambda s: (s[0][:, None], *s[1:]), "fitnesses: got shape (8, 1); allowed: sh"),
        (lambda s: s[:2], "'own': got a tuple of 2; allowed: fitnesses (N,), desc"),
        (lambda s: (*s[:2], None), "got a NoneType in the last place; allowed: fitne"),
    ],
)
def test_scores_of_a_wrong_shape_are_refused(
    change: Callable[[Scores], Any], text: str, task: Task
) -> None:
    one = search(task, change)
    with pytest.raises(ConfigError, match=re.escape(text)):
        one.advance(one.empty())


def test_scores_that_are_never_finite(task: Task) -> None:
    one = search(task, lambda s: (s[0] * jnp.nan, *s[1:]))
    with pytest.raises(SearchError, match="function of 'own' gives no individual of"):
        one.advance(one.empty())


@pytest.mark.parametrize(
    ("changed", "error", "text"),
    [
        (
            lambda genotypes, extra: (genotypes[:3], extra),
            ConfigError,
            r"'own': got genotypes of shape \(3, \d+\)",
        ),
        (
            lambda genotypes, extra: (genotypes[:, 1:], extra),
            ConfigError,
            r"'own': got genotypes of shape \(\d+, \d+\); allowed: \(\d+, \d+\)",
        ),
        (
            lambda genotypes, extra: genotypes,
            TypeError,
            r"Changed.emit: got .*; allowed: genotypes and a dictionary",
        ),
        (
            lambda genotypes, extra: (None, extra),
            TypeError,
            r"Changed.emit: genotypes: got None; allowed: an array \(N, size\)",
        ),
    ],
)
def test_an_emitter_that_proposes_otherwise_is_refused(
    changed: Any, error: type[Exception], text: str, task: Task
) -> None:
    def make(context: Any, options: Any) -> Any:
        emitter = ME.make(context, options)

        class Changed(type(emitter)):
            def emit(self, *arguments: Any) -> Any:
                return changed(*emitter.emit(*arguments))

        made = object.__new__(Changed)
        made.__dict__.update(vars(emitter))
        return made

    algorithms.register_algorithm(dataclasses.replace(ME, name="own", make=make))
    one = Search(SETTINGS, task)
    state = one.advance(one.empty())
    with pytest.raises(error, match=text):
        one.advance(state)


@pytest.mark.parametrize(
    ("part", "text"),
    [
        ({"make": None}, "spec.make: got None; allowed: a function"),
        ({"scoring": 3}, "spec.scoring: got 3; allowed: None, or a function"),
        ({"evaluations": 32}, "spec.evaluations: got 32; allowed: a function of set"),
        ({"gradients": 32}, "spec.gradients: got 32; allowed: None, or a function"),
        ({"from_one_start": 1}, "spec.from_one_start: got 1; allowed: None, or a f"),
        ({"initial_scale": 0.1}, "spec.initial_scale: got 0.1; allowed: a function"),
        ({"options": dict}, "spec.options: got <class 'dict'>; allowed: a dataclass"),
        ({"options": {"a": 1}}, "spec.options: got {'a': 1}; allowed: a dataclass"),
    ],
)
def test_a_part_of_a_wrong_type_is_refused(part: dict[str, Any], text: str) -> None:
    with pytest.raises(TypeError, match=text):
        algorithms.register_algorithm(dataclasses.replace(ME, name="own", **part))


@pytest.mark.parametrize(
    ("part", "error", "text"),
    [
        (
            {"make": lambda context, options: None},
            ConfigError,
            "make of 'own': got one that returned None; allowed: a function that",
        ),
        (
            {"scoring": lambda config, options, task, policy: None},
            TypeError,
            "scoring function of 'own': got None; allowed: a function of genotypes",
        ),
    ],
)
def test_a_part_that_makes_nothing_is_refused(
    part: dict[str, Any], error: type[Exception], text: str, task: Task
) -> None:
    algorithms.register_algorithm(dataclasses.replace(ME, name="own", **part))
    with pytest.raises(error, match=text):
        one = Search(SETTINGS, task)
        one.advance(one.empty())


def test_options_have_types_that_a_command_line_can_give() -> None:
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Named(Options):
        mode: str = "a"

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Good(Options):
        size: int | None = None
        rate: float = 0.5
        hidden: tuple[int, ...] = (4,)
        fast: bool = False
        names: ClassVar[tuple[str, ...]] = ("no", "option")

    def register(options: type[Options]) -> None:
        spec = dataclasses.replace(ME, name=options.__name__, options=options)
        algorithms.register_algorithm(spec)

    with pytest.raises(TypeError, match="mode: got a field of type <class 'str'>; all"):
        register(Named)
    register(Good)
    assert [spec.name for spec in algorithms.algorithms()][-1] == "Good"


@pytest.mark.parametrize("name", ["pga-me", "dcrl-me"])
def test_a_buffer_that_is_too_small_is_refused(name: str, task: Task) -> None:
    small = {"algorithm": name, "options": {"replay_buffer_size": 63}}
    with pytest.raises(ConfigError, match="size: got 63; allowed: integers from 64 "):
        Search(SETTINGS.replace(**small, starts=2), task)


def test_the_label_of_a_picture_says_what_the_fitness_is(task: Task) -> None:
    search(task, lambda scores: scores)
    assert _fitness_label(SETTINGS) == "fitness"
    label = "fitness: return over 4 control steps"
    assert _fitness_label(SETTINGS.replace(algorithm="me")) == label
    scattered = SETTINGS.replace(algorithm="me", starts=2, scatter=1.0)
    assert _fitness_label(scattered) == f"{label}, lowered by scatter"
