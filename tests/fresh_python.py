"""Code in a Python of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def run_python(
    code: str, cwd: Path, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter in which a warning for our code is an error."""
    own = "import warnings; warnings.filterwarnings('error', module='newton_qd')\n"
    return subprocess.run(
        [sys.executable, "-c", own + code],
        cwd=cwd,
        env={**os.environ, **variables},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
