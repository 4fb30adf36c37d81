"""A robot of one's own as a QD task: its file, its row, its name.

    python examples/own_robot.py [--iterations 40]

``tripod.urdf`` has masses, joints and colliders; the row says what a URDF cannot.
"""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

import newton_qd
from newton_qd.envs.locomotion import Locomotion
from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.registry import WrapperRow
from newton_qd.robots import Contact, Robot
from newton_qd.wrappers import FeetContactWrapper

LEGS = ("1", "2", "3")

TRIPOD = Robot(
    name="tripod",
    urdf=str(Path(__file__).resolve().with_name("tripod.urdf")),
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
    wrappers=(WrapperRow(FeetContactWrapper),),
    descriptor_extractor=get_feet_contact_proportion,
    reward_offset=2.0,
)


def main() -> None:
    from newton_qd.qd import EvolveConfig, evolve

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=40)
    options = parser.parse_args()
    config = EvolveConfig(env_name="tripod_uni", iterations=options.iterations, seed=0)
    archive = evolve(config).archive
    print(f"{archive.filled.sum()} gaits in {len(archive.filled)} cells")
    print(f"best return {archive.fitnesses.max():.1f}")


if __name__ == "__main__":
    main()
