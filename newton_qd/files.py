"""Files that are either complete or absent."""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

_ABANDONED = 3600.0  # age [s] of a temporary file whose writer was killed


def temporary_name(path: Path) -> Path:
    """Returns a new name of a temporary file that later replaces ``path``.

    Two writers of one file must not share it: one would rename what the other has not
    completed.
    """
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def temporary_files(path: Path) -> Iterator[Path]:
    """Yields the temporary files of ``path``: of killed writers, or of one at work."""
    # an earlier version had one name for all writers: .NAME.tmp
    return path.parent.glob(f".{glob.escape(path.name)}*.tmp")


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file. A reader sees the old or the new content, never a part.

    Args:
        path: File to write or replace.
        content: The complete content.

    Raises:
        OSError: The disk is full, or the folder is not writable. The old file did not
            change.
    """
    temporary = temporary_name(path)
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            # Without this, a power failure after the rename can leave an empty file.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:  # also an interrupt leaves no part behind
        with contextlib.suppress(OSError):
            temporary.unlink()
        if not isinstance(error, OSError):
            raise
        # The message of the system does not always name the file.
        raise OSError(error.errno, error.strerror, str(path)) from error
    remove_abandoned(path)


def remove_abandoned(path: Path) -> None:
    """Removes what killed writers of a file left behind an hour ago or earlier."""
    newest = time.time() - _ABANDONED
    for part in temporary_files(path):
        with contextlib.suppress(OSError):
            if part.stat().st_mtime < newest:
                part.unlink()
