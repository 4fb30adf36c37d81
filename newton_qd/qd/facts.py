"""Facts of the machine that the result of a run depends on."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Iterable
from typing import cast

_PACKAGES = (
    "newton_qd",
    "newton",
    "warp-lang",
    "jax",
    "jaxlib",
    "numpy",
    "qdax",
    "flax",
    "optax",
)


def environment_facts() -> dict[str, object]:
    """Returns versions and machine data that a bit-exact repetition of a run needs.

    The backend is that of the device on which new arrays are: within
    ``jax.default_device(...)``, it may be another one than JAX's own choice.
    """
    import jax

    (device,) = jax.device_put(0.0).devices()
    return {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "backend": device.platform,
        "x64": bool(jax.config.read("jax_enable_x64")),
        "packages": package_versions(),
    }


def package_versions() -> dict[str, str | None]:
    """Returns the versions of the packages that results depend on."""
    return {name: _version(name) for name in _PACKAGES}


def _version(package: str) -> str | None:
    if package == "newton_qd":  # a checkout may be newer than what pip has noted
        from newton_qd import __version__

        return __version__
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def changed_facts(
    old: dict[str, object], new: dict[str, object]
) -> Iterable[tuple[str, object, object]]:
    """Yields ``(name, old, new)`` of machine facts that differ between two runs."""
    old_flat = {**old, **_packages(old)}
    new_flat = {**new, **_packages(new)}
    for name in new_flat:
        if name != "packages" and old_flat.get(name) != new_flat[name]:
            yield name, old_flat.get(name), new_flat[name]


def _packages(facts: dict[str, object]) -> dict[str, object]:
    return cast("dict[str, object]", facts.get("packages", {}))
