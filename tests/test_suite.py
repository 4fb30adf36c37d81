"""Rules for the tests themselves."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import processes
import pytest

import newton_qd

TESTS = Path(__file__).parent


def calls(function: str) -> Iterator[tuple[str, ast.Call]]:
    """File and call of every use of a function of ``subprocess`` in the tests."""
    for path in sorted(TESTS.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if ast.unparse(node.func) == f"subprocess.{function}":
                    yield f"{path.name}:{node.lineno}", node


def test_every_process_has_an_end() -> None:
    found = list(calls("run"))
    assert found
    for place, call in found:
        assert "timeout" in {keyword.arg for keyword in call.keywords}, place
    assert {place.split(":")[0] for place, _ in calls("Popen")} == {"processes.py"}


def test_a_process_is_killed_when_its_time_is_over() -> None:
    code = "import time; print('ready', flush=True); time.sleep(60)"
    process = processes.start([sys.executable, "-c", code], seconds=3.0)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == -signal.SIGKILL
    assert output in ("ready\n", "")


@pytest.mark.skipif(
    "NEWTON_QD_TEST_INSTALLED" not in os.environ, reason="asked for by .ci/run only"
)
def test_the_tests_run_against_the_installed_wheel() -> None:
    command = [sys.executable, "-c", "import newton_qd; print(newton_qd.__file__)"]
    done = subprocess.run(
        command, cwd=TESTS, capture_output=True, text=True, check=True, timeout=60
    )
    for file in (newton_qd.__file__, done.stdout.strip()):
        assert TESTS.parent not in Path(file).parents


def test_xla_compiles_fast_unless_asked(request: pytest.FixtureRequest) -> None:
    flag = "--xla_backend_optimization_level=0"
    optimized = request.config.getoption("optimized")
    gpu = Path("/proc/driver/nvidia").exists()
    assert (flag in os.environ.get("XLA_FLAGS", "")) == (not optimized and not gpu)


def test_sigint_reaches_processes_that_tests_start(sigint: None) -> None:
    code = "import signal; print(signal.getsignal(signal.SIGINT).__name__)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout == "default_int_handler\n"
