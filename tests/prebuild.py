"""Builds the kernels that most tests need, one process for each type.

Worker processes that start together would each build them, because a kernel is in
Warp's cache only when it is finished. Run as a script, it builds those of one type.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import processes

# Environment and kernel of each module.
KERNELS = {
    "float32": (
        ("ant", "step_backward"),
        ("ant", "step_forward"),
        ("antmaze", "step_forward"),
        ("ant", "bodies_forward"),
    ),
    "float64": (
        ("ant", "step_backward"),
        ("ant", "step_forward"),
        ("ant", "bodies_forward"),
    ),
}
TIMEOUT_S = 600.0


def main() -> None:
    """Builds the kernels of every type, all types at once.

    A cache that an earlier session filled is left alone.
    """
    folder = os.environ.get("WARP_CACHE_PATH")
    if folder and any(Path(folder).glob("*/*float64*backward*/*.o")):
        return
    builders = [
        processes.start(
            [sys.executable, str(Path(__file__)), dtype],
            seconds=TIMEOUT_S,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for dtype in KERNELS
    ]
    # a kernel that does not compile fails the tests that use it, not the session
    for builder in builders:
        builder.wait()


def build(dtype: str) -> None:
    """Builds the kernels of one type in this process."""
    import jax
    import warp as wp

    import newton_qd
    from newton_qd.envs.base import PhysicsEnv
    from newton_qd.physics.bridge import launcher

    jax.config.update("jax_enable_x64", dtype == "float64")
    for env_name, kernel in KERNELS[dtype]:
        env = newton_qd.create(env_name, dtype=dtype).unwrapped
        assert isinstance(env, PhysicsEnv)
        launcher(env.system, wp.get_device("cpu")).prepare(kernel)


if __name__ == "__main__":
    build(sys.argv[1])
