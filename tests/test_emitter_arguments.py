"""Wrong arguments of emitters are named where they are given."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import PointEnv
from qdax.core.emitters.emitter import Emitter

from newton_qd.qd import policy_of
from newton_qd.qd.emitters import (
    ActorCritic,
    ActorCriticEmitter,
    ActorCriticSettings,
    AscentEmitter,
    AsciiEmitter,
    CMAMEGAEmitter,
    ConditionedActorEmitter,
    EpisodeLearning,
    ExactAsciiEmitter,
    GradientLineEmitter,
    GradientsError,
    GradientVariationEmitter,
    Interpolation,
)
from newton_qd.qd.emitters.aims import ConditionedPolicy
from newton_qd.qd.scoring.rollout import make_policy

NOTHING: Any = None


class Sizes:
    """What a policy reads of an environment."""

    observation_size, action_size = 3, 1


def score(genotypes: Any, key: Any) -> Any:
    raise NotImplementedError


@pytest.mark.parametrize("optimizer", ["adam", None, 0.1])
def test_an_optimizer_is_one_of_optax(optimizer: Any) -> None:
    with pytest.raises(TypeError, match=r"optimizer: got .*; allowed: one of op"):
        GradientVariationEmitter(8, optimizer)


def test_arguments_of_an_arborescence() -> None:
    wrong: Any = "nope"
    with pytest.raises(TypeError, match="scoring_function: got None; allowed: a func"):
        CMAMEGAEmitter(NOTHING, sigma_g=0.1)
    with pytest.raises(ValueError, match=r"batch_size: got 2; allowed: .* from 3"):
        CMAMEGAEmitter(score, sigma_g=0.1, batch_size=2)
    with pytest.raises(ValueError, match="restart_period: got 2147483648; allowed: "):
        CMAMEGAEmitter(score, sigma_g=0.1, restart_period=2**31)
    with pytest.raises(TypeError, match="optimizer: got 'nope'; allowed: one of optax"):
        CMAMEGAEmitter(score, sigma_g=0.1, optimizer=wrong)
    with pytest.raises(ValueError, match="got 'nope'; allowed: no_improvement, basic"):
        CMAMEGAEmitter(score, sigma_g=0.1, restart_rule=wrong)


def test_weights_of_another_policy_are_named() -> None:
    env: Any = Sizes()
    policy = make_policy(env, (2,))
    with pytest.raises(ValueError, match=r"weights: got shape \(5,\); .*: \(11,\)"):
        policy.of_weights(jnp.zeros(5), jnp.zeros(3))


def nothing(*given: Any) -> Any:
    raise NotImplementedError


def learning(**changes: Any) -> ActorCritic:
    given = {"env": PointEnv(), "policy": nothing, "measure": nothing}
    given |= {"episode_length": 5, "settings": ActorCriticSettings()}
    return ActorCritic(**{**given, **changes})


def actors(**changes: Any) -> Emitter:
    given: Any = {"method": learning(), "first": NOTHING, "actors": 2, "branches": 1}
    given |= {"updates": 1, "measures": 2}
    return ActorCriticEmitter(**{**given, **changes})


def conditioned(**changes: Any) -> Emitter:
    env: Any = Sizes()
    policy = ConditionedPolicy(make_policy(env, (2,)), 2)
    given: Any = {"method": learning(), "env": NOTHING, "policy": policy}
    given |= {"first": NOTHING, "copies": 1, "between": 1, "updates": 1}
    return ConditionedActorEmitter(**{**given, **changes})


def ascii_exact(**changes: Any) -> Emitter:
    given: Any = {"policy": nothing, "rollout": nothing, "gradient": nothing}
    given |= {"settings": Interpolation(), "parents": 2, "branches": 1}
    return ExactAsciiEmitter(**{**given, **changes})


def episodes(**changes: Any) -> EpisodeLearning:
    given = {"method": learning(), "env": PointEnv(), "after": 1, "updates": 1}
    return EpisodeLearning(**{**given, "weight_noise": 0.1, **changes})


@pytest.mark.parametrize(
    ("make", "name", "value", "allowed"),
    [
        (actors, "method", PointEnv(), "an ActorCritic"),
        (actors, "later", 3, "None, or an EpisodeLearning"),
        (actors, "fitness", "0.1", "finite numbers"),
        (actors, "spread", 0.1, "two numbers, 0 < smallest <= largest"),
        (conditioned, "method", None, "an ActorCritic"),
        (conditioned, "policy", nothing, "a ConditionedPolicy"),
        (conditioned, "spread", (0.1,), "two numbers, 0 < smallest <= largest"),
        (conditioned, "conditioned", "no", "True, False"),
        (ascii_exact, "policy", None, "a function of weights and an observation"),
        (ascii_exact, "rollout", 3, "a function of genotypes and a key"),
        (ascii_exact, "gradient", None, "a function, such as Episode.gradient"),
        (ascii_exact, "settings", {}, "an Interpolation"),
        (ascii_exact, "rates", None, "two numbers, 0 < smallest <= largest"),
        (learning, "env", "ant_uni", "an environment, as create"),
        (learning, "policy", 3, "a function of weights and an observation"),
        (learning, "measure", None, "a function of the states before and after"),
        (learning, "settings", {}, "an ActorCriticSettings"),
        (learning, "whitening", None, "a Whitening"),
        (episodes, "method", nothing, "an ActorCritic"),
        (episodes, "env", None, "an environment, as create"),
        (episodes, "averaged", "no", "True, False"),
    ],
)
def test_arguments_of_a_wrong_type_are_named(
    make: Callable[..., Any], name: str, value: Any, allowed: str
) -> None:
    """Where the emitter is built, not deep in a trace of it."""
    with pytest.raises(TypeError, match=f"^{name}: got .*; allowed: {allowed}"):
        make(**{name: value})


@pytest.mark.parametrize("kind", [list, np.array, np.float32])
def test_a_range_may_be_any_pair(kind: Callable[..., Any]) -> None:
    actors(spread=kind([0.1, 0.2]))


@pytest.mark.parametrize(
    ("spread", "text"),
    [
        ((0.2, 0.1), r"spread: got \(0.2, 0.1\); allowed: two numbers, 0 < s"),
        ((0.0, 0.1), r"spread\[0\]: got 0.0; allowed: finite numbers above 0"),
        ((0.1, float("inf")), r"spread\[1\]: got inf; allowed: finite numbers above 0"),
    ],
)
def test_a_range_is_one_of_finite_sizes(spread: tuple[float, float], text: str) -> None:
    for make in (actors, conditioned):
        with pytest.raises(ValueError, match=f"^{text}"):
            make(spread=spread)


STEPS: Any = {"shortest": 0.1, "longest": 0.2}
SHARED: dict[str, Callable[[], Emitter]] = {
    "actors": actors,
    "conditioned": conditioned,
    "ascent": lambda: AscentEmitter(nothing, climbers=2, lifetime=2, **STEPS),
    "ascii": lambda: AsciiEmitter(
        nothing, Interpolation(), batch_size=2, episode_length=5
    ),
    "ascii_exact": ascii_exact,
    "line": lambda: GradientLineEmitter(nothing, parents=2, branches=1, **STEPS),
}


@pytest.mark.parametrize("name", SHARED)
def test_parameters_of_a_network_are_no_genotypes(name: str) -> None:
    """As QDax's own emitters take them; ours need one vector."""
    tree, cells, emitter = {"w": jnp.zeros((4, 3))}, jnp.zeros((4, 2)), SHARED[name]()
    held: Any = SimpleNamespace(
        genotypes=tree,
        fitnesses=jnp.zeros((4, 1)),
        descriptors=cells,
        centroids=cells,
    )
    told = held, tree, jnp.zeros(4), cells, {}
    with pytest.raises(GradientsError, match=r"genotypes: got .*'w'.*: one array \(N"):
        emitter.init(jax.random.key(0), *told)
        emitter.emit(held, None, jax.random.key(0))


def test_measures_are_as_many_as_the_descriptor_has() -> None:
    told: Any = jnp.zeros((4, 3)), jnp.zeros(4), jnp.zeros((4, 2)), {}
    with pytest.raises(ValueError, match="measures: got 3; allowed: 2, the length of"):
        actors(measures=3).init(jax.random.key(0), NOTHING, *told)
    with pytest.raises(ValueError, match="measures: got 0; allowed: "):
        actors(measures=0)


def test_a_target_needs_a_first_layer_that_is_known() -> None:
    env: Any = Sizes()
    policy = policy_of(env, nn.Sequential([nn.Dense(2), jnp.tanh, nn.Dense(1)]))
    with pytest.raises(ValueError, match=r"policy: got Sequential; .* of make_policy"):
        ConditionedPolicy(policy, 2)
