"""What Warp prints: only warnings, unless ``NEWTON_QD_VERBOSE=1`` asks for more."""

from __future__ import annotations

import os
import sys
import tempfile

import warp as wp

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def quiet() -> None:
    """Turns off Warp's banner and its lines about modules, for the whole process.

    It changes nothing with ``NEWTON_QD_VERBOSE=1``, or if the program has chosen a log
    level of Warp.
    """
    if os.environ.get("NEWTON_QD_VERBOSE") == "1":
        return
    if wp.config.log_level == wp.LOG_INFO:  # the default
        wp.config.log_level = wp.LOG_WARNING
    _begin_without_driver()


def _begin_without_driver() -> None:
    """Starts Warp, without its warning that a machine has no GPU.

    Warp's native library writes it to file descriptor 2 before it can be told not to.
    Other lines are written again.
    """
    sys.stderr.flush()
    try:
        saved = os.dup(2)
    except OSError:  # no standard error, as in a service
        wp.init()
        return
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            rest = [line for line in file if _NO_DRIVER not in line]
            if rest:
                os.write(2, b"".join(rest))
