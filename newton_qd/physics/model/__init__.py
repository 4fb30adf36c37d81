"""Builds a System from a robot's URDF file, before the first step.

``xml_reader``, ``elements`` and ``description`` read the file. ``robot_checks`` checks
the ``RobotSpec``. ``build`` builds Newton's model, and ``verify`` compares this model
with the file. ``contacts`` adds the contacts, ``scene`` the obstacles and ``rest`` the
default pose.
"""

from newton_qd.physics.model.build import build_system, load_system, newton_builder
from newton_qd.physics.model.verify import ModelMismatchError
from newton_qd.physics.model.xml_reader import RobotDescriptionError

__all__ = [
    "ModelMismatchError",
    "RobotDescriptionError",
    "build_system",
    "load_system",
    "newton_builder",
]
