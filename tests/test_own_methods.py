"""What the methods and options of a user's own class may be, and what is refused."""

from __future__ import annotations

import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd import authoring as nq
from newton_qd.envs.hopper import Hopper
from newton_qd.robots import HOPPER

KEY = jax.random.key(0)


class Plain(nq.PhysicsEnv):
    """A robot without a reward."""

    def outcome(self, before: Any, after: Any, action: Any) -> Any:
        return 0.0, False, {}


@pytest.mark.parametrize("kind", [np.int32, np.float16, np.float64])
def test_a_pose_of_other_numbers_has_noise_too(kind: Any) -> None:
    pose = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], kind)

    class Posed(Plain):
        def reset_pose(self, rng: Any, q: Any) -> Any:
            return pose

    class Numbers(Plain):
        def reset_pose(self, rng: Any, q: Any) -> Any:
            return jnp.asarray(pose, q.dtype)

    states = [env(HOPPER).reset(KEY).pipeline_state.q for env in (Posed, Numbers)]
    np.testing.assert_array_equal(*states)
    assert np.all(np.asarray(states[0])[3:] != 0)


@pytest.mark.parametrize("name", ["hopper", "pointmaze"])
def test_nothing_is_found_by_debug_nans(name: str) -> None:
    env = newton_qd.create(name, episode_length=3, eval_metrics=True)
    with jax.debug_nans(True):
        state = env.step(env.reset(KEY), jnp.zeros(env.action_size))
        env.rollout(state, jnp.zeros((2, env.action_size)))


def test_debug_nans_finds_the_line_of_a_reward() -> None:
    class Root(Plain):
        def outcome(self, before: Any, after: Any, action: Any) -> Any:
            return jnp.sqrt(after.q[1] - 100.0), False, {}

    env = Root(HOPPER)
    state = env.reset(KEY)
    with (
        jax.debug_nans(True),
        pytest.raises(FloatingPointError, match="encountered in sqrt"),
    ):
        jax.jit(env.step)(state, jnp.zeros(env.action_size))


def test_options_are_checked_also_where_python_evaluates_annotations() -> None:
    def init(self: Any, robot: Any, *, cost: Any = 0.1, alive: Any = True) -> None:
        Plain.__init__(self, robot)

    # as in a module without ``from __future__ import annotations``
    init.__annotations__.update(cost=float | None, alive=bool)
    kind: Any = type("Own", (Plain,), {"__init__": nq.checked_options(init)})
    with pytest.raises(ValueError, match=r"^cost: got nan; allowed: finite numbers"):
        kind(HOPPER, cost=float("nan"))
    with pytest.raises(TypeError, match=r"^alive: got 'no'; allowed: True, False"):
        kind(HOPPER, alive="no")
    kind(HOPPER, cost=1.0, alive=False)
    kind(HOPPER, cost=None)


def test_options_are_those_of_a_constructor() -> None:
    with pytest.raises(TypeError, match=r"^init: got <class .*; allowed: an __init__"):
        nq.checked_options(Plain)  # type: ignore[type-var]


def test_attributes_are_set_before_the_methods_are_called() -> None:
    class Late(Plain):
        def __init__(self, robot: Any) -> None:
            super().__init__(robot)
            self._weight = 2.0

        def outcome(self, before: Any, after: Any, action: Any) -> Any:
            return self._weight * after.v[0], False, {}

    with pytest.raises(AttributeError, match="no attribute '_weight'") as caught:
        Late(HOPPER)
    assert "before super().__init__(...)" in caught.value.__notes__[-1]


@pytest.mark.parametrize(
    ("value", "error"), [(-1.0, ValueError), (np.nan, ValueError), ("a", TypeError)]
)
def test_noise_of_velocities_is_checked(value: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"^reset_velocity_noise_scale: got .* from 0$"):
        Plain(HOPPER, reset_velocity_noise_scale=value)


@pytest.mark.parametrize(
    ("found", "words"), [(None, "None"), (1j, "a complex"), (["0"], "a str")]
)
def test_descriptors_are_real_numbers(found: Any, words: str) -> None:
    class Odd(nq.DescriptorWrapper):
        limits: ClassVar = ((0.0,), (1.0,))

        def describe(self, state: Any) -> Any:
            return found

    with pytest.raises(TypeError, match=rf"^Odd\.describe: got {words}; allowed: real"):
        jax.eval_shape(Odd(Plain(HOPPER), "own").reset, KEY)


def test_a_descriptor_is_a_wrapper() -> None:
    with pytest.raises(TypeError, match=r"^descriptor: got .*Hopper.*allowed: wrapp"):
        nq.register("own_hopper", Hopper, descriptor=Hopper)
    with pytest.raises(TypeError, match=r"^env: got None; allowed: an environment"):
        nq.Wrapper(None)  # pyright: ignore[reportArgumentType]


def test_angles_may_be_integers() -> None:
    angles = np.arange(8)
    np.testing.assert_allclose(
        nq.wrapped(jnp.asarray(angles)), nq.wrapped(jnp.asarray(angles, jnp.float32))
    )


def test_plans_are_arrays_and_begin_with_a_state() -> None:
    one = newton_qd.create("hopper", auto_reset=False)
    batch = newton_qd.create("hopper", auto_reset=False, batch_size=2)
    wrong: Any = None
    for env in (one, batch):
        state = jax.eval_shape(env.reset, KEY)
        plan = jnp.zeros((4, *state.done.shape, 3))
        with pytest.raises(TypeError, match=r"^state: got None; allowed: a State"):
            env.rollout(wrong, plan)
        with pytest.raises(TypeError, match=r"^state: got None; allowed: a State"):
            env.step(wrong, plan[0])
        wrong_plan: Any = plan.tolist()
        with pytest.raises(TypeError, match=r"^actions: got .*an array of shape"):
            env.rollout(state, wrong_plan)
    state = jax.eval_shape(batch.reset, KEY)
    with pytest.raises(ValueError, match=r"^params: got .* the batch axis \(2,\)"):
        batch.rollout(state, jnp.zeros((4, 2, 3)), one.default_params)


class OfQDax(nq.Wrapper):
    """A wrapper whose ``step`` has no argument for parameters, as in QDax."""

    def step(self, state: Any, action: Any) -> Any:  # type: ignore[override]
        state = self.env.step(state, action)
        return state.replace(reward=state.reward + 1)


class Scaled(nq.Wrapper):
    """A ``step`` with options of its own, which stay as they are."""

    def step(self, state: Any, action: Any, *, scale: float = 2.0) -> Any:  # type: ignore[override]
        return self.env.step(state, scale * action)


class Keyword(nq.Wrapper):
    def step(self, state: Any, action: Any, *, params: Any = None) -> Any:  # type: ignore[override]
        return self.env.step(state, action, params)


class Compiled(nq.Wrapper):
    @functools.partial(jax.jit, static_argnums=0)
    def step(self, state: Any, action: Any) -> Any:  # type: ignore[override]
        return self.env.step(state, action)


def test_a_step_keeps_its_own_arguments() -> None:
    hopper = newton_qd.create("hopper", episode_length=None, auto_reset=False)
    state, action = hopper.reset(KEY), jnp.full(3, 0.3)
    plain = hopper.step(state, action)
    heavy = hopper.default_params.replace(gravity=20.0)
    kinds: tuple[Any, ...] = (Scaled, Keyword, Compiled)
    scaled, keyword, compiled = (kind(hopper) for kind in kinds)
    found = scaled.step(state, action, scale=1.0)
    np.testing.assert_array_equal(found.obs, plain.obs)
    wanted = hopper.step(state, action, heavy)
    for step in (
        lambda: keyword.step(state, action, params=heavy),
        lambda: newton_qd.wrappers.AutoResetWrapper(keyword).step(
            newton_qd.wrappers.AutoResetWrapper(keyword).reset(KEY), action, heavy
        ),
    ):
        np.testing.assert_array_equal(step().pipeline_state.q, wanted.pipeline_state.q)
    outer = newton_qd.wrappers.EpisodeWrapper(compiled, 5, 1)
    found = outer.step(outer.reset(KEY), action)
    np.testing.assert_allclose(found.obs, plain.obs, rtol=1e-5, atol=1e-6)
    with pytest.raises(
        TypeError, match=r"params: .* step of Scaled does not take them"
    ):
        scaled.step(state, action, heavy)


def test_what_is_inherited_stays_inherited(monkeypatch: pytest.MonkeyPatch) -> None:
    class Between(OfQDax):
        """Has no ``step`` of its own."""

    class More(OfQDax):
        def step(self, state: Any, action: Any) -> Any:
            state = super().step(state, action)
            return state.replace(reward=state.reward + 10)

    class Both(Between, More):
        """Python asks ``More`` before ``OfQDax``."""

    point = newton_qd.create("pointmaze", episode_length=None, auto_reset=False)
    state, action = point.reset(KEY), jnp.zeros(2)
    plain = point.step(state, action).reward
    assert "step" not in vars(Between) and "step" not in vars(Both)
    assert Both(point).step(state, action).reward == pytest.approx(plain + 11)
    monkeypatch.setattr(OfQDax, "step", lambda self, *given: "patched")
    assert Between(point).step(state, action) == "patched"


def test_a_step_of_two_arguments_works_inside_wrappers() -> None:
    point = newton_qd.create("pointmaze", episode_length=None, auto_reset=False)
    inside: Any = OfQDax(point)
    env = newton_qd.wrappers.AutoResetWrapper(
        newton_qd.wrappers.EpisodeWrapper(inside, 5, 1)
    )
    state, action = env.reset(KEY), jnp.zeros(2)
    plain = point.step(point.reset(KEY), action)
    assert env.step(state, action).reward == plain.reward + 1
    with pytest.raises(
        TypeError, match="params: got parameters, and step of OfQDax does"
    ):
        inside.step(inside.reset(KEY), action, 3)
