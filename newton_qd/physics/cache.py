"""Where compiled kernels are kept, and what Newton built."""

from __future__ import annotations

import warp as wp


def kernel_cache() -> str:
    """Returns the folder of compiled kernels."""
    wp.init()
    return str(wp.config.kernel_cache_dir)
