"""The door to Gymnasium: its own checks, and the same numbers as ``env.step``."""

from __future__ import annotations

import functools
import importlib
import os
import pickle
import sys
import tomllib
import warnings
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd.adapters import make_gymnasium, make_gymnasium_vector
from newton_qd.authoring import State
from newton_qd.envs.base import Env

gymnasium = pytest.importorskip("gymnasium")
NEXT, SAME, OFF = "NextStep", "SameStep", "Disabled"


class Clock(Env):
    """Counts steps from a random start; an action above 0.5 ends the episode."""

    observation_size: Any = 2
    action_size: Any = 1
    dtype: Any = np.dtype("float32")
    dt: Any = 0.5
    name: Any = "clock"

    def reset(self, rng: jax.Array) -> State:
        start = jax.random.uniform(rng)
        zero = jnp.zeros((), jnp.float32)
        obs = jnp.stack([start, zero])
        return State(None, obs, zero, zero, {"pressed": zero}, {})

    def step(self, state: State, action: jax.Array, params: Any = None) -> State:
        done = (action[0] > 0.5).astype(jnp.float32)
        obs = state.obs.at[1].add(1.0)
        return state.replace(
            obs=obs, reward=obs[1], done=done, metrics={"pressed": done}
        )


def limited(length: int | None = None) -> Env:
    from newton_qd.wrappers import EpisodeWrapper

    return Clock() if length is None else EpisodeWrapper(Clock(), length, 1)


def pressed(*worlds: int, of: int = 3) -> np.ndarray:
    actions = np.zeros((of, 1))
    actions[list(worlds)] = 1.0
    return actions


def only_unbounded_spaces(caught: list[warnings.WarningMessage]) -> bool:
    """Whether Gymnasium warned of nothing but observations without limits."""
    texts = [str(warning.message) for warning in caught]
    return all("infinity" in text or "spec" in text for text in texts)


@pytest.mark.parametrize("registered", [False, True])
def test_gymnasiums_own_check(registered: bool) -> None:
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if registered:
            env = gymnasium.make("newton_qd/pointmaze-v0").unwrapped
            check_env(env, skip_render_check=True)
        else:
            check_env(make_gymnasium(limited(100)))
    assert only_unbounded_spaces(caught)


@pytest.mark.parametrize("size", ["width", "height"])
def test_sizes_of_pictures_are_checked_at_the_start(size: str) -> None:
    options: dict[str, Any] = {size: 0}
    for mode in (None, "rgb_array"):
        for make in (
            make_gymnasium,
            functools.partial(make_gymnasium_vector, num_envs=1),
        ):
            with pytest.raises(ValueError, match=f"^{size}: got 0; allowed: integers"):
                make(limited(100), render_mode=mode, **options)


def test_videos_of_slow_environments_have_a_frame_rate() -> None:
    class Slow(Clock):
        dt: Any = 4.0

    assert make_gymnasium(Slow()).metadata["render_fps"] == 1


@pytest.mark.slow
def test_gymnasiums_own_check_of_a_robot() -> None:
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        name, size = "newton_qd/ant_uni-v0", {"width": 32, "height": 24}
        env = gymnasium.make(name, render_mode="rgb_array", **size)
        check_env(env.unwrapped, skip_render_check=True)
        env.reset(seed=0)
        picture = env.render()
    assert only_unbounded_spaces(caught)
    assert picture.shape == (24, 32, 3) and picture.dtype == np.uint8
    assert len(np.unique(picture)) > 10


def test_truncation_is_not_termination() -> None:
    options: Any = {"auto_reset": True}
    with pytest.raises(TypeError, match="options: got 'auto_reset', which the adapter"):
        make_gymnasium("hopper", **options)
    env = make_gymnasium(limited(3))
    env.reset(seed=0)
    ends = [env.step(np.zeros(1))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    env.reset()
    env.step(np.zeros(1))
    assert env.step(np.ones(1))[2:4] == (True, False)
    env.reset()
    for _ in range(2):
        env.step(np.zeros(1))
    assert env.step(np.ones(1))[2:4] == (True, True), "as with Gymnasium's TimeLimit"


def test_seeds() -> None:
    env = make_gymnasium(limited())
    for seed in (0, 7, 2**31, 2**32 - 1):
        observation, _ = env.reset(seed=seed)
        assert observation.flags.writeable  # nobody else's
        key = jax.random.key(np.uint32(seed))
        assert np.array_equal(observation, Clock().reset(key).obs)
    first = [env.reset(seed=1)[0][0], *(env.reset()[0][0] for _ in range(3))]
    again = [env.reset(seed=1)[0][0], *(env.reset()[0][0] for _ in range(3))]
    assert first == again and len(set(first)) == 4


def test_worlds_of_a_vector_begin_as_single_ones() -> None:
    many, one = make_gymnasium_vector(limited(), 3), make_gymnasium(limited())
    observations, _ = many.reset(seed=5)
    assert np.array_equal(observations, [one.reset(seed=5 + n)[0] for n in range(3)])
    observations, _ = many.reset(seed=[9, 1, 4])
    assert np.array_equal(observations, [one.reset(seed=n)[0] for n in (9, 1, 4)])
    for kind in (np.int32, np.uint8):
        observations, _ = many.reset(seed=np.array([9, 1, 4], kind))  # pyright: ignore[reportArgumentType]
        assert np.array_equal(observations, [one.reset(seed=n)[0] for n in (9, 1, 4)])
    for large in (2**70, [2**63 + 1, 2, 3]):
        first = large if isinstance(large, int) else large[0]
        assert np.array_equal(many.reset(seed=large)[0][0], one.reset(seed=first)[0])
    for seeds in ([1.5, 2, 3], [None, 1, 2], [1, 2], [True, 2, 3]):
        with pytest.raises(ValueError, match=r"seed: got .*; allowed: an integer, or"):
            many.reset(seed=seeds)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="num_envs: got 0; allowed: integers from 1"):
        make_gymnasium_vector("pointmaze", 0)


@pytest.mark.parametrize("mode", [NEXT, SAME, OFF])
def test_autoreset_as_gymnasiums_own_vector_does(mode: str) -> None:
    """Ends, rewards and counts of the first 12 steps, with random ends."""
    many = make_gymnasium_vector(limited(4), 3, autoreset_mode=mode)
    assert many.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode(mode)
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: make_gymnasium(limited(4))] * 3, autoreset_mode=mode
    )
    rows = np.random.default_rng(0).uniform(-1, 0.75, (12, 3, 1))
    assert np.array_equal(many.reset(seed=2)[0], theirs.reset(seed=2)[0])
    for actions in rows:
        ours, other = many.step(actions), theirs.step(actions)
        for a, b in zip(ours[1:4], other[1:4], strict=True):
            assert np.array_equal(a, b)
        assert np.array_equal(ours[0][:, 1], other[0][:, 1])
        assert np.array_equal(ours[4]["pressed"], other[4]["pressed"])
        ended = ours[2] | ours[3]
        if mode == SAME and ended.any():
            final = np.stack(list(other[4]["final_obs"][ended]))
            assert np.array_equal(ours[4]["final_obs"][ended, 1], final[:, 1])
            assert np.array_equal(ours[4]["_final_obs"], ended)
            seen, theirs_seen = (x[4]["final_info"]["pressed"] for x in (ours, other))
            assert np.array_equal(seen[ended], theirs_seen[ended])
        if mode == OFF and ended.any():
            options = {"reset_mask": ended}
            mine = many.reset(options=dict(options))[0]
            assert np.array_equal(mine[:, 1], theirs.reset(options=options)[0][:, 1])


def test_new_episodes_begin_in_new_states_and_repeat_with_the_seed() -> None:
    def starts() -> list[float]:
        env = make_gymnasium_vector(limited(2), 2)
        found = [*env.reset(seed=3)[0][:, 0]]
        for _ in range(12):
            observations, *_ = env.step(np.zeros((2, 1)))
            found += [x for x, steps in observations if steps == 0]
        return found

    found = starts()
    assert len(set(found)) == len(found) == 10 and found == starts()


def test_worlds_that_are_reset_have_start_states_of_their_own() -> None:
    many = make_gymnasium_vector(limited(), 2)

    def starts() -> list[float]:
        found = [*many.reset(seed=0)[0][:, 0]]
        for world in (0, 1, 0, 0, 1):
            mask = np.arange(2) == world
            observations, _ = many.reset(options={"reset_mask": mask})
            found.append(observations[world, 0])
        return found

    found = starts()
    assert len(set(found)) == len(found) and starts() == found


def test_a_world_that_was_reset_goes_on() -> None:
    many = make_gymnasium_vector(limited(1), 2)
    many.reset(seed=0)
    assert many.step(pressed(of=2))[3].all()
    many.reset(options={"reset_mask": np.array([True, False])})
    assert many.step(pressed(of=2))[0][:, 1].tolist() == [1, 0]


def test_a_reset_of_all_worlds_is_not_followed_by_another() -> None:
    many = make_gymnasium_vector(limited(1), 2, autoreset_mode=NEXT)
    many.reset(seed=0)
    assert many.step(pressed(of=2))[3].all()
    begun, _ = many.reset()
    after = many.step(pressed(of=2))[0]
    assert after[:, 1].tolist() == [1, 1] and (after[:, 0] == begun[:, 0]).all()


def test_the_reward_of_a_first_state_is_not_counted() -> None:
    class Early(Clock):
        def reset(self, rng: jax.Array) -> State:
            return super().reset(rng).replace(reward=jnp.float32(7.0))

    many = make_gymnasium_vector(Early(), 2)
    many.reset(seed=0)
    assert many.step(pressed(0, of=2))[1].tolist() == [1, 1]
    assert many.step(pressed(of=2))[1].tolist() == [0, 2]


@pytest.mark.slow
@pytest.mark.optimized
def test_a_reset_in_a_step_has_no_reward() -> None:
    """A state of a maze has one after a reset, too."""
    worlds = make_gymnasium_vector("antmaze", 2, episode_length=1)
    worlds.reset(seed=0)
    actions = np.zeros((2, 8), np.float32)
    assert (worlds.step(actions)[1] < 0).all()
    assert (worlds.step(actions)[1] == 0).all()


def test_the_numbers_are_those_of_env_step() -> None:
    env = newton_qd.create("ant_uni", episode_length=6, auto_reset=False)
    step, reset = jax.jit(env.step), jax.jit(env.reset)
    one = make_gymnasium("ant_uni", episode_length=6)
    many = make_gymnasium_vector("ant_uni", 4, episode_length=6)
    batch = newton_qd.create("ant_uni", 6, auto_reset=False, batch_size=4)
    steps = jax.jit(batch.step)
    state = reset(jax.random.key(3))
    states = jax.jit(jax.vmap(env.reset))(jax.vmap(jax.random.key)(np.arange(3, 7)))
    assert np.array_equal(one.reset(seed=3)[0], state.obs)
    assert np.array_equal(many.reset(seed=3)[0], states.obs)
    rng = np.random.default_rng(0)
    for _ in range(6):
        actions = rng.uniform(-1, 1, (4, 8)).astype(np.float32)
        state, states = step(state, actions[0]), steps(states, actions)
        for found, wanted in (
            (one.step(actions[0]), state),
            (many.step(actions), states),
        ):
            assert np.array_equal(found[0], wanted.obs)
            assert np.array_equal(found[1], wanted.reward)
            assert np.array_equal(np.asarray(found[2]) | found[3], wanted.done > 0)
            for name, value in wanted.metrics.items():
                assert np.array_equal(found[4][name], value)
            described = wanted.info["state_descriptor"]
            assert np.array_equal(found[4]["state_descriptor"], described)
            assert found[4]["state_descriptor"].flags.writeable  # nobody else's


@pytest.mark.parametrize("number", [None, pytest.param(2, marks=pytest.mark.slow)])
def test_an_environment_goes_to_other_processes(number: int | None) -> None:
    if number is None:
        env: Any = make_gymnasium("pointmaze")
    else:
        env = make_gymnasium_vector("pointmaze", number, render_mode="rgb_array")
    env.reset(seed=3)
    env.render()
    action = env.action_space.sample()
    again = pickle.loads(pickle.dumps(env))
    for _ in range(2):
        np.testing.assert_array_equal(again.step(action)[0], env.step(action)[0])
    np.testing.assert_array_equal(again.reset()[0], env.reset()[0])
    if number is not None:
        found, expected = np.asarray(again.render()), np.asarray(env.render())
        # its grid on the ground begins elsewhere
        assert found.shape == expected.shape and np.mean(found != expected) < 0.01


def test_wrappers_of_gymnasium() -> None:
    env: Any = gymnasium.wrappers.vector.RecordEpisodeStatistics(
        gymnasium.make_vec("newton_qd/pointmaze-v0", num_envs=2, max_episode_steps=3)
    )
    env.reset(seed=0)
    info: dict[str, Any] = {}
    for _ in range(3):
        *_, info = env.step(env.action_space.sample())
    assert list(info["episode"]["l"]) == [3, 3]


def test_the_spec_has_the_length_of_an_episode() -> None:
    """Other libraries read it there."""
    name = "newton_qd/pointmaze-v0"
    env = gymnasium.make(name, episode_length=3)
    assert env.spec is not None and env.spec.max_episode_steps == 3
    again = gymnasium.make(env.spec)
    again.reset(seed=0)
    action = again.action_space.sample()
    assert [again.step(action)[3] for _ in range(3)] == [False, False, True]
    # nothing but its environment ends an episode later
    long = gymnasium.make(name, episode_length=5, action_repeat=2).spec
    assert long is not None and long.max_episode_steps == 3
    endless = gymnasium.make(name, episode_length=None).spec
    assert endless is not None and endless.max_episode_steps is None
    many = gymnasium.make_vec(name, num_envs=2, episode_length=3)
    assert many.spec is not None and many.spec.max_episode_steps == 3
    copied = pickle.loads(pickle.dumps(env.unwrapped))
    assert copied.spec.max_episode_steps == 3


def test_a_vector_environment_made_from_a_spec_has_its_length() -> None:
    """Gymnasium counts actions, and ``episode_length`` control steps."""
    name, repeat = "newton_qd/pointmaze-v0", {"episode_length": 5, "action_repeat": 2}
    first = gymnasium.make_vec(name, num_envs=2, **repeat)
    again = gymnasium.make_vec(first.spec, num_envs=2)
    assert again.spec is not None and again.spec.max_episode_steps == 3
    again.reset(seed=0)
    actions = again.action_space.sample()
    assert [again.step(actions)[3].all() for _ in range(3)] == [False, False, True]
    with pytest.raises(ValueError, match=r"max_episode_steps: got 2\.5; allowed: "):
        gymnasium.make_vec(name, max_episode_steps=2.5)


def test_a_vector_environment_of_an_object_is_made_again_from_its_spec() -> None:
    spec = gymnasium.envs.registration.EnvSpec(
        "Clock-v0",
        vector_entry_point=make_gymnasium_vector,
        kwargs={"env": limited(3)},
    )
    first = gymnasium.make_vec(spec, num_envs=2)
    assert first.spec is not None and first.spec.max_episode_steps == 3
    again = gymnasium.make_vec(first.spec, num_envs=2)
    assert again.spec is not None and again.spec.max_episode_steps == 3
    with pytest.raises(ValueError, match="max_episode_steps: got 4; allowed: None, or"):
        make_gymnasium_vector(limited(3), 2, max_episode_steps=4)
    with pytest.raises(ValueError, match=r"max_episode_steps: got 4; allowed: None$"):
        make_gymnasium_vector(limited(), 2, max_episode_steps=4)


@pytest.mark.parametrize("last", [0.0, 1.0])
def test_an_environment_made_from_a_spec_ends_as_its_own(last: float) -> None:
    spec = gymnasium.envs.registration.EnvSpec(
        "Clock-v0", make_gymnasium, kwargs={"env": limited(3)}
    )
    first = gymnasium.make(spec)
    again = gymnasium.make(first.spec)
    for env in (first, again):
        env.reset(seed=0)
    assert "TimeLimit" in str(again) and "TimeLimit" not in str(first)
    for action, ends in ((0.0, False), (0.0, False), (last, True)):
        given = np.full(1, action, np.float32)
        assert first.step(given)[2:4] == again.step(given)[2:4] == (last * ends, ends)


class Fragile(Clock):
    """A clock that has a fault from an action above 0.5 on."""

    def reset(self, rng: jax.Array) -> State:
        state = super().reset(rng)
        return state.replace(info={"fault": jnp.zeros((), jnp.int32)})

    def step(self, state: State, action: jax.Array, params: Any = None) -> State:
        after = super().step(state, action, params)
        info = {**after.info, "fault": after.done.astype(jnp.int32)}
        return after.replace(info=info)


@pytest.mark.parametrize("length", [3, 4])
def test_a_fault_within_the_last_action_is_in_the_last_step(length: int) -> None:
    """The count of control steps stops there, before the length of the episode."""
    from newton_qd.wrappers import EpisodeWrapper

    env = EpisodeWrapper(Fragile(), length, 2)
    spec = gymnasium.envs.registration.EnvSpec(
        "Fragile-v0", make_gymnasium, kwargs={"env": env}
    )
    first = gymnasium.make(spec)
    again = gymnasium.make(first.spec)  # with Gymnasium's TimeLimit
    for actions, truncated in (([1.0], False), ([0.0, 1.0], True)):
        for each in (first, again):
            each.reset(seed=0)
            ends = [each.step(np.full(1, action, np.float32)) for action in actions]
            assert ends[-1][2:4] == (True, truncated)


def test_an_environment_may_count_its_steps_elsewhere() -> None:
    class Own(Clock):
        episode_length = 2

        def step(self, state: State, action: jax.Array, params: Any = None) -> State:
            after = super().step(state, action, params)
            over = (after.obs[1] >= 2).astype(jnp.float32)
            info = {"truncation": over * (1 - after.done)}
            return after.replace(done=jnp.maximum(after.done, over), info=info)

    env = make_gymnasium(Own())
    for last in (False, True):
        env.reset(seed=0)
        assert env.step(np.zeros(1))[2:4] == (False, False)
        assert env.step(np.full(1, float(last)))[2:4] == (last, not last)


def test_every_environment_is_registered() -> None:
    names = {f"newton_qd/{name}-v0" for name in newton_qd.registered_envs()}
    assert names <= set(gymnasium.registry)
    path = Path(__file__).resolve().parent.parent / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    module, name = project["entry-points"]["gymnasium.envs"]["newton_qd"].split(":")
    getattr(importlib.import_module(module), name)()  # again: no second registration


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: make_gymnasium("no_such"), NotImplementedError, "known names"),
        (
            lambda: make_gymnasium(cast("Any", 3)),
            TypeError,
            "env: got 3; allowed: a name of",
        ),
        (lambda: make_gymnasium(Clock(), episode_length=3), ValueError, "env: got an"),
        (
            lambda: make_gymnasium("pointmaze", render_mode="human"),
            ValueError,
            "render_mode: got 'human'; allowed: rgb_array",
        ),
        (
            lambda: make_gymnasium(newton_qd.create("pointmaze")),
            ValueError,
            "env: got an environment with auto-reset; allowed: one world",
        ),
        (
            lambda: make_gymnasium(newton_qd.create("pointmaze", batch_size=2)),
            ValueError,
            "env: got an environment with auto-reset; allowed: one world",
        ),
        (
            lambda: make_gymnasium(
                newton_qd.create("pointmaze", auto_reset=False, batch_size=2)
            ),
            ValueError,
            "env: got an environment with a batch; allowed: one world",
        ),
        (
            lambda: make_gymnasium_vector(Clock(), 2, autoreset_mode="Never"),
            ValueError,
            "autoreset_mode: got 'Never'; allowed: NextStep, SameStep, Disabled",
        ),
        (
            lambda: make_gymnasium_vector(Clock(), 2).reset(seed=[1]),
            ValueError,
            r"seed: got \[1\]; allowed: an integer, or 2 integers",
        ),
        (
            lambda: make_gymnasium_vector(Clock(), 2).reset(
                options={"reset_mask": np.zeros(2, bool)}
            ),
            ValueError,
            r"options\['reset_mask'\]: got an array of shape \(2,\), bool",
        ),
        (
            lambda: make_gymnasium(Clock()).reset(options={"typo": 1}),
            ValueError,
            "options: got 'typo'; allowed: none",
        ),
        (
            lambda: make_gymnasium_vector(Clock(), 2).reset(options={"mask": None}),
            ValueError,
            "options: got 'mask'; allowed: reset_mask",
        ),
        (
            lambda: make_gymnasium(Clock()).step(np.zeros(1)),
            gymnasium.error.ResetNeeded,
            "call reset first",
        ),
    ],
)
def test_errors(make: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make()


def test_a_missing_gymnasium_says_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    for module in ("gymnasium", "gymnasium_vector"):
        monkeypatch.delitem(sys.modules, f"newton_qd.adapters.{module}", raising=False)
        with pytest.raises(newton_qd.MissingExtra, match=r"newton_qd\[gym\]"):
            importlib.import_module(f"newton_qd.adapters.{module}")


@pytest.mark.parametrize(
    ("make", "count"), [(make_gymnasium, {}), (make_gymnasium_vector, {"num_envs": 2})]
)
def test_a_forked_process_is_refused(
    make: Any, count: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """JAX would wait forever there, as in asynchronous vector environments."""
    adapter = importlib.import_module("newton_qd.adapters.gymnasium")
    monkeypatch.setattr(adapter, "_PROCESSES", [])
    make("pointmaze", **count).reset(seed=0)
    with monkeypatch.context() as forked:
        process = os.getpid() + 1
        forked.setattr(os, "getpid", lambda: process)
        with pytest.raises(RuntimeError, match=r"forked .*; start processes"):
            make("pointmaze", **count)
    make("pointmaze", **count).reset(seed=0)
