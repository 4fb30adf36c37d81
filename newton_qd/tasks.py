"""The environments as data: one spec for each name.

To add an environment to the suite, add a spec. Code outside of this package calls
:func:`newton_qd.register`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from newton_qd.checks import Fact, listed, message
from newton_qd.envs.acrobot import Acrobot
from newton_qd.envs.ant import Ant
from newton_qd.envs.arm_reach import TIP, ArmReach
from newton_qd.envs.base import Env
from newton_qd.envs.fetch import Fetch
from newton_qd.envs.grasp import Grasp
from newton_qd.envs.halfcheetah import HalfCheetah
from newton_qd.envs.hopper import Hopper
from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.humanoid_standup import HumanoidStandup
from newton_qd.envs.humanoid_trap import HumanoidTrap
from newton_qd.envs.inverted_pendulum import InvertedDoublePendulum, InvertedPendulum
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.pusher import Pusher, TablePusher
from newton_qd.envs.quadruped import Quadruped
from newton_qd.envs.reacher import Reacher, ReacherAngle
from newton_qd.envs.swimmer import Swimmer
from newton_qd.envs.ur5e import Ur5e
from newton_qd.envs.walker2d import Walker2d
from newton_qd.extractors import (
    get_feet_contact_proportion,
    get_final_xy_position,
)
from newton_qd.moved import moved_name
from newton_qd.robots import HUMANOID, PUSHER_TABLE, REACHER, ROBOTS, RobotSpec
from newton_qd.scenes import (
    ANTMAZE_BIG,
    ANTMAZE_HARDEST,
    ANTMAZE_U,
    HUMANOID_MAZE,
    HURDLES,
    Scene,
)
from newton_qd.types import DescriptorExtractor
from newton_qd.wrappers import (
    FeetContactWrapper,
    MazeWrapper,
    NoForwardRewardWrapper,
    TrapWrapper,
    XYPositionWrapper,
)

_MOVED = {
    "EnvironmentRow": "newton_qd.tasks.EnvironmentSpec",
    "ROWS": "newton_qd.tasks.ENVIRONMENTS",
    "WrapperRow": "newton_qd.tasks.WrapperSpec",
}


def __getattr__(name: str) -> Any:
    """Returns a renamed object by its old name."""
    return moved_name(__name__, name, _MOVED)


@dataclasses.dataclass(frozen=True)
class WrapperSpec:
    """A wrapper of an environment, called as ``wrapper(env, name, **options)``.

    Attributes:
        wrapper: Class or function.
        options: Keyword arguments, replaced by ``qdax_wrappers_kwargs``.
    """

    wrapper: Callable[..., Env]
    options: Mapping[str, object] = dataclasses.field(default_factory=dict)

    def check_options(self, where: str, options: Mapping[str, Any]) -> None:
        """Checks that the wrapper takes keyword arguments.

        Args:
            where: Name of ``options`` in errors.
            options: Values by name.

        Raises:
            TypeError: The wrapper does not take one of them.
        """
        parameters = [*inspect.signature(self.wrapper).parameters.values()]
        if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return
        if not any(map(_takes_name, parameters[1:2])):
            given = Fact(str(inspect.signature(self.wrapper)))
            allowed = "(env, env_name, ...): the second argument is the name"
            name = getattr(self.wrapper, "__name__", repr(self.wrapper))
            raise TypeError(message(f"arguments of {name}", given, allowed))
        allowed = [p.name for p in parameters[2:]]  # after the environment and its name
        for name, value in options.items():
            if name not in allowed:
                owner = getattr(self.wrapper, "__name__", repr(self.wrapper))
                why = f"which is not an argument of {owner}"
                known = listed(allowed, "no argument")
                raise TypeError(message(f"{where}, {name}", value, known, why=why))


def _takes_name(parameter: inspect.Parameter) -> bool:
    """Returns whether an argument may be the name of the environment."""
    if parameter.default is parameter.empty or isinstance(parameter.default, str):
        return True
    return parameter.name in ("env_name", "name")


@dataclasses.dataclass(frozen=True)
class EnvironmentSpec:
    """Everything that the suite stores about a named environment.

    Attributes:
        base: Makes the environment from the keyword arguments of ``create``.
        base_name: Name that wrappers receive.
        wrappers: Wrappers, from the inside to the outside.
        descriptor_extractor: Computes the descriptor of an episode, for QD tasks.
        reward_offset: Added to each step's reward to keep QD scores positive. For the
            tasks of the original, ``benchmarks/survey.py`` measured it.
        original_reward_offset: Reward offset of the original, with its physics.
        robot: Spec of the robot inside; ``None``: the entry ``base_name`` of
            ``ROBOTS``, if there is one.
    """

    base: Callable[..., Env]
    base_name: str
    wrappers: tuple[WrapperSpec, ...] = ()
    descriptor_extractor: DescriptorExtractor | None = None
    reward_offset: float | None = None
    original_reward_offset: float | None = None
    robot: RobotSpec | None = None

    @property
    def feet(self) -> tuple[str, ...] | None:
        """Links of the robot's feet; ``None`` if it has no feet."""
        robot = self._robot
        return robot.feet if robot is not None and robot.feet else None

    @property
    def torso(self) -> str | None:
        """Link of the robot's torso; ``None`` if there is no robot."""
        return None if self._robot is None else self._robot.torso

    @property
    def forward_reward(self) -> str | None:
        """Metric with the forward part of the reward; ``None``: no forward part."""
        base: object = self.base
        # a functools.partial of a class has the attributes of that class
        while isinstance(base, functools.partial):
            base = base.func
        return getattr(base, "forward_reward_name", None)

    @property
    def _robot(self) -> RobotSpec | None:
        return self.robot or ROBOTS.get(self.base_name)


def _uni(
    base: Callable[..., Env], base_name: str, offsets: tuple[float, float | None]
) -> EnvironmentSpec:
    """Returns the task of running forward, with feet contact as the descriptor.

    Args:
        base: Makes the environment.
        base_name: Name that wrappers receive.
        offsets: Reward offset here, and in the original; ``None``: it has no such
            task.
    """
    return EnvironmentSpec(
        base,
        base_name,
        wrappers=(WrapperSpec(FeetContactWrapper),),
        descriptor_extractor=get_feet_contact_proportion,
        reward_offset=offsets[0],
        original_reward_offset=offsets[1],
    )


def _position(
    base: Callable[..., Env],
    base_name: str,
    offsets: tuple[float, float | None],
    limits: tuple[tuple[float, float], tuple[float, float]],
    *wrappers: Callable[..., Env],
    robot: RobotSpec | None = None,
    **place: object,
) -> EnvironmentSpec:
    """Returns a task with the last position, within limits, as the descriptor [m].

    Args:
        base: Makes the environment.
        base_name: Name that wrappers receive.
        offsets: Reward offset here, and in the original; ``None``: it has no such
            task.
        limits: Lowest and highest x and y.
        *wrappers: Wrappers around the descriptor wrapper.
        robot: Spec of the robot inside.
        **place: ``link`` and ``offset`` of ``XYPositionWrapper``, if the position is
            not that of the torso.
    """
    options = {"minval": limits[0], "maxval": limits[1], **place}
    return EnvironmentSpec(
        base,
        base_name,
        wrappers=(
            WrapperSpec(XYPositionWrapper, options),
            *(WrapperSpec(wrapper) for wrapper in wrappers),
        ),
        descriptor_extractor=get_final_xy_position,
        reward_offset=offsets[0],
        original_reward_offset=offsets[1],
        robot=robot,
    )


def _maze(
    base: Callable[..., Env],
    base_name: str,
    scene: Scene,
    offset: float,
    far: tuple[float, float],
    *,
    cell: float,
    **options: object,
) -> EnvironmentSpec:
    """Returns the task of reaching the target of a maze; descriptor: last position [m].

    Args:
        base: Makes the environment.
        base_name: Name that wrappers receive.
        scene: The maze.
        offset: The reward offset.
        far: x and y of the far corner of its area; the start is in the near corner.
        cell: Edge of a cell, with the start in the middle of one.
        **options: More options of the ``MazeWrapper``.
    """
    area = ((-cell / 2, -cell / 2), far)
    limits = {"minval": area[0], "maxval": area[1]}
    return EnvironmentSpec(
        base,
        base_name,
        wrappers=(
            WrapperSpec(XYPositionWrapper, limits),
            WrapperSpec(MazeWrapper, {"scene": scene, "area": area, **options}),
        ),
        descriptor_extractor=get_final_xy_position,
        reward_offset=offset,
    )


_ANYWHERE = ((-30.0, -30.0), (30.0, 30.0))
_YARD = ((-15.0, -15.0), (15.0, 15.0))
# around the start of the object, as far as a push brings it
_TABLE = ((-1.0, -1.0), (1.0, 1.0))
# a square around the disk of 0.21 m: 78.5 % of it are within reach
_REACH = ((-0.21, -0.21), (0.21, 0.21))

ENVIRONMENTS: dict[str, EnvironmentSpec] = {
    "ant": EnvironmentSpec(Ant, "ant"),
    "ant_uni": _uni(Ant, "ant", (4.35, 3.24)),
    "ant_omni": _position(Ant, "ant", (2.83, 3.0), _ANYWHERE, NoForwardRewardWrapper),
    "antnotrap": _position(Ant, "ant", (4.35, 3.38), ((0.0, -8.0), (70.0, 8.0))),
    "anttrap": _position(
        Ant, "ant", (4.35, 3.38), ((0.0, -8.0), (30.0, 8.0)), TrapWrapper
    ),
    "antmaze": _position(
        Ant, "ant", (39.53, 40.32), ((-5.0, -5.0), (40.0, 40.0)), MazeWrapper
    ),
    "halfcheetah": EnvironmentSpec(HalfCheetah, "halfcheetah"),
    "halfcheetah_uni": _uni(HalfCheetah, "halfcheetah", (5.51, 9.231)),
    "hopper": EnvironmentSpec(Hopper, "hopper"),
    "hopper_uni": _uni(Hopper, "hopper", (0.9, 0.9)),
    "humanoid": EnvironmentSpec(Humanoid, "humanoid"),
    "humanoid_uni": _uni(Humanoid, "humanoid", (0.0, 0.0)),
    "humanoid_omni": _position(
        Humanoid, "humanoid", (0.0, 0.0), _ANYWHERE, NoForwardRewardWrapper
    ),
    "humanoid_w_trap": EnvironmentSpec(HumanoidTrap, "humanoid_w_trap", robot=HUMANOID),
    "humanoidtrap": _position(
        HumanoidTrap,
        "humanoid_w_trap",
        (0.0, 0.0),
        ((0.0, -8.0), (30.0, 8.0)),
        robot=HUMANOID,
    ),
    "walker2d": EnvironmentSpec(Walker2d, "walker2d"),
    "walker2d_uni": _uni(Walker2d, "walker2d", (1.33, 1.413)),
    "pointmaze": EnvironmentSpec(
        PointMaze,
        "pointmaze",
        descriptor_extractor=get_final_xy_position,
        reward_offset=2.35,
        original_reward_offset=2.3431,
    ),
    "antmaze_u": _maze(Ant, "ant", ANTMAZE_U, 12.63, (10.0, 10.0), cell=4.0),
    "antmaze_big": _maze(Ant, "ant", ANTMAZE_BIG, 30.21, (22.0, 22.0), cell=4.0),
    "antmaze_hardest": _maze(
        Ant, "ant", ANTMAZE_HARDEST, 45.26, (26.0, 38.0), cell=4.0
    ),
    "humanoid_maze": _maze(
        Humanoid,
        "humanoid",
        HUMANOID_MAZE,
        4.84,
        (5.0, 5.0),
        cell=2.0,
        heights=(0.8, 2.1),
    ),
    "walker2d_trap": _uni(
        functools.partial(
            Walker2d, scene=HURDLES, exclude_current_positions_from_observation=False
        ),
        "walker2d",
        (1.51, None),
    ),
    "acrobot": EnvironmentSpec(Acrobot, "acrobot"),
    "fetch": EnvironmentSpec(Fetch, "fetch"),
    "grasp": EnvironmentSpec(Grasp, "grasp"),
    "humanoidstandup": EnvironmentSpec(HumanoidStandup, "humanoidstandup"),
    "inverted_double_pendulum": EnvironmentSpec(
        InvertedDoublePendulum, "inverted_double_pendulum"
    ),
    "inverted_pendulum": EnvironmentSpec(InvertedPendulum, "inverted_pendulum"),
    "pusher": EnvironmentSpec(Pusher, "pusher"),
    "reacher": EnvironmentSpec(Reacher, "reacher"),
    "reacherangle": EnvironmentSpec(ReacherAngle, "reacherangle"),
    "swimmer": EnvironmentSpec(Swimmer, "swimmer"),
    "ur5e": EnvironmentSpec(Ur5e, "ur5e"),
    "pusher_uni": _position(
        TablePusher, "pusher_table", (1.81, None), _TABLE, robot=PUSHER_TABLE
    ),
    "arm_reach": _position(
        ArmReach,
        "arm_reach",
        (2.0, None),
        _REACH,
        robot=REACHER,
        link=TIP[0],
        offset=TIP[1],
    ),
    "quadruped": EnvironmentSpec(Quadruped, "quadruped"),
    "quadruped_uni": _uni(Quadruped, "quadruped", (0.95, None)),
    "quadruped_omni": _position(
        Quadruped, "quadruped", (0.14, None), _YARD, NoForwardRewardWrapper
    ),
}

SUITE = frozenset(ENVIRONMENTS)
"""Names of the suite. ``register`` adds names, and may replace these others only."""
