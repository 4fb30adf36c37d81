"""From a robot's URDF file to a System: everything that runs before the first step.

``xml_reader``, ``elements`` and ``description`` read the file, ``robot_checks`` checks
the robot, ``build`` lets Newton build its model and ``verify`` compares the two.
``contacts``, ``scene`` and ``rest`` add what can touch what, the walls and the default
pose.
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
