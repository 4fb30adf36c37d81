"""What environments and the physics show: texts, attributes and messages."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import newton_qd
from newton_qd.wrappers import RandomParamsWrapper

TESTS = Path(__file__).resolve().parent


def test_text_and_attributes_of_an_environment() -> None:
    plain: Any = newton_qd.create("pointmaze", episode_length=7)
    assert repr(plain) == (
        "<pointmaze: observation 2, action 2, descriptor xy_position 2, 1 s; "
        "PointMaze, EpisodeWrapper(episode_length=7, action_repeat=1), "
        "AutoResetWrapper>"
    )
    env: Any = newton_qd.create("ant_uni", batch_size=3, healthy_reward=0.5)
    text = repr(env)
    assert text.startswith(
        "<ant_uni: observation 87, action 8, descriptor feet_contact 4, batch 3, "
        "0.05 s; Ant(healthy_reward=0.5), FeetContactWrapper"
    )
    assert "VectorWrapper(batch_size=3), AutoResetWrapper>" in text
    assert repr(env.unwrapped).startswith(
        "<ant: observation 87, action 8, 0.05 s; Ant("
    )
    moving = RandomParamsWrapper(newton_qd.create("ant_uni"), friction=(0.5, 1.5))
    assert "RandomParamsWrapper(ranges={'friction': (0.5, 1.5)})>" in repr(moving)
    maze = repr(newton_qd.create("antmaze"))
    assert maze.count("MazeWrapper") == 1 and "Ant, MazeWrapper(scene=maze" in maze
    # what the wrappers forward
    names = dir(env)
    for name in ("batch_size", "episode_length", "system", "state_descriptor_limits"):
        assert name in names and hasattr(env, name)
    assert "env" in names and not np.any([name.startswith("__x") for name in names])


PROGRAM = (
    "import jax, jax.numpy as jnp, newton_qd\n"
    "env = newton_qd.create('hopper')\n"
    "state = jax.jit(env.reset)(jax.random.key(0))\n"
    "jax.jit(env.step)(state, jnp.zeros(3)).reward.block_until_ready()\n"
)


@pytest.mark.slow
@pytest.mark.parametrize("verbose", [False, True])
def test_messages_of_warp_are_asked_for(verbose: bool) -> None:
    environment = {**os.environ, "NEWTON_QD_VERBOSE": "1" if verbose else ""}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=TESTS.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    printed = done.stdout + done.stderr
    assert ("initialized" in printed and "Module" in printed) == verbose
    assert verbose or not printed


@pytest.mark.slow
def test_a_level_of_messages_that_a_program_chose_stays() -> None:
    code = "import warp as wp\nwp.config.log_level = wp.LOG_DEBUG\n"
    code += "import newton_qd.physics\nassert wp.config.log_level == wp.LOG_DEBUG\n"
    code += "import os; os.write(2, b'still there')\n"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=TESTS.parent,
        capture_output=True,
        check=True,
        timeout=300,
    )
    assert done.stderr.endswith(b"still there")
