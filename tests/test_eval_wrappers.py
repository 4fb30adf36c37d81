"""Wrappers that sum the rewards and metrics of episodes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from line_env import KEY, Line, play

from newton_qd.envs.state import State
from newton_qd.types import Params
from newton_qd.wrappers import (
    AutoResetWrapper,
    CompletedEvalMetrics,
    CompletedEvalWrapper,
    EpisodeWrapper,
    EvalMetrics,
    EvalWrapper,
    Wrapper,
)


def test_eval_sums_the_first_episode_only() -> None:
    env = EvalWrapper(AutoResetWrapper(EpisodeWrapper(Line(), 3, 1)))
    states = play(env, 5)
    sums = [state.info["eval_metrics"] for state in states]
    assert isinstance(sums[0], EvalMetrics)
    assert [float(s.active_episodes) for s in sums] == [1, 1, 1, 0, 0, 0]
    assert [float(s.episode_steps) for s in sums] == [0, 1, 2, 3, 3, 3]
    assert [float(s.episode_metrics["moved"]) for s in sums] == [0, 1, 2, 3, 3, 3]
    expected = sum(float(state.reward) for state in states[1:4])
    np.testing.assert_allclose(sums[5].episode_metrics["reward"], expected, rtol=1e-6)


class NotFinite(Line):
    """A line whose numbers are not finite after the end."""

    def step(self, state: State, action: jax.Array, params: Params = None) -> State:
        over = state.done > 0
        state = super().step(state, action, params)
        reward = jnp.where(over, jnp.nan, jnp.float32(1))
        moved = jnp.where(over, jnp.inf, state.metrics["moved"])
        metrics = {**state.metrics, "moved": moved}
        return state.replace(reward=reward, metrics=metrics)


def test_what_is_not_finite_after_the_end_is_not_summed() -> None:
    env = EvalWrapper(EpisodeWrapper(NotFinite(), 3, 1))
    last = play(env, 6)[-1]
    assert np.isnan(last.reward)
    sums = last.info["eval_metrics"].episode_metrics
    assert float(sums["reward"]) == 3.0 and float(sums["moved"]) == 3.0


def test_completed_eval_counts_each_step_once() -> None:
    env = CompletedEvalWrapper(AutoResetWrapper(EpisodeWrapper(Line(), 3, 1)))
    states = play(env, 8)
    sums = [state.info["completed_eval_metrics"] for state in states]
    assert isinstance(sums[0], CompletedEvalMetrics)
    episodes = [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert [float(s.completed_episodes) for s in sums] == episodes
    assert [float(s.completed_episodes_steps) for s in sums] == [
        3 * n for n in episodes
    ]
    moved = [float(s.completed_episodes_metrics["moved"]) for s in sums]
    assert moved == [3.0 * n for n in episodes]
    running = [float(s.current_episode_metrics["moved"]) for s in sums]
    assert running == [0, 1, 2, 0, 1, 2, 0, 1, 2]


class Fragile(Line):
    """A line with rewards below 0, until a fault beyond 5 ends the episode."""

    def step(self, state: State, action: jax.Array, params: Params = None) -> State:
        state = super().step(state, action, params)
        fault = state.pipeline_state > 5
        return state.replace(
            reward=jnp.where(fault, jnp.float32(0), jnp.float32(-1)),
            done=fault.astype(np.float32),
            info={**state.info, "fault": fault.astype(np.int32)},
        )


@pytest.mark.parametrize("wrapper", [EvalWrapper, CompletedEvalWrapper])
def test_no_fault_pays_in_an_evaluation(wrapper: type[Wrapper]) -> None:
    env = wrapper(AutoResetWrapper(EpisodeWrapper(Fragile(), 3, 1)))
    name = "episode_metrics" if wrapper is EvalWrapper else "completed_episodes_metrics"
    key = "eval_metrics" if wrapper is EvalWrapper else "completed_eval_metrics"
    for action, total in ((1.0, -3.0), (9.0, -np.inf)):
        sums = getattr(play(env, 3, action)[-1].info[key], name)
        assert float(sums["reward"]) == total and np.isfinite(sums["moved"])


def test_a_fault_after_the_first_episode_costs_nothing() -> None:
    env = EvalWrapper(EpisodeWrapper(Fragile(), 3, 1))
    last = play(env, 7)[-1]
    assert last.info["fault"] == 1
    assert last.info["eval_metrics"].episode_metrics["reward"] == -3


class Unmeasured(Line):
    """A line whose metric is not known beyond 1.6."""

    def step(self, state: State, action: jax.Array, params: Params = None) -> State:
        after = super().step(state, action, params)
        moved = jnp.where(after.pipeline_state > 1.6, jnp.nan, jnp.float32(1))
        return after.replace(metrics={"moved": moved})


@pytest.mark.parametrize("end", [1.2, 100.0])
def test_a_metric_that_is_not_known_within_an_episode_has_no_sum(end: float) -> None:
    states = play(EvalWrapper(EpisodeWrapper(Unmeasured(end), 10, 1)), 4)
    total = states[-1].info["eval_metrics"].episode_metrics["moved"]
    assert np.isnan(total) == (end > 50)


@pytest.mark.parametrize("wrapper", [EvalWrapper, CompletedEvalWrapper])
def test_eval_refuses_what_it_cannot_sum(
    wrapper: type[EvalWrapper] | type[CompletedEvalWrapper],
) -> None:
    with pytest.raises(ValueError, match=r"steps.*EpisodeWrapper"):
        wrapper(Line()).reset(KEY)
    env = wrapper(EpisodeWrapper(Line(), 3, 1))
    state = env.reset(KEY)
    state = state.replace(info={**state.info, env.STATE_INFO_KEY: {}})
    with pytest.raises(ValueError, match=r"Incorrect type for state_metrics.*dict"):
        env.step(state, jnp.ones(1))


def test_eval_leaves_the_old_state_alone() -> None:
    env = CompletedEvalWrapper(EvalWrapper(EpisodeWrapper(Line(), 3, 1)))
    state = env.reset(KEY)
    keys = (set(state.info), set(state.metrics))
    first = env.step(state, jnp.ones(1))
    assert (set(state.info), set(state.metrics)) == keys
    assert env.step(state, jnp.ones(1)).obs == first.obs


def test_without_auto_reset_an_episode_ends_once() -> None:
    env = CompletedEvalWrapper(EpisodeWrapper(Line(), 3, 1))
    sums = [state.info["completed_eval_metrics"] for state in play(env, 5)]
    assert [float(s.completed_episodes) for s in sums] == [0, 0, 0, 1, 1, 1]
    assert [float(s.completed_episodes_steps) for s in sums] == [0, 0, 0, 3, 3, 3]
    assert float(sums[-1].completed_episodes_metrics["moved"]) == 3.0
    assert float(sums[-1].current_episode_metrics["moved"]) == 0.0


def test_worlds_may_be_reset_outside_of_the_sums() -> None:
    env = AutoResetWrapper(CompletedEvalWrapper(EpisodeWrapper(Line(), 3, 1)))
    sums = [state.info["completed_eval_metrics"] for state in play(env, 8)]
    episodes = [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert [float(s.completed_episodes) for s in sums] == episodes


@pytest.mark.parametrize("wrapper", [EvalWrapper, CompletedEvalWrapper])
def test_a_state_without_sums_is_named(
    wrapper: type[EvalWrapper] | type[CompletedEvalWrapper],
) -> None:
    inside = EpisodeWrapper(Line(), 3, 1)
    with pytest.raises(ValueError, match=r"state: got info without '.*eval_metrics'"):
        wrapper(inside).step(inside.reset(KEY), jnp.ones(1))
