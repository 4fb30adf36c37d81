"""What every test shares: the device it runs on, and JAX's 64-bit mode.

On a machine with an NVIDIA GPU every test runs twice, on the CPU and on the GPU;
``-m gpu`` and ``-m "not gpu"`` choose. Without a GPU, tests run on the CPU and those
that are marked ``gpu`` themselves are skipped.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from typing import Any

# Tests run in several processes, which share the memory of a GPU. JAX reads this once.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import pytest


@functools.cache
def gpu_available() -> bool:
    """Whether JAX sees an NVIDIA GPU."""
    try:
        return bool(jax.devices("gpu"))
    except RuntimeError:
        return False


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test on every device of this machine."""
    if not gpu_available():
        return
    only_gpu = metafunc.definition.get_closest_marker("gpu") is not None
    gpu = pytest.param("gpu", marks=pytest.mark.gpu)
    metafunc.parametrize(
        "device", [gpu] if only_gpu else ["cpu", gpu], indirect=True, scope="session"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a GPU where there is none."""
    if gpu_available():
        return
    for item in items:
        if item.get_closest_marker("gpu") is not None:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU on this machine"))


@pytest.fixture(scope="session", autouse=True)
def device(request: pytest.FixtureRequest) -> Iterator[Any]:
    """JAX device that the test runs on; arrays and jitted code go there."""
    chosen = jax.devices(getattr(request, "param", "cpu"))[0]
    with jax.default_device(chosen):
        yield chosen


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX's 64-bit mode, for this test alone."""
    with jax.enable_x64(True):
        yield
