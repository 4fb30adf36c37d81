"""Builds the kernels that most tests need, one process for each core.

Worker processes that start together would each build them, because a kernel is in
Warp's cache only when it is finished. Run as a script, it builds one variant.
"""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# Environment, type and kernel of each module, the longest to compile first.
VARIANTS = (
    ("ant", "float64", "step_backward"),
    ("ant", "float32", "step_backward"),
    ("ant", "float64", "step_forward"),
    ("ant", "float32", "step_forward"),
    ("antmaze", "float32", "step_forward"),
    ("ant", "float32", "kinematics_forward"),
    ("ant", "float64", "kinematics_forward"),
)
TIMEOUT_S = 600.0


def main(processes: int) -> None:
    """Builds every variant, so many at a time."""
    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(_in_a_process, VARIANTS))


def _in_a_process(variant: tuple[str, ...]) -> None:
    # a kernel that does not compile fails the tests that use it, not the session
    command = [sys.executable, str(Path(__file__)), *variant]
    subprocess.run(command, check=False, timeout=TIMEOUT_S, capture_output=True)


def build(env_name: str, dtype: str, kernel: str) -> None:
    """Builds one variant in this process."""
    import jax
    import warp as wp

    import newton_qd
    from newton_qd.envs.base import PhysicsEnv
    from newton_qd.physics.bridge import launcher

    jax.config.update("jax_enable_x64", dtype == "float64")
    env = newton_qd.create(env_name, dtype=dtype).unwrapped
    assert isinstance(env, PhysicsEnv)
    launcher(env.system, wp.get_device("cpu")).prepare(kernel)


if __name__ == "__main__":
    build(*sys.argv[1:])
