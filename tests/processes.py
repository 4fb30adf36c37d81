"""Processes that tests start: none of them outlives its time."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Sequence
from typing import Any

SECONDS = 300.0


def start(
    arguments: Sequence[str], *, seconds: float = SECONDS, **options: Any
) -> subprocess.Popen[str]:
    """A process with its output in pipes, killed after ``seconds``."""
    streams: dict[str, Any] = {"stdin": subprocess.DEVNULL}
    streams |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(arguments, text=True, **{**streams, **options})
    watchdog = threading.Timer(seconds, process.kill)
    watchdog.daemon = True
    watchdog.start()
    return process
