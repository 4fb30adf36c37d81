"""Wrong arguments of emitters are named where they are given."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import pytest

from newton_qd.qd.emitters import CMAMEGAEmitter, GradientVariationEmitter
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
