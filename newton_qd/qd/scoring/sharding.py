"""Evaluation on several devices of a mesh."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, TypeVar, TypeVarTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.types import ScoringFunction

AXIS = "individuals"

Inputs = TypeVarTuple("Inputs")
Result = TypeVar("Result")


def device_mesh(count: int | None = None) -> Mesh:
    """Returns a mesh of devices, along one axis.

    Args:
        count: Number of devices; ``None``: all devices, with those of other processes
            of ``jax.distributed``.

    Raises:
        ValueError: There are not so many devices.
    """
    devices = jax.devices()
    if count is None:
        count = len(devices)
    checks.integer("count", count, most=len(devices))
    return Mesh(np.array(devices[:count]), (AXIS,))


def device_named(name: str) -> Any:
    """Returns a device of JAX.

    Args:
        name: Platform, such as ``"cpu"`` or ``"gpu"``, and optionally the number of the
            device, as in ``"gpu:1"``.

    Raises:
        ValueError: There is no such device.
    """
    checks.text("device", name)
    platform, _, number = name.partition(":")
    found = [str(device) for device in jax.devices()]
    with contextlib.suppress(RuntimeError, ValueError, IndexError):
        devices = jax.devices(platform)
        found += [str(device) for device in devices if str(device) not in found]
        index = int(number or 0)
        if index >= 0:
            return devices[index]
    allowed = f"one that JAX finds: {listed(found)}"
    if platform in ("gpu", "cuda"):
        allowed += "; for a GPU, install newton_qd[cuda12] or newton_qd[cuda13]"
    raise ValueError(message("device", name, allowed))


def shard_scoring(score: ScoringFunction, mesh: Mesh) -> ScoringFunction:
    """Makes a scoring function whose batch is split over devices.

    Each device evaluates an equal part of the individuals. If necessary, the batch is
    extended with copies of the last individual, and their results are dropped. Every
    device then has all results. They are bitwise equal for any number of devices, if
    the result of an individual does not depend on its place in the batch. Every device
    has the same key. So a scoring function that splits it by individual, such as those
    of QDax with ``deterministic=False``, gives individuals of several devices the same
    start.

    Args:
        score: Scoring function of genotypes (N, size) or a pytree of (N, ...), and a
            key; each leaf of its results has the leading axis N.
        mesh: Devices, from ``device_mesh``.

    Returns:
        Function with the arguments and results of ``score``, for ``jax.jit``.
    """
    split, whole = PartitionSpec(AXIS), PartitionSpec()
    # JAX cannot check varying axes, because foreign calls do not declare theirs.
    sharded = jax.shard_map(
        score, mesh=mesh, in_specs=(split, whole), out_specs=split, check_vma=False
    )

    def scored(genotypes: Any, key: jax.Array) -> Any:
        count = jax.tree.leaves(genotypes)[0].shape[0]
        missing = -count % mesh.size

        def fill(leaf: jax.Array) -> jax.Array:
            last = jnp.broadcast_to(leaf[-1:], (missing, *leaf.shape[1:]))
            return jnp.concatenate([leaf, last])

        everywhere = NamedSharding(mesh, whole)
        # without this, XLA would also split what computes the genotypes, which then has
        # other rounding errors
        genotypes = jax.lax.with_sharding_constraint(genotypes, everywhere)
        results = sharded(jax.tree.map(fill, genotypes), key)
        return jax.tree.map(
            lambda leaf: jax.lax.with_sharding_constraint(leaf, everywhere)[:count],
            results,
        )

    return scored


def on_mesh(
    function: Callable[[*Inputs], Result], mesh: Mesh
) -> Callable[[*Inputs], Result]:
    """Compiles a function for a mesh, with arguments and results on one device.

    The program after an evaluation is then the same for any number of devices, and its
    results are bitwise equal.

    Args:
        function: Function that uses ``shard_scoring``. Every device has its complete
            arguments (pytrees) and results.
        mesh: Devices.

    Returns:
        Function of pytrees on any device, with results on the first device of this
        process.
    """
    everywhere = NamedSharding(mesh, PartitionSpec())
    run = jax.jit(function, out_shardings=everywhere)

    def called(*arguments: *Inputs) -> Result:
        given = jax.tree.map(lambda leaf: _copied(leaf, everywhere), arguments)
        results = run(*given)
        return jax.tree.map(lambda leaf: leaf.addressable_data(0), results)

    return called


def _copied(leaf: jax.Array, everywhere: NamedSharding) -> jax.Array:
    """Copies an array to all devices; other processes accept arrays of NumPy only."""
    if jax.process_count() == 1:
        return jax.device_put(leaf, everywhere)
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        numbers = np.asarray(jax.random.key_data(leaf))
        impl = jax.random.key_impl(leaf)
        return jax.random.wrap_key_data(jax.device_put(numbers, everywhere), impl=impl)
    return jax.device_put(np.asarray(leaf), everywhere)
