"""Make QD tasks from your own robot: its URDF file, its spec, its names.

    python examples/own_robot.py [--env tripod_yard] [--iterations 40]

``tripod.urdf`` has masses, joints and colliders. The spec has what a URDF file cannot
describe. ``yard.urdf`` has the walls of the second task. docs/own_environment.md
explains how to write your own reward, observation or descriptor.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import newton_qd.authoring as nq

HERE = Path(__file__).resolve().parent
LEGS = ("1", "2", "3")

TRIPOD = nq.RobotSpec(
    name="tripod",
    urdf=str(HERE / "tripod.urdf"),
    torso="body",
    feet=tuple(f"foot_{leg}" for leg in LEGS),
    actuators=tuple(
        (f"{joint}_{leg}", 30.0) for leg in LEGS for joint in ("hip", "knee")
    ),
    contacts=(nq.Contact("body"), *(nq.Contact(f"foot_{leg}", end=-1) for leg in LEGS)),
    rest_pose=tuple((f"knee_{leg}", 0.8) for leg in LEGS),
    dt=0.04,
    substeps=5,
)

nq.register(
    "tripod_uni",
    nq.Locomotion,
    base_name="tripod",
    descriptor=nq.FeetContactWrapper,
    reward_offset=2.0,
    robot=TRIPOD,
    healthy_z_range=(0.21, 1.0),
)

# The same robot among walls; the descriptor is its final position.
YARD = nq.Scene("yard", str(HERE / "yard.urdf"))
LIMITS = {"minval": (-1.0, -4.0), "maxval": (8.0, 4.0)}
nq.register(
    "tripod_yard",
    nq.Locomotion,
    base_name="tripod",
    descriptor=nq.WrapperSpec(nq.XYPositionWrapper, LIMITS),
    reward_offset=2.0,
    robot=TRIPOD,
    healthy_z_range=(0.21, 1.0),
    scene=YARD,
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
