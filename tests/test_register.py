"""Environments that a user registers, and what the tables say of them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import newton_qd
import newton_qd.authoring as nq
from newton_qd import tasks
from newton_qd.envs.ant import Ant
from newton_qd.envs.hopper import Hopper
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.extractors import (
    get_feet_contact_proportion,
)
from newton_qd.robots import ANT, Material, RobotSpec
from newton_qd.wrappers import (
    FeetContactWrapper,
    OffsetRewardWrapper,
    StateDescriptorResetWrapper,
)


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Registrations that the test makes are forgotten after it."""
    monkeypatch.setattr(tasks, "ENVIRONMENTS", dict(tasks.ENVIRONMENTS))
    yield


def test_tables_of_links_and_metrics_are_views(rows: None) -> None:
    assert newton_qd.tables.FEET_NAMES["ant"] == (
        "foot_1",
        "foot_2",
        "foot_3",
        "foot_4",
    )
    assert newton_qd.tables.COG_NAMES["ant"] == "torso"
    assert newton_qd.tables.FORWARD_REWARD_NAMES["ant"] == "reward_forward"
    tables = (
        newton_qd.tables.FEET_NAMES,
        newton_qd.tables.COG_NAMES,
        newton_qd.tables.FORWARD_REWARD_NAMES,
    )
    for table in tables:
        assert "ant_uni" not in table and "pointmaze" not in table
        assert len(table) == len(set(table)) == len(dict(table))
        with pytest.raises(TypeError):
            table["mine"] = ("a",)  # pyright: ignore[reportIndexIssue]
        with pytest.raises(KeyError, match=r"'pointmaze' has no .*known: ant"):
            table["pointmaze"]

    class Walker(Ant):
        forward_reward_name = "x_velocity"

    robot = dataclasses.replace(ANT, feet=("foot_2",), torso="aux_1")
    newton_qd.register("mine", Walker, robot=robot)
    assert newton_qd.tables.FEET_NAMES["mine"] == ("foot_2",)
    assert newton_qd.tables.COG_NAMES["mine"] == "aux_1"
    assert newton_qd.tables.FORWARD_REWARD_NAMES["mine"] == "x_velocity"
    # an environment that is not a robot's
    newton_qd.register("footless", PointMaze)
    assert not any("footless" in table for table in tables)


EXTRACTOR = "descriptor_extractor"


def of_method(self: Any, data: Any, mask: Any) -> Any:
    """A function that was not meant to get ``self``."""


def test_register(rows: None) -> None:
    newton_qd.register(
        "my_ant",
        Ant,
        base_name="ant",
        wrappers=[tasks.WrapperSpec(FeetContactWrapper, {"smooth_width": 0.1})],
        descriptor_extractor=get_feet_contact_proportion,
        reward_offset=0.0,
    )
    assert newton_qd.registered_envs()[-1] == "my_ant"
    assert newton_qd.tables.reward_offset["my_ant"] == 0.0
    inside: Any = newton_qd.create("my_ant", auto_reset=False, episode_length=None)
    assert type(inside) is FeetContactWrapper
    with pytest.raises(ValueError, match=r"env_name: got 'my_ant', .* taken"):
        newton_qd.register("my_ant", Ant)
    with pytest.raises(ValueError, match="env_name: got ''"):
        newton_qd.register("", Ant)
    with pytest.raises(TypeError, match="base: got 3"):
        newton_qd.register("three", 3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"base_name": 3}, ValueError, r"base_name: got 3; allowed: None, or text"),
        ({"base_name": ""}, ValueError, r"base_name: got ''; allowed"),
        ({"robot": "ant"}, TypeError, r"robot: got 'ant'; allowed: None, or .*Robot"),
        (
            {"reward_offset": "x"},
            TypeError,
            r"reward_offset: got 'x'; .* finite number",
        ),
        ({"reward_offset": True}, TypeError, r"reward_offset: got True; allowed"),
        ({"reward_offset": np.nan}, ValueError, r"reward_offset: got nan; allowed"),
        (
            {"descriptor_extractor": 3},
            TypeError,
            r"descriptor_extractor: got 3; allowed",
        ),
        (
            {"descriptor": type("A", (FeetContactWrapper,), {EXTRACTOR: "mean"})},
            TypeError,
            r"descriptor_extractor: got 'mean'; allowed: None, or a function of",
        ),
        (
            {"descriptor": type("B", (FeetContactWrapper,), {EXTRACTOR: of_method})},
            TypeError,
            r"descriptor_extractor: got .*'mask'; allowed: .* staticmethod\(function\)",
        ),
        (
            {"wrappers": None},
            TypeError,
            r"wrappers: got None; allowed: a tuple or list",
        ),
        (
            {"wrappers": tasks.WrapperSpec(FeetContactWrapper)},
            TypeError,
            r"wrappers: got WrapperSpec\(.*allowed: a tuple or list of WrapperSpec",
        ),
        (
            {"wrappers": (FeetContactWrapper,)},
            TypeError,
            r"wrappers\[0\]: got <class .*FeetContactWrapper'>; allowed: a WrapperSpec",
        ),
        (
            {"wrappers": [tasks.WrapperSpec(3)]},  # pyright: ignore
            TypeError,
            r"wrappers\[0\].wrapper: got 3; allowed: a class or a function",
        ),
        (
            {"wrappers": [tasks.WrapperSpec(Hopper)]},
            TypeError,
            r"wrappers\[0\].wrapper: got <class .*Hopper'>; allowed: wrappers, such",
        ),
        (
            {"wrappers": [tasks.WrapperSpec(FeetContactWrapper, 3)]},  # pyright: ignore
            TypeError,
            r"wrappers\[0\].options: got 3; allowed: a mapping",
        ),
    ],
)
def test_register_refuses_before_it_stores(
    options: dict[str, Any], error: type[Exception], message: str, rows: None
) -> None:
    with pytest.raises(error, match=message):
        newton_qd.register("mine", Ant, **options)
    assert "mine" not in newton_qd.registered_envs()
    assert "ant" in list(newton_qd.tables.FEET_NAMES)


@pytest.mark.parametrize(
    "name",
    ["../../evil", "a/b", "a b", "1st", "a-b", ".", "a\n", "r\u00e4uber", "a" * 101],
)
def test_a_name_is_never_a_path(name: str, rows: None) -> None:
    for names in ({"env_name": name}, {"env_name": "mine", "base_name": name}):
        wrong = list(names)[-1]
        with pytest.raises(
            ValueError, match=f"^{wrong}: got .*; allowed: .*letters, d"
        ):
            newton_qd.register(base=Ant, **names)  # pyright: ignore
    assert "mine" not in newton_qd.registered_envs()


def test_a_base_makes_an_environment(rows: None) -> None:
    allowed = "allowed: a subclass of newton_qd's Env, or a function that makes an env"
    for base in (int, functools.partial(dict, a=1)):
        with pytest.raises(TypeError, match=f"^base: got .*{allowed}"):
            newton_qd.register("mine", base)  # pyright: ignore
    with pytest.raises(TypeError, match=f"^base: got .*, which makes 3; {allowed}"):
        newton_qd.register("mine", lambda **k: 3)  # pyright: ignore
    with pytest.raises(TypeError, match=f"^base: got .*, which makes 4; {allowed}"):
        newton_qd.register("mine", lambda size: size, size=4)  # pyright: ignore
    assert "mine" not in newton_qd.registered_envs()
    newton_qd.register("later", lambda size: size)  # needs an argument of create
    with pytest.raises(
        TypeError, match=f"^base: got 3, which 'later' makes; {allowed}"
    ):
        newton_qd.create("later", size=3)
    newton_qd.register("maze", lambda **options: PointMaze(**options))
    assert isinstance(newton_qd.create("maze").unwrapped, PointMaze)


def test_register_takes_numbers_of_numpy(rows: None) -> None:
    newton_qd.register("mine", Ant, reward_offset=np.float32(2.0))  # pyright: ignore
    assert newton_qd.tables.reward_offset["mine"] == 2.0


def test_register_gives_the_robot_and_options(rows: None) -> None:
    robot = nq.create("ant").unwrapped.robot  # pyright: ignore
    limits = {"minval": (-1, -1), "maxval": (1, 1)}
    nq.register(
        "mine",
        nq.Locomotion,
        robot=robot,
        descriptor=nq.WrapperSpec(nq.XYPositionWrapper, limits),
        healthy_reward=3.0,
    )
    spec = tasks.ENVIRONMENTS["mine"]
    assert spec.descriptor_extractor is nq.get_final_xy_position
    assert spec.forward_reward == "reward_forward" and spec.torso == "torso"
    env: Any = nq.create("mine")
    assert env.unwrapped._healthy_reward == 3.0
    assert env.state_descriptor_limits[1].tolist() == [1, 1]
    env = nq.create("mine", healthy_reward=4.0)
    assert env.unwrapped._healthy_reward == 4.0
    with pytest.raises(
        TypeError, match=r"heatlhy: got 1, .* not an argument of 'other'; a"
    ):
        nq.register("other", nq.Locomotion, robot=robot, heatlhy=1)
    with pytest.raises(
        TypeError, match="descriptor: got 3; allowed: None, a class such as"
    ):
        nq.register("other", nq.Locomotion, descriptor=3)  # pyright: ignore
    assert "other" not in nq.registered_envs()


def test_a_registered_wrapper_takes_the_name() -> None:
    """Else ``create`` could not make it."""
    for wrapper, options in (
        (OffsetRewardWrapper, {"offset": 5.0}),
        (OffsetRewardWrapper, {}),
        (StateDescriptorResetWrapper, {}),
    ):
        spec = nq.WrapperSpec(wrapper, options)
        words = rf"arguments of {wrapper.__name__}: got .*; allowed: \(env, env_name"
        with pytest.raises(TypeError, match=words):
            newton_qd.register("unnamed", Hopper, wrappers=(spec,))


def test_own_names_can_be_replaced(rows: None) -> None:
    newton_qd.register("mine", Ant)
    with pytest.raises(ValueError, match="'mine', which is taken; allowed: a new name"):
        newton_qd.register("mine", Hopper)
    newton_qd.register("mine", Hopper, replace=True)
    assert newton_qd.create("mine").observation_size == 11
    with pytest.raises(
        ValueError, match="'ant', which is taken; allowed: any name but"
    ):
        newton_qd.register("ant", Hopper, replace=True)
    with pytest.raises(TypeError, match="replace: got 2; allowed: True, False"):
        newton_qd.register("other", Hopper, replace=2)  # type: ignore[arg-type]


def test_a_robot_replaces_that_of_the_base(rows: None) -> None:
    weak = dataclasses.replace(
        ANT, actuators=tuple((joint, 0.5 * gear) for joint, gear in ANT.actuators)
    )
    newton_qd.register("weak_ant", Ant, robot=weak)  # Ant has no argument robot
    ant: Any = newton_qd.create("weak_ant").unwrapped
    assert ant.robot is weak
    newton_qd.register("same_ant", Ant, robot=ANT)
    newton_qd.create("same_ant")

    def softer(**options: Any) -> newton_qd.Env:
        return Ant(**options).with_material(Material(friction=0.3))

    newton_qd.register("softer_ant", softer, robot=ANT)
    ant = newton_qd.create("softer_ant").unwrapped
    assert ant.robot.material.friction == 0.3  # what the base chose stays

    class OnLegs(Hopper):
        def __init__(self, robot: RobotSpec = ANT, dtype: str = "float32") -> None:
            super().__init__(dtype=dtype)
            self.given = robot

    newton_qd.register("on_legs", OnLegs, robot=weak)
    made: Any = newton_qd.create("on_legs").unwrapped
    assert made.given is weak
