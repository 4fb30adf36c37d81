"""Copies of a simulated robot that differ in one thing."""

from __future__ import annotations

import abc
import copy
import dataclasses
from typing import Any, Self

from newton_qd import checks
from newton_qd.checks import Fact, listed, message
from newton_qd.envs.env import Env
from newton_qd.physics.system import JointKind, System
from newton_qd.robots import Material, RobotSpec
from newton_qd.scenes import Scene

ROBOT = "a newton_qd.robots.RobotSpec"
"""What ``with_robot`` takes."""


class WithChanges(Env):
    """Makes copies that differ in one thing; the environment itself stays the same.

    Attributes:
        robot: Spec of the robot.
        system: The robot in the form that the physics uses.
    """

    robot: RobotSpec
    system: System

    @abc.abstractmethod
    def _built(self, scene: Scene | None) -> System:
        """Returns the robot in a scene."""

    @abc.abstractmethod
    def _load(self, scene: Scene | None) -> None:
        """Sets ``system``, and all that follows from it."""

    def with_scene(self, scene: Scene | None) -> Self:
        """Returns the same environment in another scene.

        Args:
            scene: Obstacles on the ground; ``None``: no obstacles.

        Raises:
            TypeError: ``scene`` is not a ``Scene``.
            ValueError: The scene cannot be built. The error names the file and line.
            FileNotFoundError: Its URDF file is missing.
        """
        return self._with(scene)

    def with_robot(self, robot: RobotSpec) -> Self:
        """Returns the same task for another robot, such as a damaged one.

        Args:
            robot: Spec of a robot with the same joints, links, torso, feet and
                actuators, in the same order. Lengths, masses, limits, gears and
                contacts may differ, and more links may be fixed to the world. The tips
                that ``Reacher`` and ``InvertedDoublePendulum`` read stay where they are
                on the links of their own robots, and ``Swimmer`` keeps the drag of its
                own links.

        Raises:
            TypeError: ``robot`` is not a ``RobotSpec``.
            ValueError: Its joints, links, torso, feet or actuators differ, its
                observations have another length, or it cannot be built.
            FileNotFoundError: Its URDF file is missing.
        """
        checks.instance("robot", robot, RobotSpec, ROBOT)
        changed = copy.copy(self)
        changed.robot = robot
        # before the task reads places that another robot does not have
        _require_fit(changed._built(self.system.scene), self.system)
        changed._load(self.system.scene)
        new, own = changed.observation_size, self.observation_size
        if new != own:
            why = f"whose observations have length {new}"
            allowed = f"a robot whose observations have length {own}, as in this task"
            raise ValueError(message("robot", Fact(robot.name), allowed, why=why))
        return changed

    def with_material(self, material: Material) -> Self:
        """Returns the same environment with another material.

        Args:
            material: Softness of contacts and joint limits.

        Raises:
            TypeError: ``material`` is not a ``Material``.
            ValueError: A number of the material is out of its range.
        """
        robot = dataclasses.replace(self.robot, material=material)
        return self._with(self.system.scene, robot=robot)

    def with_feet_width(self, width: float, tail: str = "exponential") -> Self:
        """Returns the same environment with another smooth feet contact.

        Args:
            width: Share of the robot's weight over which it rises from 0 to 1 [-].
            tail: How its slope decays for large loads: ``"exponential"`` or
                ``"algebraic"``.

        Raises:
            ValueError: ``width`` is not above 0, or ``tail`` is not allowed.
        """
        scene = self.system.scene
        return self._with(scene, _feet_width=width, _feet_tail=tail)

    def _with(self, scene: Scene | None, **attributes: Any) -> Self:
        changed = copy.copy(self)
        vars(changed).update(attributes)
        changed._load(scene)
        return changed


def _require_fit(system: System, task: System) -> None:
    """Checks that a task may read the state of a robot by places and names.

    Raises:
        ValueError: The joints, the links, the torso, the feet or the actuators differ.
    """
    for name, new, own in (
        ("joints", _joints(system), _joints(task)),
        ("links", list(system.body_names), list(task.body_names)),
        ("fixed links", list(system.scene_links), list(task.scene_links)),
        ("torso and feet", _watched(system), _watched(task)),
        ("actuators", _actuators(system), _actuators(task)),
    ):
        # tasks find fixed links by name, so there may be more of them
        fits = set(own) <= set(new) if name == "fixed links" else new == own
        if not fits:
            why = f"whose {name} are {listed(new)}"
            allowed = f"a robot with the {name} of this task: {listed(own)}"
            raise ValueError(
                message("robot", Fact(system.robot.name), allowed, why=why)
            )


def _joints(system: System) -> list[str]:
    kinds = zip(system.joint_names, system.joint_kind, strict=True)
    return [
        f"{name or 'root'} ({JointKind(kind).name.lower()})" for name, kind in kinds
    ]


def _watched(system: System) -> list[str]:
    return [system.robot.torso, *system.robot.feet]


def _actuators(system: System) -> list[str]:
    robot = system.robot
    servos = {name: f"{name} (servo)" for name in robot.servos}
    return [servos.get(name, name) for name, _ in robot.actuators]
