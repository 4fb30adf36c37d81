"""Names, what ``create`` builds from them, the tables, and the errors."""

from __future__ import annotations

import functools
import importlib
import pickle
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

import newton_qd
from newton_qd import PhysicsParams, tasks
from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.extractors import (
    get_feet_contact_proportion,
    get_final_xy_position,
)
from newton_qd.physics.parameters import FIELDS
from newton_qd.wrappers import (
    AutoResetWrapper,
    CompletedEvalWrapper,
    EpisodeWrapper,
    EvalWrapper,
    FeetContactWrapper,
    FixedInitialStateWrapper,
    VectorWrapper,
    Wrapper,
)


def layers(env: Env) -> list[type]:
    """Types from the outside to the inside."""
    found = [type(env)]
    while "env" in vars(env):
        env = vars(env)["env"]
        found.append(type(env))
    return found


class Task(NamedTuple):
    """What is said of a task; its offset is the original's, if that has the task."""

    base: str
    observation: int
    action: int
    descriptor: str
    limits: tuple[tuple[float, ...], tuple[float, ...]]
    offset: float | None = None


_UNIT = ((0.0, 0.0), (1.0, 1.0))
_OMNI = ((-30.0, -30.0), (30.0, 30.0))
_LANE = ((0.0, -8.0), (30.0, 8.0))
FEET, XY = "feet_contact", "xy_position"
TASKS = {
    "ant_uni": Task("ant", 87, 8, FEET, ((0.0,) * 4, (1.0,) * 4), 3.24),
    "ant_omni": Task("ant", 87, 8, XY, _OMNI, 3.0),
    "antnotrap": Task("ant", 87, 8, XY, ((0.0, -8.0), (70.0, 8.0)), 3.38),
    "anttrap": Task("ant", 95, 8, XY, _LANE, 3.38),
    "antmaze": Task("ant", 101, 8, XY, ((-5.0, -5.0), (40.0, 40.0)), 40.32),
    "halfcheetah_uni": Task("halfcheetah", 18, 6, FEET, _UNIT, 9.231),
    "hopper_uni": Task("hopper", 11, 3, FEET, ((0.0,), (1.0,)), 0.9),
    "humanoid_uni": Task("humanoid", 227, 17, FEET, _UNIT, 0.0),
    "humanoid_omni": Task("humanoid", 227, 17, XY, _OMNI, 0.0),
    "humanoidtrap": Task("humanoid_w_trap", 305, 17, XY, _LANE, 0.0),
    "walker2d_uni": Task("walker2d", 17, 6, FEET, _UNIT, 1.413),
    "pointmaze": Task("pointmaze", 2, 2, XY, ((-1.0, -1.0), (1.0, 1.0)), 2.3431),
}
NEW = {
    "antmaze_u": Task("ant", 101, 8, XY, ((-2.0, -2.0), (10.0, 10.0))),
    "antmaze_big": Task("ant", 101, 8, XY, ((-2.0, -2.0), (22.0, 22.0))),
    "antmaze_hardest": Task("ant", 101, 8, XY, ((-2.0, -2.0), (26.0, 38.0))),
    "humanoid_maze": Task("humanoid", 229, 17, XY, ((-1.0, -1.0), (5.0, 5.0))),
    "walker2d_trap": Task("walker2d", 18, 6, FEET, _UNIT),
    "pusher_uni": Task("pusher_table", 19, 7, XY, ((-1.0, -1.0), (1.0, 1.0))),
    "arm_reach": Task("reacher", 10, 2, XY, ((-0.21, -0.21), (0.21, 0.21))),
    "quadruped_uni": Task("quadruped", 35, 12, FEET, ((0.0,) * 4, (1.0,) * 4)),
    "quadruped_omni": Task("quadruped", 35, 12, XY, ((-15.0, -15.0), (15.0, 15.0))),
}
ROBOTS = {
    "ant": (87, 8),
    "halfcheetah": (18, 6),
    "hopper": (11, 3),
    "humanoid": (227, 17),
    "humanoid_w_trap": (305, 17),
    "walker2d": (17, 6),
    "acrobot": (4, 1),
    "fetch": (101, 10),
    "grasp": (132, 19),
    "humanoidstandup": (227, 17),
    "inverted_double_pendulum": (8, 1),
    "inverted_pendulum": (4, 1),
    "pusher": (23, 7),
    "reacher": (11, 2),
    "reacherangle": (11, 2),
    "swimmer": (8, 2),
    "ur5e": (66, 6),
    "quadruped": (35, 12),
}


def test_names() -> None:
    assert set(newton_qd.registered_envs()) == {*TASKS, *NEW, *ROBOTS}


@pytest.mark.parametrize("name", ROBOTS)
def test_sizes_of_robots_are_as_declared(name: str) -> None:
    env = newton_qd.create(name)
    assert (env.observation_size, env.action_size) == ROBOTS[name]
    assert env.name == name


@pytest.mark.parametrize("name", [*TASKS, *NEW])
def test_tasks_are_as_declared(name: str) -> None:
    """Those of the original are as there."""
    task, env = (TASKS | NEW)[name], newton_qd.create(name)
    assert (env.observation_size, env.action_size) == (task.observation, task.action)
    assert env.name == task.base
    qd: Any = env
    assert qd.state_descriptor_name == task.descriptor
    assert qd.behavior_descriptor_length == qd.descriptor_length == len(task.limits[0])
    for limits in (
        qd.state_descriptor_limits,
        qd.descriptor_limits,
        qd.behavior_descriptor_limits,
    ):
        np.testing.assert_array_equal(limits, np.array(task.limits, np.float32))


def test_wrappers_are_stacked_in_order() -> None:
    assert layers(newton_qd.create("ant")) == [AutoResetWrapper, EpisodeWrapper, Ant]
    everything = newton_qd.create(
        "ant_uni", batch_size=2, eval_metrics=True, fixed_init_state=True
    )
    assert layers(everything) == [
        CompletedEvalWrapper,
        EvalWrapper,
        AutoResetWrapper,
        VectorWrapper,
        EpisodeWrapper,
        FeetContactWrapper,
        FixedInitialStateWrapper,
        Ant,
    ]
    bare = newton_qd.create("ant", episode_length=None, auto_reset=False, batch_size=0)
    assert layers(bare) == [Ant]


def test_arguments_keep_their_positions() -> None:
    env: Any = newton_qd.create("ant_uni", 7, 2, True, 3, True, True, [{}])
    assert (env.episode_length, env.action_repeat, env.batch_size) == (7, 2, 3)
    assert newton_qd.create("ant").episode_length == 1000  # pyright: ignore


def test_keywords_reach_the_environment() -> None:
    env = newton_qd.create("ant", use_contact_forces=False)
    assert env.observation_size == 27
    env = newton_qd.create("ant", exclude_current_positions_from_observation=False)
    assert env.observation_size == 89
    with pytest.raises(
        TypeError,
        match=r"legacy_spring: got True, .*'ant'; allowed: .*ctrl_cost_weight, ",
    ):
        newton_qd.create("ant", legacy_spring=True)
    with pytest.raises(TypeError, match=r"zone: got 1, .*'pointmaze'; .*zone_width, "):
        newton_qd.create("pointmaze", zone=1)


def test_batches_that_do_not_exist() -> None:
    with pytest.raises(ValueError, match="batch_size: got -3; allowed: None, or int"):
        newton_qd.create("pointmaze", batch_size=-3)


def test_create_fn_is_lazy() -> None:
    make = newton_qd.create_fn("ant_uni", episode_length=5)
    assert make(batch_size=2).batch_size == 2  # pyright: ignore
    newton_qd.create_fn("nothing")


@pytest.mark.parametrize("name", ["nothing", "", "Ant", None, 3, ["ant"]])
def test_unknown_name(name: Any) -> None:
    with pytest.raises(NotImplementedError) as caught:
        newton_qd.create(name)
    message = str(caught.value)
    assert message.startswith("This environment name does not exist!")
    assert "ant, ant_uni" in message and repr(name) in message
    assert isinstance(caught.value, newton_qd.UnknownEnvironment)


def test_wrapper_kwargs_must_match_the_wrappers() -> None:
    newton_qd.create("ant_uni", qdax_wrappers_kwargs=[{}])
    newton_qd.create("ant", qdax_wrappers_kwargs=[])
    for given in ([], [{}, {}]):
        with pytest.raises(ValueError, match=r"entries; .*1 for 'ant_uni' \(FeetCo"):
            newton_qd.create("ant_uni", qdax_wrappers_kwargs=given)
    with pytest.raises(ValueError, match=r"1 entries; .*0 for 'ant' \(no wrapper"):
        newton_qd.create("ant", qdax_wrappers_kwargs=[{}])


@pytest.mark.parametrize("options", [{"eval_metrics": True}, {"action_repeat": 2}])
def test_no_episode_with_what_needs_one(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="episode_length: got None with"):
        newton_qd.create("ant", episode_length=None, **options)


@pytest.mark.parametrize("dtype", ["float16", "int32", "float"])
def test_unknown_dtype(dtype: str) -> None:
    with pytest.raises(ValueError, match=f"{dtype}"):
        newton_qd.create("ant", dtype=dtype)


def test_float64_needs_x64() -> None:
    with pytest.raises(ValueError, match="float64"):
        newton_qd.create("ant", dtype="float64")


def test_tables_are_columns_of_the_rows() -> None:
    extractors = newton_qd.tables.behavior_descriptor_extractor
    read = {FEET: get_feet_contact_proportion, XY: get_final_xy_position}
    every = TASKS | NEW
    assert dict(extractors) == {n: read[task.descriptor] for n, task in every.items()}
    assert newton_qd.tables.descriptor_extractor is extractors
    offsets = {n: task.offset for n, task in TASKS.items() if task.offset is not None}
    assert dict(newton_qd.tables.original_reward_offset) == offsets
    assert list(newton_qd.tables.reward_offset) == list(every)
    assert (
        len(newton_qd.tables.reward_offset) == len(every)
        and "ant" not in newton_qd.tables.reward_offset
    )
    assert "ant_uni" in repr(newton_qd.tables.reward_offset)
    with pytest.raises(
        KeyError, match="'ant' has no reward_offset; known: ant_uni, ant_"
    ):
        newton_qd.tables.reward_offset["ant"]


@functools.cache
def created(name: str) -> Env:
    """An environment as ``create`` makes it; to make all of them takes a second."""
    return newton_qd.create(name)


def test_every_simulated_robot_has_parameters() -> None:
    for name in newton_qd.registered_envs():
        env = created(name)
        params = Wrapper(env).default_params
        if isinstance(params, PhysicsParams):
            assert all(np.isfinite(getattr(params, field)).all() for field in FIELDS)
            # the drag of the swimmer drives its root beside the action
            base: Any = env.unwrapped
            assert params.gear_scale.shape == (base.system.nu,)
        else:
            assert name == "pointmaze"


@pytest.mark.parametrize("name", newton_qd.registered_envs())
def test_no_array_is_promoted_implicitly(name: str) -> None:
    """JAX can refuse implicit types and axes, for users who look for mistakes."""
    env = created(name)

    def reward(action: jax.Array, state: State) -> jax.Array:
        return env.step(state, action).reward

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        state = jax.eval_shape(env.reset, jax.random.key(0))
        action = jax.ShapeDtypeStruct((env.action_size,), np.float32)
        # the rules of the adjoint are the same for all; each kernel takes time to build
        function = jax.grad(reward) if name == "ant" else reward
        jax.eval_shape(function, action, state)


def test_every_forward_reward_is_a_metric() -> None:
    for name in newton_qd.registered_envs():
        base = created(name).unwrapped
        if isinstance(base, PhysicsEnv) and base.forward_reward_name is not None:
            metrics = jax.eval_shape(base.reset, jax.random.key(0)).metrics
            assert base.forward_reward_name in metrics


def test_tables_agree_with_the_environments() -> None:
    for name in newton_qd.registered_envs():
        base = created(name).unwrapped
        if isinstance(base, PhysicsEnv):
            inside = tasks.ENVIRONMENTS[name].base_name
            assert newton_qd.tables.FEET_NAMES.get(inside, ()) == base.robot.feet
            assert newton_qd.tables.COG_NAMES[inside] == base.robot.torso
            forward = newton_qd.tables.FORWARD_REWARD_NAMES.get(inside)
            assert forward == base.forward_reward_name


def test_arguments_of_wrappers_are_named() -> None:
    for wrong in (3, "a", iter([{}])):
        with pytest.raises(
            TypeError, match=r"^qdax_wrappers_kwargs: got .*sequence of"
        ):
            newton_qd.create("ant_uni", qdax_wrappers_kwargs=wrong)  # pyright: ignore
    words = r"^qdax_wrappers_kwargs\[0\], smooth: got 1, which is not an argument of "
    words += "FeetContactWrapper; allowed: smooth_width, straight_through, smooth_tail$"
    with pytest.raises(TypeError, match=words):
        newton_qd.create("ant_uni", qdax_wrappers_kwargs=[{"smooth": 1}])
    with pytest.raises(TypeError, match=r"of MazeWrapper; allowed: scene, area, heig"):
        newton_qd.create("antmaze", qdax_wrappers_kwargs=[{}, {"wall": 1}])


def test_errors_survive_pickling() -> None:
    for error in (
        newton_qd.UnknownEnvironment("x", ["ant"]),
        newton_qd.MissingExtra("qdax", "qd"),
        newton_qd.FaultError("world 1"),
    ):
        again = pickle.loads(pickle.dumps(error))
        assert str(again) == str(error) and type(again) is type(error)


def test_missing_extra_says_the_command() -> None:
    error = newton_qd.MissingExtra("qdax", "qd")
    assert isinstance(error, ImportError)
    assert "pip install 'newton_qd[qd]'" in str(error) and "qdax" in str(error)


def test_the_facade_says_how_to_load_a_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(newton_qd, "qd", raising=False)
    with pytest.raises(AttributeError, match="by itself: import newton_qd"):
        newton_qd.qd  # noqa: B018 # pyright: ignore


def test_facade() -> None:
    for name in newton_qd.__all__:
        assert getattr(newton_qd, name) is not None
    assert set(newton_qd.__all__) <= set(dir(newton_qd))
    with pytest.raises(AttributeError, match="'newton_qd' has no attribute 'nothing'"):
        newton_qd.nothing  # noqa: B018 # pyright: ignore
    project = Path(__file__).resolve().parent.parent / "pyproject.toml"
    declared = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    assert newton_qd.__version__ == declared["version"]


@pytest.mark.parametrize("name", newton_qd.tables.__all__)
def test_tables_answer_to_their_old_homes(name: str) -> None:
    table = getattr(newton_qd.tables, name)
    for old in ("newton_qd", "newton_qd.registry"):
        said = rf"^{old}\.{name} is now newton_qd\.tables\.{name}$"
        with pytest.warns(DeprecationWarning, match=said):
            assert getattr(importlib.import_module(old), name) is table


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("newton_qd.registry", "WrapperRow", "newton_qd.tasks.WrapperSpec"),
        ("newton_qd.registry", "EnvironmentRow", "newton_qd.tasks.EnvironmentSpec"),
        ("newton_qd.tasks", "WrapperRow", "newton_qd.tasks.WrapperSpec"),
        ("newton_qd.tasks", "EnvironmentRow", "newton_qd.tasks.EnvironmentSpec"),
        ("newton_qd.tasks", "ROWS", "newton_qd.tasks.ENVIRONMENTS"),
        ("newton_qd.robots", "Robot", "newton_qd.robots.RobotSpec"),
    ],
)
def test_old_names_say_the_new_ones(module: str, old: str, new: str) -> None:
    home, _, name = new.rpartition(".")
    with pytest.warns(DeprecationWarning, match=rf"^{module}\.{old} is now {new}$"):
        found = getattr(importlib.import_module(module), old)
    assert found is getattr(importlib.import_module(home), name)
    with pytest.raises(AttributeError, match=f"'{module}' has no attribute 'nothing'"):
        importlib.import_module(module).nothing  # noqa: B018


def test_tables_say_how_they_grow() -> None:
    table: Any = newton_qd.tables.reward_offset
    with pytest.raises(TypeError, match=r"\['mine'\]: got 3.0, and the table is"):
        table["mine"] = 3.0


def test_a_wrong_descriptor_is_named() -> None:
    wrong: Any = newton_qd.tasks.WrapperSpec(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^descriptor\.wrapper: got 3"):
        newton_qd.register("mine", lambda: None, descriptor=wrong)  # type: ignore
