"""Builds a System from a robot's URDF file, before the first step.

``xml_reader``, ``elements`` and ``description`` read the file. ``robot_checks`` checks
the ``RobotSpec``. ``newton_input`` is what Newton gets of the file. ``build`` builds
Newton's model, and ``verify`` compares this model with the file. ``kept_models`` keeps
it for the next process. ``contacts`` adds the contacts, ``scene`` the obstacles and
``rest`` the default pose. ``inertia`` checks what the joints move. ``wall_speeds``
computes how fast a robot may hit a wall.
"""

from newton_qd.physics.model.build import build_system, load_system, newton_builder
from newton_qd.physics.model.verify import ModelMismatchError
from newton_qd.physics.model.xml_reader import (
    RobotDescriptionError,
    RobotDescriptionWarning,
)

__all__ = [
    "ModelMismatchError",
    "RobotDescriptionError",
    "RobotDescriptionWarning",
    "build_system",
    "load_system",
    "newton_builder",
]
