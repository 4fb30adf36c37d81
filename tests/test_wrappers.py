"""What each wrapper adds, on an environment that can be reckoned by hand."""

from __future__ import annotations

import copy
import pickle
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from line_env import KEY, Line, column, play

import newton_qd
from newton_qd import brax_views, memory, wrappers
from newton_qd.envs.ant import Ant
from newton_qd.envs.state import State
from newton_qd.types import Params
from newton_qd.wrappers import (
    AutoResetWrapper,
    CompletedEvalWrapper,
    DescriptorWrapper,
    EpisodeWrapper,
    EvalWrapper,
    FeetContactWrapper,
    FixedInitialStateWrapper,
    StateDescriptorResetWrapper,
    VectorWrapper,
    Wrapper,
)


def test_wrapper_forwards_everything() -> None:
    line = Line()
    env = Wrapper(Wrapper(line))
    assert env.unwrapped is line
    assert (env.observation_size, env.action_size, env.dt) == (1, 1, 0.5)
    assert (env.dtype, env.name) == (np.float32, "line")
    assert Wrapper(VectorWrapper(line, 3)).batch_size == 3
    for missing in ("colour", "_end", "__setstate__"):
        with pytest.raises(AttributeError, match=missing):
            getattr(env, missing)
    assert copy.copy(env).env is env.env
    assert pickle.loads(pickle.dumps(env)).env.env.dt == 0.5


class Broken(Wrapper):
    """A property of it has a spelling mistake."""

    @property
    def colour(self) -> str:
        return self._paint.name


def test_an_error_inside_a_property_names_its_cause() -> None:
    for env in (Broken(Line()), Wrapper(Broken(Line()))):
        with pytest.raises(AttributeError) as caught:
            env.colour  # noqa: B018
        assert "inside of the property Broken.colour: " in str(caught.value)
        assert "has no attribute '_paint'" in str(caught.value)
        assert not hasattr(env, "colour")


def test_params_reach_the_environment_through_every_wrapper() -> None:
    env = EpisodeWrapper(StateDescriptorResetWrapper(Wrapper(Line())), 9, 2)
    env = CompletedEvalWrapper(EvalWrapper(AutoResetWrapper(VectorWrapper(env, 2))))
    state = jax.jit(env.reset)(KEY)
    speed = jnp.array([1.0, 10.0], np.float32)
    moved = jax.jit(env.step)(state, jnp.ones((2, 1), np.float32), speed)
    np.testing.assert_allclose(moved.obs - state.obs, [[2.0], [20.0]], rtol=1e-5)


@pytest.mark.parametrize("key", [KEY, jax.random.PRNGKey(0)], ids=["typed", "uint32"])
def test_episode_counts_from_zero(key: jax.Array) -> None:
    state = EpisodeWrapper(Line(), 3, 1).reset(key)
    assert state.info["steps"].shape == state.info["truncation"].shape == ()
    batch = jax.vmap(EpisodeWrapper(Line(), 3, 1).reset)(jax.random.split(key, 4))
    assert batch.info["steps"].tolist() == [0.0] * 4
    assert batch.info["truncation"].dtype == np.float32


def test_episode_ends_by_its_length() -> None:
    states = play(AutoResetWrapper(EpisodeWrapper(Line(), 3, 1)), 5)
    assert column(states, "steps") == [1, 2, 3, 1, 2]
    assert column(states, "truncation") == [0, 0, 1, 0, 0]
    assert [float(s.done) for s in states[1:]] == [0, 0, 1, 0, 0]
    assert states[3].obs == states[0].info["first_obs"]


def test_episode_repeats_actions() -> None:
    env = EpisodeWrapper(Line(), 5, 2)
    assert env.dt == 1.0
    states = play(env, 3)
    assert column(states, "steps") == [2, 4, 6]
    assert column(states, "truncation") == [0, 0, 1]
    start = float(states[0].obs[0])
    np.testing.assert_allclose(states[1].reward, 2 * start + 1 + 2, rtol=1e-6)
    np.testing.assert_allclose(states[1].obs, [start + 2], rtol=1e-6)
    assert float(states[1].metrics["moved"]) == 1.0


def test_an_end_on_the_last_step_is_no_truncation() -> None:
    states = play(EpisodeWrapper(Line(end=2.0), 3, 1), 3)
    assert [float(s.done) for s in states[1:]] == [0, 1, 1]
    assert column(states, "truncation") == [0, 0, 0]


def test_steps_stand_still_at_a_fault() -> None:
    env = EpisodeWrapper(Line(), 9, 1)
    state = env.step(env.reset(KEY), jnp.ones(1))
    broken = state.replace(info={**state.info, "fault": jnp.ones((), np.int32)})
    assert float(env.step(broken, jnp.ones(1)).info["steps"]) == 1.0


class Failing(Line):
    """At fault from a step beyond the end on."""

    def step(self, state: State, action: jax.Array, params: Params = None) -> State:
        after = super().step(state, action, params)
        beyond = after.pipeline_state > self._end
        fault = (beyond | (state.info["fault"] > 0)).astype(np.int32)
        return after.replace(info={**after.info, "fault": fault})


@pytest.mark.parametrize("repeat", [1, 2])
def test_the_step_of_a_fault_counts(repeat: int) -> None:
    states = play(EpisodeWrapper(Failing(end=2.6), 20, repeat), 4)
    assert column(states, "steps")[-1] == 3


@pytest.mark.parametrize("value", [0, -1, 2.5, None, True])
def test_counts_must_be_positive_integers(value: int) -> None:
    with pytest.raises(ValueError, match=r"episode_length: got .*integers from 1"):
        EpisodeWrapper(Line(), value, 1)
    with pytest.raises(ValueError, match=r"action_repeat: got .*integers from 1"):
        EpisodeWrapper(Line(), 5, value)
    with pytest.raises(ValueError, match=r"batch_size: got .*integers from 1"):
        VectorWrapper(Line(), value)


def test_worlds_that_cannot_fit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "limit", lambda device: 10**10)
    text = "batch_size: got 2000000000, which needs at least 56 GB; allowed: sizes that"
    with pytest.raises(ValueError, match=f"{text} fit in the 10 GB of memory here"):
        VectorWrapper(Line(), 2_000_000_000)
    assert VectorWrapper(Line(), 200_000).batch_size == 200_000


def test_memory_is_that_of_the_device_of_new_arrays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not that of the first device, also while a function is traced."""
    asked = []
    monkeypatch.setattr(memory, "limit", asked.append)
    (where,) = jax.device_put(0.0).devices()
    monkeypatch.setattr(jax, "devices", None)
    jax.eval_shape(lambda: memory.limit_here())
    VectorWrapper(Line(), 200_000)
    assert asked == [where, where]


def test_vector_makes_worlds_and_steps_any_number() -> None:
    env = VectorWrapper(Line(), 3)
    state = env.reset(KEY)
    assert env.batch_size == 3
    assert all(leaf.shape[0] == 3 for leaf in jax.tree.leaves(state))
    expected = [Line().reset(key).obs for key in jax.random.split(KEY, 3)]
    assert state.obs.tolist() == jnp.stack(expected).tolist()
    two = jax.tree.map(lambda x: x[:2], state)
    assert env.step(two, jnp.ones((2, 1))).obs.shape == (2, 1)


def test_auto_reset_returns_to_the_first_state() -> None:
    states = play(AutoResetWrapper(Line(end=2.0)), 3)
    first, done = states[0], states[2]
    assert float(done.done) == 1.0
    assert float(done.reward) > 2.0
    assert float(done.metrics["moved"]) == 1.0
    for part in (done.pipeline_state, done.obs, done.info["state_descriptor"]):
        assert part == first.pipeline_state
    assert states[3].obs == states[1].obs
    assert float(states[3].done) == 0.0


def test_auto_reset_is_per_world() -> None:
    env = AutoResetWrapper(VectorWrapper(Line(end=2.0), 2))
    state = env.reset(KEY)
    after = env.step(state, jnp.array([[1.0], [3.0]], np.float32))
    assert after.done.tolist() == [0, 1]
    assert after.obs[0] > 1
    assert after.obs[1] == state.obs[1]


def test_auto_reset_clears_the_fault_at_the_next_step() -> None:
    env = AutoResetWrapper(EpisodeWrapper(Line(end=2.0), 9, 1))
    state = play(env, 2)[-1]
    assert float(state.done) == 1.0
    broken = state.replace(info={**state.info, "fault": jnp.ones((), np.int32)})
    healed = env.step(broken, jnp.ones(1, np.float32))
    assert int(healed.info["fault"]) == 0
    assert healed.info["fault"].dtype == np.int32
    assert float(healed.info["steps"]) == 1.0


class Sticky(Line):
    """A line on which what is done stays done."""

    def step(self, state: State, action: jax.Array, params: Params = None) -> State:
        after = super().step(state, action, params)
        return after.replace(done=jnp.maximum(after.done, state.done))


def test_auto_reset_clears_the_end_at_the_next_step() -> None:
    states = play(AutoResetWrapper(EpisodeWrapper(Sticky(), 2, 1)), 4)
    assert [float(state.done) for state in states] == [0, 0, 1, 0, 1]


class Corners(DescriptorWrapper):
    """A descriptor of whole numbers."""

    limits = ((0, 0), (1, 1))

    def describe(self, state: State) -> Any:
        return [0, 1]


def test_a_descriptor_has_the_type_of_its_environment() -> None:
    found = Corners(Line(), "line").reset(KEY).info["state_descriptor"]
    assert found.dtype == np.float32 and found.tolist() == [0, 1]


def test_a_second_descriptor_of_another_length_is_refused() -> None:
    """It was accepted, and the first step named the state of another environment."""
    env = Corners(newton_qd.create("ant_uni", auto_reset=False), "ant_uni")
    with pytest.raises(
        ValueError, match=r"^env: got .*FeetContactWrapper, of length 4"
    ):
        env.reset(KEY)
    again = Corners(Corners(Line(), "line"), "line")
    assert again.reset(KEY).info["state_descriptor"].tolist() == [0, 1]


class Place(Corners):
    """A descriptor that is the observation itself."""

    limits = ((0,), (1,))

    def describe(self, state: State) -> Any:
        return state.obs


@pytest.mark.parametrize(
    "env", [StateDescriptorResetWrapper(Line()), Place(Line(), "line")]
)
def test_wrappers_store_copies(env: Wrapper) -> None:
    """A state with one buffer twice cannot be donated to a jitted step."""
    leaves = jax.tree.leaves(env.reset(KEY))
    assert len({id(leaf) for leaf in leaves}) == len(leaves)


def test_state_descriptor_reset_touches_only_the_descriptor() -> None:
    states = play(StateDescriptorResetWrapper(Line(end=2.0)), 2)
    assert states[2].info["state_descriptor"] == states[0].info["state_descriptor"]
    assert states[2].obs > 2.0
    with pytest.raises(KeyError, match=r"state_descriptor.*FeetContactWrapper"):
        StateDescriptorResetWrapper(Ant()).reset(KEY)


def test_fixed_initial_state_goes_inside_all_wrappers() -> None:
    ant = Ant()
    expected = ant.fixed_state().obs.tolist()
    assert FixedInitialStateWrapper(ant).reset(KEY).obs.tolist() == expected
    inside = AutoResetWrapper(EpisodeWrapper(VectorWrapper(ant, 2), 1, 1))
    env = FixedInitialStateWrapper(inside, "ant")
    assert env.unwrapped is ant and env.batch_size == 2
    state = jax.jit(env.reset)(KEY)
    assert state.obs.tolist() == state.info["first_obs"].tolist() == [expected] * 2
    ended = jax.jit(env.step)(state, jnp.ones((2, 8), np.float32))
    assert ended.done.tolist() == [1, 1] and ended.obs.tolist() == [expected] * 2
    # the environment that was given is as it was
    assert jax.jit(inside.reset)(KEY).obs[0].tolist() != expected


def test_fixed_initial_state_needs_one() -> None:
    for env in (Line(), EpisodeWrapper(Line(), 3, 1)):
        with pytest.raises(
            NotImplementedError, match=r"^This wrapper does not support line yet\."
        ):
            FixedInitialStateWrapper(env, "line")


def test_with_base_keeps_the_wrappers() -> None:
    env: Any = AutoResetWrapper(EpisodeWrapper(Line(), 3, 1))
    changed: Any = env.with_base(lambda base: VectorWrapper(base, 2))
    assert [type(e) for e in (changed, changed.env, changed.env.env)] == [
        AutoResetWrapper,
        EpisodeWrapper,
        VectorWrapper,
    ]
    assert changed.unwrapped is env.unwrapped and env.env.env is env.unwrapped


@pytest.mark.parametrize("env", [None, "ant", Ant])
@pytest.mark.parametrize(
    "wrap",
    [
        wrappers.QDWrapper,
        wrappers.FixedInitialStateWrapper,
        brax_views.FixedInitialStateWrapper,
        lambda env: wrappers.FeetContactWrapper(env, "ant"),
        lambda env: wrappers.MazeWrapper(env, "ant"),
        lambda env: wrappers.NoForwardRewardWrapper(env, "ant"),
        lambda env: wrappers.RandomParamsWrapper(env, friction=(0.5, 1)),
        lambda env: wrappers.TrapWrapper(env, "ant"),
        lambda env: wrappers.XYPositionWrapper(env, "ant"),
    ],
)
def test_a_wrapper_is_around_an_environment(wrap: Any, env: Any) -> None:
    """Not around its name or its class; before, a missing attribute was the error."""
    with pytest.raises(TypeError, match=r"^env: got .*; allowed: an environment, as"):
        wrap(env)


def test_feet_contact_is_a_state_descriptor() -> None:
    env = FeetContactWrapper(Ant(), "ant")
    assert (env.state_descriptor_length, env.descriptor_length) == (4, 4)
    assert env.behavior_descriptor_length == 4
    assert env.state_descriptor_name == "feet_contact"
    low, high = env.behavior_descriptor_limits
    assert (low.tolist(), high.tolist()) == ([0.0] * 4, [1.0] * 4)
    state = jax.jit(env.reset)(KEY)
    assert state.info["state_descriptor"].tolist() == [0.0] * 4
    step = jax.jit(env.step)
    for _ in range(20):
        state = step(state, jnp.zeros(8, np.float32))
    assert state.info["state_descriptor"].tolist() == [1.0] * 4


def test_feet_contact_can_be_smooth() -> None:
    env = newton_qd.create("ant_uni", qdax_wrappers_kwargs=[{"smooth_width": 0.1}])
    state = jax.jit(env.reset)(KEY)
    np.testing.assert_allclose(
        state.info["state_descriptor"], 1 / (1 + np.exp(0.1)), rtol=1e-6
    )
    with pytest.raises(ValueError, match=r"smooth_width: got 0.*above 0"):
        FeetContactWrapper(Ant(), "ant", smooth_width=0.0)
    with pytest.raises(
        ValueError, match=r"smooth_width: got inf; allowed: None, or fin"
    ):
        FeetContactWrapper(Ant(), "ant", smooth_width=np.inf)
    width: Any = "wide"
    with pytest.raises(
        TypeError, match=r"smooth_width: got 'wide'; allowed: None, or f"
    ):
        FeetContactWrapper(Ant(), "ant", smooth_width=width)
    with pytest.raises(ValueError, match=r"feet_width: got -1.*above 0"):
        Ant().with_feet_width(-1.0)


def test_smooth_feet_contact_can_have_an_algebraic_tail() -> None:
    options = {"smooth_width": 0.1, "smooth_tail": "algebraic"}
    env = newton_qd.create("ant_uni", qdax_wrappers_kwargs=[options])
    state = jax.jit(env.reset)(KEY)
    unloaded = 0.5 - 0.05 / (1 + np.sqrt(1.01))
    np.testing.assert_allclose(state.info["state_descriptor"], unloaded, rtol=1e-6)
    allowed = r"got 'flat'; allowed: exponential, algebraic"
    with pytest.raises(ValueError, match=f"smooth_tail: {allowed}"):
        FeetContactWrapper(Ant(), "ant", smooth_width=0.1, smooth_tail="flat")
    with pytest.raises(ValueError, match=r"smooth_tail: got 'algebraic'; .* above 0"):
        FeetContactWrapper(Ant(), "ant", smooth_tail="algebraic")
    with pytest.raises(ValueError, match=f"feet_tail: {allowed}"):
        Ant().with_feet_width(0.1, "flat")


def test_feet_contact_needs_feet() -> None:
    with pytest.raises(NotImplementedError, match="does not support line yet"):
        FeetContactWrapper(Line(), "line")


def test_check_counts_what_it_does_not_name() -> None:
    faults = np.ones(20, np.int32)
    state = SimpleNamespace(
        info={"fault": faults, "steps": np.arange(20.0)},
        pipeline_state=None,
        obs=np.zeros((20, 2)),
        reward=np.zeros(20),
        done=np.ones(20),
    )
    with pytest.raises(newton_qd.FaultError, match="world 7 at step 7 and 12 more"):
        newton_qd.check(state)  # pyright: ignore[reportArgumentType]


def test_a_second_episode_wrapper_is_refused() -> None:
    for inside in (EpisodeWrapper(Line(), 3, 1), newton_qd.create("pointmaze")):
        with pytest.raises(ValueError, match=r"^env: got .*EpisodeWrapper, and both"):
            EpisodeWrapper(inside, 3, 1)


def test_an_episode_around_an_auto_reset_is_refused() -> None:
    """Its worlds were done in every step from the end of the first episode on."""
    inside = newton_qd.create("hopper", episode_length=None)
    with pytest.raises(ValueError, match=r"^env: got .*AutoResetWrapper, which would"):
        EpisodeWrapper(inside, 3, 1)


def test_a_first_state_of_another_task_is_named() -> None:
    ours, other = (newton_qd.create(name) for name in ("anttrap", "antnotrap"))
    state = jax.eval_shape(other.reset, jax.random.key(0))
    with pytest.raises(ValueError, match=r"^state: got first_obs and obs of shape"):
        jax.eval_shape(ours.step, state, jnp.zeros(8))
