"""A scripted hand lifts the object of ``grasp`` and holds it for two seconds.

    python examples/lift_object.py --out lift.html

It opens its fingers, closes them around the object, and goes up. The page shows it in a
browser. Every step is differentiable, so the script could also be the start of an
optimization, as in ``plan_hopper.py``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.viewing import record, write_replay

# control steps of 0.02 s; distal, middle and first angle of all fingers, bent down
# [deg]; height of the palm [m]
SCRIPT = (
    (40, (30.0, 45.0, 0.0), 3.5),
    (60, (75.0, 75.0, 40.0), 3.5),
    (60, (75.0, 75.0, 40.0), 8.0),
    (100, (75.0, 75.0, 40.0), 8.0),
)


def action_of(env, angles, height) -> np.ndarray:
    """Returns the action (19,) for angles of the fingers and a height of the palm."""
    low, high = env.unwrapped.servo_range
    # fingers bend down with positive angles, but the first one with negative angles
    targets = [
        np.radians(sign * angle) for sign in (-1, 1, 1, 1) for angle in (*angles, 0.0)
    ]
    return 2 * (np.array([*targets, 0.0, 0.0, height]) - low) / (high - low) - 1


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=260, help="of 0.02 s")
    parser.add_argument("--out", help="file of a page that shows it")
    arguments = parser.parse_args(argv)

    env = newton_qd.create("grasp", episode_length=None, auto_reset=False)
    parts = [np.tile(action_of(env, a, height), (n, 1)) for n, a, height in SCRIPT]
    plan = jnp.asarray(np.concatenate(parts)[: arguments.steps], env.dtype)
    trajectory = record(env, plan, jax.random.key(0))
    heights = trajectory.q[0, :, 2]  # the object's x, y and z are the first coordinates
    print(f"the object is {heights[-1]:.2f} m high, at most {heights.max():.2f} m")
    if arguments.out:
        print(write_replay(trajectory, arguments.out))


if __name__ == "__main__":
    main()
