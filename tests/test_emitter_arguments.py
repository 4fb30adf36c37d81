"""Wrong arguments of emitters are named where they are given."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import pytest
from qdax.core.emitters.emitter import Emitter

from newton_qd.qd import policy_of
from newton_qd.qd.emitters import (
    ActorCriticEmitter,
    AscentEmitter,
    AsciiEmitter,
    CMAMEGAEmitter,
    ConditionedActorEmitter,
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


def actors(measures: int = 2) -> Emitter:
    return ActorCriticEmitter(
        NOTHING, NOTHING, actors=2, branches=1, updates=1, measures=measures
    )


def conditioned() -> Emitter:
    more: Any = {"copies": 1, "between": 1, "updates": 1}
    return ConditionedActorEmitter(NOTHING, NOTHING, NOTHING, NOTHING, **more)


STEPS: Any = {"shortest": 0.1, "longest": 0.2}
SHARED: dict[str, Callable[[], Emitter]] = {
    "actors": actors,
    "conditioned": conditioned,
    "ascent": lambda: AscentEmitter(nothing, climbers=2, lifetime=2, **STEPS),
    "ascii": lambda: AsciiEmitter(
        nothing, Interpolation(), batch_size=2, episode_length=5
    ),
    "ascii_exact": lambda: ExactAsciiEmitter(
        nothing, nothing, nothing, Interpolation(), parents=2, branches=1
    ),
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
        actors(3).init(jax.random.key(0), NOTHING, *told)
    with pytest.raises(ValueError, match="measures: got 0; allowed: "):
        actors(0)


def test_a_target_needs_a_first_layer_that_is_known() -> None:
    env: Any = Sizes()
    policy = policy_of(env, nn.Sequential([nn.Dense(2), jnp.tanh, nn.Dense(1)]))
    with pytest.raises(ValueError, match=r"policy: got Sequential; .* of make_policy"):
        ConditionedPolicy(policy, 2)
