"""Builds what most tests need, in two processes.

Worker processes that start together would each build it, because a kernel is in Warp's
cache only when it is finished. Run as a script, it builds the share of one process.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import processes

# Type and module of kernels, or the name of an environment: to make its model, Newton
# needs kernels of its own. Both shares take equally long.
SHARES: tuple[tuple[tuple[str, str] | str, ...], ...] = (
    (
        ("float32", "backward"),
        ("float32", "forward"),
        ("float32", "bodies"),
        ("float64", "bodies"),
    ),
    (("float64", "backward"), ("float64", "forward"), "ant"),
)
TIMEOUT_S = 600.0


def main() -> None:
    """Builds all shares at once.

    A cache that an earlier session filled is left alone.
    """
    folder = os.environ.get("WARP_CACHE_PATH")
    if folder and any(Path(folder).glob("*/*float64*backward*/*.o")):
        return
    builders = [
        processes.start(
            [sys.executable, str(Path(__file__)), str(share)],
            seconds=TIMEOUT_S,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for share in range(len(SHARES))
    ]
    # a kernel that does not compile fails the tests that use it, not the session
    for builder in builders:
        builder.wait()


def build(share: int) -> None:
    """Builds a share in this process."""
    import warp as wp

    import newton_qd
    from newton_qd.physics.precision import Variant, build_kernels, pack_width

    cpu = wp.get_device("cpu")
    for item in SHARES[share]:
        if isinstance(item, str):
            newton_qd.create(item)
            continue
        dtype, name = item
        kernels = build_kernels(Variant(dtype, pack_width(dtype, cpu)))
        wp.load_module(getattr(kernels, name), device=cpu, block_dim=1)


if __name__ == "__main__":
    build(int(sys.argv[1]))
