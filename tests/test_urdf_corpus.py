"""Real URDF files load and move, or are refused for a reason that is listed here.

The files come from the newton wheel, and from packages that are downloaded from the
package index once (140 MB) and kept in pytest's cache. None of them is part of this
project. Without a network, the tests of a package are skipped, with the reason.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import rollout
from urdf_corpus import PACKAGES, UnavailableError, fetched, system_of

from newton_qd.physics.model import RobotDescriptionError, RobotDescriptionWarning

pytestmark = pytest.mark.slow

# Package and file, without ".urdf". A path that begins with "!" has a fixed base.
MOVING = [
    "newton !examples/assets/cartpole",
    "newton examples/assets/quadruped",
    "example a1_description/urdf/a1",
    "example alex_description/urdf/alex_nub_hands",
    "example alex_description/urdf/alex_sake_hands",
    "example alexander_description/urdf/alexander_v1.lowerBodyOnly",
    "example anymal_b_simple_description/robots/anymal",
    "example anymal_b_simple_description/robots/anymal-kinova",
    "example anymal_c_simple_description/urdf/anymal",
    "example asr_twodof_description/urdf/TwoDofs",
    "example b1_description/urdf/b1",
    "example borinot_description/urdf/borinot_flying_arm_2",
    "example !double_pendulum_description/urdf/double_pendulum",
    "example !double_pendulum_description/urdf/double_pendulum_simple",
    "example !finger_edu_description/robots/finger_edu",
    "example g1_description/urdf/g1_29dof_rev_1_0",
    "example g1_description/urdf/g1_29dof_with_hand_rev_1_0",
    "example go2_description/urdf/go2",
    "example hector_description/robots/quadrotor_base",
    "example human_description/robots/human",
    "example hyq_description/robots/hyq_no_sensors",
    "example iris_description/robots/iris",
    "example laikago_description/urdf/laikago",
    "example quadruped_description/urdf/quadruped",
    "example simple_humanoid_description/urdf/simple_humanoid",
    "example simple_humanoid_description/urdf/simple_humanoid_classical",
    "example !so_arm_description/urdf/so100",
    "example !so_arm_description/urdf/so101",
    "example solo_description/robots/solo",
    "example solo_description/robots/solo12",
    "example !ur_description/urdf/ur3_gripper",
    "example !ur_description/urdf/ur5_robot",
    "example !ur_description/urdf/ur10_joint_limited_robot",
    "fingers !finger",
    "fingers !edu/fingeredu",
    "fingers !pro/trifingerpro",
    "upkie upkie",
    "airo !arms/ur3e/ur3e",
    "airo !arms/ur5e/ur5e",
    "airo mobile_platforms/kelo_robile/urdf/wheel_brick",
]
FRICTION = r"line \d+, <dynamics>: friction: got .* joint friction is not supported"
MIMIC = r"line \d+, <joint name=.*>: <mimic> is not supported"
MOMENTS = r"line \d+, <inertia>: principal moments: got .*none larger than the sum"
REFUSED = {
    "newton examples/assets/cartpole": "floating root link 'slider' .* fixed_base=True",
    "newton tests/assets/humanoid": FRICTION,
    "example allegro_hand_description/urdf/allegro_left_hand": FRICTION,
    "example centauro_description/urdf/centauro": FRICTION,
    "example go1_description/urdf/go1": FRICTION,
    "example tiago_description/robots/tiago": FRICTION,
    "example xarm_description/urdf/xarm7": FRICTION,
    "example baxter_description/urdf/baxter": MIMIC,
    "example panda_description/urdf/panda": MIMIC,
    "example pr2_description/urdf/pr2": MIMIC,
    "example romeo_description/urdf/romeo": MIMIC,
    "airo grippers/robotiq_2f_85/urdf/robotiq_2f_85": MIMIC,
    "example icub_description/robots/icub": MOMENTS,
    "example romeo_description/urdf/romeo_small": MOMENTS,
    "example bolt_description/robots/bolt": "<mass>: value: got '0.0*'; allowed: pos",
    "example kinova_description/robots/kinova": "none for a continuous joint",
    "example talos_data/robots/talos_full_v2": "mesh as collider.* no file on this",
    "example ur_description/urdf/ur3": "element <link> is missing",
    "airo cameras/zed/zedm": "<inertial>: element <inertia> is missing",
    "airo mobile_platforms/kelo_robile/urdf/mobi": "mass of link 'base_link' and all",
}


@pytest.fixture(scope="module")
def corpus(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], tuple[Path, bool | None]]:
    """Path and ``fixed_base`` of a robot; skips its test without its package."""
    cache = getattr(request.config, "cache", None)
    folder = cache.mkdir("urdf") if cache else tmp_path_factory.mktemp("urdf")
    found: dict[str, Path | UnavailableError] = {}

    def find(robot: str) -> tuple[Path, bool | None]:
        package, name = robot.split(" ")
        if package not in found:
            try:
                found[package] = fetched(package, folder)
            except UnavailableError as error:
                found[package] = error
        root = found[package]
        if isinstance(root, UnavailableError):
            pytest.skip(f"the URDF files cannot be downloaded: {root}")
        path = root / f"{name.removeprefix('!')}.urdf"
        return path, True if name.startswith("!") else None

    return find


@pytest.mark.parametrize("robot", MOVING)
def test_robot_moves(robot: str, corpus: Callable) -> None:
    path, fixed_base = corpus(robot)
    with warnings.catch_warnings():
        # one file has a revolute joint without bounds
        warnings.simplefilter("ignore", RobotDescriptionWarning)
        system = system_of(path, fixed_base)
    rng = np.random.default_rng(0)
    controls = rng.uniform(-1.0, 1.0, (100, system.nu)).astype(np.float32)
    rest, still = jnp.asarray(system.rest_q, jnp.float32), jnp.zeros(system.nv)
    states = rollout(system)(rest, still.astype(jnp.float32), jnp.asarray(controls))
    assert np.isfinite(states.q).all()
    assert np.abs(states.v).max() < 1000.0  # a faster world has a fault
    assert system.nv == 6 or np.ptp(np.asarray(states.q)[:, -1]) > 1e-4


@pytest.mark.parametrize("robot", REFUSED)
def test_robot_is_refused(robot: str, corpus: Callable) -> None:
    path, fixed_base = corpus(robot)
    with pytest.raises(RobotDescriptionError, match=REFUSED[robot]) as caught:
        system_of(path, fixed_base)
    assert re.match(rf"{re.escape(str(path))}[,:]", str(caught.value))


def test_the_corpus_is_large() -> None:
    assert len(MOVING) >= 30
    packages = {robot.split(" ")[0] for robot in [*MOVING, *REFUSED]}
    assert packages == {"newton", *PACKAGES}
