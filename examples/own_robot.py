"""A robot of one's own as QD tasks: its file, its row, its names.

    python examples/own_robot.py [--env tripod_yard] [--iterations 40]

``tripod.urdf`` has masses, joints and colliders; the row says what a URDF cannot.
``yard.urdf`` has the walls of the second task.
"""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

import newton_qd
from newton_qd.envs.locomotion import Locomotion
from newton_qd.extractors import get_feet_contact_proportion, get_final_xy_position
from newton_qd.robots import Contact, RobotSpec
from newton_qd.scenes import Scene
from newton_qd.tasks import WrapperSpec
from newton_qd.wrappers import FeetContactWrapper, XYPositionWrapper

HERE = Path(__file__).resolve().parent
LEGS = ("1", "2", "3")

TRIPOD = RobotSpec(
    name="tripod",
    urdf=str(HERE / "tripod.urdf"),
    torso="body",
    feet=tuple(f"foot_{leg}" for leg in LEGS),
    actuators=tuple(
        (f"{joint}_{leg}", 30.0) for leg in LEGS for joint in ("hip", "knee")
    ),
    contacts=(Contact("body"), *(Contact(f"foot_{leg}", end=-1) for leg in LEGS)),
    rest_pose=tuple((f"knee_{leg}", 0.8) for leg in LEGS),
    dt=0.04,
    substeps=5,
)

newton_qd.register(
    "tripod_uni",
    functools.partial(Locomotion, TRIPOD, healthy_z_range=(0.21, 1.0)),
    base_name="tripod",
    wrappers=(WrapperSpec(FeetContactWrapper),),
    descriptor_extractor=get_feet_contact_proportion,
    reward_offset=2.0,
    robot=TRIPOD,
)

# The same robot among walls, described by where it comes to.
YARD = Scene("yard", str(HERE / "yard.urdf"))
newton_qd.register(
    "tripod_yard",
    functools.partial(Locomotion, TRIPOD, healthy_z_range=(0.21, 1.0), scene=YARD),
    base_name="tripod",
    wrappers=(
        WrapperSpec(XYPositionWrapper, {"minval": (-1.0, -4.0), "maxval": (8.0, 4.0)}),
    ),
    descriptor_extractor=get_final_xy_position,
    reward_offset=2.0,
    robot=TRIPOD,
)


def main() -> None:
    from newton_qd.qd import EvolveConfig, evolve

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--env", choices=("tripod_uni", "tripod_yard"), default="tripod_uni"
    )
    parser.add_argument("--iterations", type=int, default=40)
    options = parser.parse_args()
    config = EvolveConfig(env_name=options.env, iterations=options.iterations, seed=0)
    archive = evolve(config).archive
    print(f"{archive.filled.sum()} solutions in {len(archive.filled)} cells")
    print(f"best return {archive.fitnesses.max():.1f}")


if __name__ == "__main__":
    main()
