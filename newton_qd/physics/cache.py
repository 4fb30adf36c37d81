"""Where compiled kernels are kept, and what else takes long to make.

A file begins with the digest of its content, so a damaged one is as none.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

import warp as wp

from newton_qd.files import write_atomically

_DIGEST = hashlib.sha256().digest_size  # [bytes], before what it is of


def kernel_cache() -> str:
    """Returns the folder of compiled kernels."""
    wp.init()
    return str(wp.config.kernel_cache_dir)


def kept(path: Path) -> bytes | None:
    """Returns what an earlier process kept; ``None`` without a complete file."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    found = content[_DIGEST:]
    return found if hashlib.sha256(found).digest() == content[:_DIGEST] else None


def keep(path: Path, content: bytes) -> None:
    """Keeps bytes for later processes, if the folder can be written."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, hashlib.sha256(content).digest() + content)
