"""Everything that you need for your own environment, in one import.

    import newton_qd.authoring as nq

- ``PhysicsEnv``: the base class; ``Locomotion``: running forward, for any robot
- ``RobotSpec``, ``Contact``, ``Material``: data of a robot beside its URDF file
- ``Scene``: obstacles from a URDF file
- ``DescriptorWrapper``: the base class for descriptors; ``FeetContactWrapper`` and
  ``XYPositionWrapper``: descriptors of the suite; ``NoForwardRewardWrapper``: no reward
  for running forward; ``Wrapper``: any other change
- ``WrapperSpec``: a wrapper with its options
- ``checked_options``, ``RolloutOrder``: checks of the options of a class, and how
  ``rollout`` may run its steps
- ``get_feet_contact_proportion``, ``get_final_xy_position``,
  ``get_mean_state_descriptor``: descriptors of episodes
- ``register``, ``create``: add an environment by name, and build it; ``create_fn``:
  build it later; ``registered_envs``: all names; ``check``: a state without faults
- ``length``, ``ordered_sum``, ``wrapped``: arithmetic with finite gradients and with
  results that do not depend on the batch size
- ``Env``, ``QDEnv``, ``State``, ``PhysicsState``, ``Kinematics``, ``Action``,
  ``Metrics``, ``Observation``, ``Params``, ``RNGKey``: the types

``docs/own_environment.md`` shows how to use them together.
"""

from newton_qd.envs.base import Env, PhysicsEnv, QDEnv
from newton_qd.envs.locomotion import Locomotion
from newton_qd.envs.options import checked_options
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State, check
from newton_qd.envs.vectors import length, ordered_sum, wrapped
from newton_qd.extractors import (
    get_feet_contact_proportion,
    get_final_xy_position,
    get_mean_state_descriptor,
)
from newton_qd.physics.system import Kinematics, PhysicsState
from newton_qd.registry import create, create_fn, register, registered_envs
from newton_qd.robots import Contact, Material, RobotSpec
from newton_qd.scenes import Scene
from newton_qd.tasks import WrapperSpec
from newton_qd.types import Action, Metrics, Observation, Params, RNGKey
from newton_qd.wrappers import (
    DescriptorWrapper,
    FeetContactWrapper,
    NoForwardRewardWrapper,
    Wrapper,
    XYPositionWrapper,
)

__all__ = [
    "Action",
    "Contact",
    "DescriptorWrapper",
    "Env",
    "FeetContactWrapper",
    "Kinematics",
    "Locomotion",
    "Material",
    "Metrics",
    "NoForwardRewardWrapper",
    "Observation",
    "Params",
    "PhysicsEnv",
    "PhysicsState",
    "QDEnv",
    "RNGKey",
    "RobotSpec",
    "RolloutOrder",
    "Scene",
    "State",
    "Wrapper",
    "WrapperSpec",
    "XYPositionWrapper",
    "check",
    "checked_options",
    "create",
    "create_fn",
    "get_feet_contact_proportion",
    "get_final_xy_position",
    "get_mean_state_descriptor",
    "length",
    "ordered_sum",
    "register",
    "registered_envs",
    "wrapped",
]
