"""``newton-qd doctor``: checks the installation."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import re
import time
from pathlib import Path
from typing import Any

from newton_qd.cli.arguments import FAILED, OK

_STEPS = 20  # of the check
_ANT_HEIGHT = (0.1, 1.5)  # of the torso of an ant that stands or lies [m]


def run(arguments: argparse.Namespace) -> int:
    """Prints what is installed and whether it works. Returns the exit code."""
    machine = f"{platform.system()} {platform.machine()}"
    found = {
        "python": platform.python_version(),
        "machine": f"{machine}, {_cores()} usable cores",
        "packages": _packages(),
        "devices": _devices(),
        "kernel_cache": _kernel_cache(),
        "missing_extras": _missing(),
        "check": _tried(),
    }
    print(json.dumps(found, indent=2) if arguments.json else _text(found))
    return OK if found["check"]["passed"] else FAILED


def _cores() -> int:
    """Returns the number of cores that this process may use.

    The physics has this function, too, but its import fails without a kernel cache.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _packages() -> dict[str, str | None]:
    """Returns the versions of the packages that results depend on."""
    from newton_qd.qd.facts import package_versions

    return package_versions()


def _devices() -> list[str]:
    """Returns the devices that JAX uses."""
    import jax

    try:
        devices = jax.devices()
    except (AssertionError, RuntimeError) as error:  # such as JAX_PLATFORMS=cuda
        text = str(error) or type(error).__name__
        return [f"none ({text.splitlines()[0]})"]
    return [
        f"{device.platform}:{device.id}"
        + ("" if device.device_kind == device.platform else f" {device.device_kind}")
        for device in devices
    ]


def _kernel_cache() -> dict[str, Any]:
    """Returns the folder of compiled kernels, and whether it can be written."""
    try:
        from newton_qd.physics.cache import kernel_cache

        folder = Path(kernel_cache())
    except OSError as error:  # Warp cannot make it, already at the import
        return {"folder": error.filename, "writable": False}
    return {"folder": str(folder), "writable": os.access(folder, os.W_OK)}


def _missing() -> dict[str, list[str]]:
    """Returns the packages that each extra lacks."""
    found: dict[str, list[str]] = {}
    try:
        required = importlib.metadata.requires("newton_qd") or []
    except importlib.metadata.PackageNotFoundError:  # a checkout that is not installed
        return found
    for requirement in required:
        extra = re.search(r"extra == ['\"](\w+)['\"]", requirement)
        package = re.split(r"[^\w.-]", requirement)[0]
        if extra is None or package == "newton_qd" or extra[1] in ("all", "dev"):
            continue
        try:
            importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found.setdefault(extra[1], []).append(package)
    return found


def _tried() -> dict[str, Any]:
    """Runs an ant for a second of its time. Any error is a result of the check."""
    began = time.perf_counter()
    try:
        problem = _walk()
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    seconds = round(time.perf_counter() - began, 1)
    return {"passed": problem is None, "problem": problem, "seconds": seconds}


def _walk() -> str | None:
    """Steps an ant; returns what is wrong with it, or ``None``."""
    import jax
    import jax.numpy as jnp

    import newton_qd

    env: Any = newton_qd.create("ant", auto_reset=False)

    def body(state: Any, action: Any) -> tuple[Any, None]:
        return env.step(state, action), None

    def roll(key: Any) -> Any:
        actions = jnp.zeros((_STEPS, env.action_size), jnp.float32)
        return jax.lax.scan(body, env.reset(key), actions)[0]

    state = jax.jit(roll)(jax.random.key(0))
    newton_qd.check(state)
    height = float(state.pipeline_state.q[2])
    if not _ANT_HEIGHT[0] < height < _ANT_HEIGHT[1]:
        return f"an ant that should stand has its torso at a height of {height:g} m"
    return None


def _text(found: dict[str, Any]) -> str:
    """Returns the report as text."""
    check, cache = found["check"], found["kernel_cache"]
    lines = [f"python {found['python']}, {found['machine']}"]
    for package, version in found["packages"].items():
        lines.append(f"  {package} {version or 'is not installed'}")
    lines.append(f"devices of JAX: {', '.join(found['devices'])}")
    writable = "" if cache["writable"] else ", which cannot be written"
    lines.append(f"compiled kernels: {cache['folder']}{writable}")
    for extra, packages in found["missing_extras"].items():
        lines.append(
            f"extra {extra} lacks {', '.join(packages)}: "
            f"pip install 'newton_qd[{extra}]'"
        )
    if check["passed"]:
        lines.append(
            f"check: an ant stands for {_STEPS} control steps, {check['seconds']} s "
            "with compiling"
        )
    else:
        lines.append(f"check failed: {check['problem']}")
    return "\n".join(lines)
