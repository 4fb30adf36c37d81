"""Files that are either whole or absent."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def temporary_name(path: Path) -> Path:
    """Name under which a file is written before it replaces ``path``."""
    return path.with_name(f".{path.name}.tmp")


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file so that a reader sees the old or the new one, never a part.

    Args:
        path: File to write or replace.
        content: Everything that the file shall hold.

    Raises:
        OSError: The disk is full, or the folder cannot be written to; the old file
            is as it was.
    """
    temporary = temporary_name(path)
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            # Without this a power cut after the rename can leave an empty file.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        # The system's message, which does not always say for which file.
        raise OSError(error.errno, error.strerror, str(path)) from error
