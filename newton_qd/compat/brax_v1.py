"""What scripts of QDax import from brax v1, which newer releases of brax lack.

If brax v1 is installed, it stays, and only learns of the environments of this library.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from newton_qd.brax_views.configuration import JointSettings as Joint
from newton_qd.brax_views.views import QP, SystemView
from newton_qd.checks import message
from newton_qd.files import write_atomically

__all__ = [
    "QP",
    "Joint",
    "choice",
    "clip",
    "expand_dims",
    "index_update",
    "norm",
    "randint",
    "random_prngkey",
    "random_split",
    "random_uniform",
    "render",
    "safe_arccos",
    "safe_arcsin",
    "safe_norm",
    "save_html",
    "take",
    "vec_to_arr",
    "vmap",
]

_INSIDE = 1e-7  # the spacing of float32 below 1 is 6e-8


def random_prngkey(seed: int) -> jax.Array:
    """Returns a random key."""
    return jax.random.PRNGKey(seed)


def random_split(rng: jax.Array, num: int = 2) -> jax.Array:
    """Returns ``num`` new random keys."""
    return jax.random.split(rng, num)


def random_uniform(
    rng: jax.Array,
    shape: tuple[int, ...] = (),
    low: ArrayLike | None = 0.0,
    high: ArrayLike | None = 1.0,
) -> jax.Array:
    """Returns uniform random numbers from ``low`` to ``high``."""
    # no "low or 0.0": a traced number has no truth value
    least, most = 0.0 if low is None else low, 1.0 if high is None else high
    return jax.random.uniform(rng, shape, jnp.float32, least, most)


def randint(
    rng: jax.Array, shape: tuple[int, ...] = (), low: int = 0, high: int = 1
) -> jax.Array:
    """Returns uniform random integers from ``low`` to below ``high``."""
    return jax.random.randint(rng, shape, low, high)


def choice(
    rng: jax.Array,
    a: Any,
    shape: tuple[int, ...] = (),
    replace: bool = True,
    p: Any | None = None,
    axis: int = 0,
) -> jax.Array:
    """Returns random elements of an array, or of the integers below ``a``."""
    return jax.random.choice(rng, a, shape, replace, p, axis)


def clip(a: ArrayLike, a_min: ArrayLike, a_max: ArrayLike) -> jax.Array:
    """Returns values that are at least ``a_min`` and at most ``a_max``."""
    return jnp.clip(jnp.asarray(a), a_min, a_max)


def expand_dims(x: ArrayLike, axis: int | tuple[int, ...] = 0) -> jax.Array:
    """Returns an array with another axis of length 1, which is the first by default."""
    return jnp.expand_dims(jnp.asarray(x), axis)


def take(tree: Any, i: Any, axis: int = 0) -> Any:
    """Returns elements of each leaf along an axis."""
    indices = jnp.asarray(i)
    return jax.tree.map(lambda x: jnp.take(x, indices, axis=axis, mode="clip"), tree)


def index_update(x: jax.Array, idx: Any, y: Any) -> jax.Array:
    """Returns a copy with ``x[idx]`` replaced by ``y``."""
    return jnp.asarray(x).at[idx].set(y)


def norm(x: ArrayLike, axis: int | tuple[int, ...] | None = None) -> jax.Array:
    """Returns the norm of a vector. The second argument of JAX's is another one."""
    return jnp.linalg.norm(jnp.asarray(x), axis=axis)


def vmap(
    fun: Callable[..., Any], include: Sequence[bool] | None = None
) -> Callable[..., Any]:
    """Maps a function over the first axis of its arguments, or of those included."""
    if not include:
        return jax.vmap(fun)
    return jax.vmap(fun, tuple(0 if inside else None for inside in include))


def safe_norm(x: jax.Array, axis: int | None = None) -> jax.Array:
    """Returns the norm of a vector. At 0, its gradient is 0."""
    zero = jnp.all(x == 0, axis=axis, keepdims=True)
    norm = jnp.linalg.norm(jnp.where(zero, 1.0, x), axis=axis)
    return jnp.where(zero.reshape(norm.shape), 0.0, norm)


@jax.custom_jvp
def safe_arccos(x: jax.Array) -> jax.Array:
    """Returns the inverse cosine. Its gradient is finite at -1 and 1, too."""
    return jnp.arccos(x)


@jax.custom_jvp
def safe_arcsin(x: jax.Array) -> jax.Array:
    """Returns the inverse sine. Its gradient is finite at -1 and 1, too."""
    return jnp.arcsin(x)


def _slope(x: jax.Array) -> jax.Array:
    """Returns the derivative of the inverse sine, inside of [-1, 1] by 1e-7."""
    inside = jnp.clip(x, -1.0 + _INSIDE, 1.0 - _INSIDE)
    return 1.0 / jnp.sqrt(1.0 - inside * inside)


safe_arccos.defjvps(lambda tangent, _, x: -tangent * _slope(x))
safe_arcsin.defjvps(lambda tangent, _, x: tangent * _slope(x))


def vec_to_arr(vector: Any) -> np.ndarray:
    """Returns a vector with ``x``, ``y`` and ``z`` as an array (3,)."""
    return np.array([vector.x, vector.y, vector.z])


def render(
    sys: SystemView, qps: Sequence[QP], height: int = 480, info: object = None
) -> str:
    """Returns HTML that shows a trajectory: a replay page of this library in a frame.

    Args:
        sys: The robot, ``env.sys``.
        qps: ``state.qp`` of each state of one world.
        height: Height of the frame [px].
        info: Ignored.

    Raises:
        TypeError: ``sys`` is not a robot of this library.
        ValueError: ``qps`` is empty.
    """
    del info
    from newton_qd.viewing.replay import Shown

    return Shown(_page(sys, qps), height)._repr_html_()


def save_html(
    path: str | os.PathLike[str],
    sys: SystemView,
    qps: Sequence[QP],
    make_dir: bool = False,
) -> None:
    """Writes a replay page of a trajectory.

    Args:
        path: The HTML file.
        sys: The robot, ``env.sys``.
        qps: ``state.qp`` of each state of one world.
        make_dir: Whether to make the folder of the file.

    Raises:
        OSError: The file cannot be written.
        TypeError: ``sys`` is not a robot of this library.
        ValueError: ``qps`` is empty.
    """
    target = Path(path)
    if make_dir:
        target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, _page(sys, qps).encode())


def _page(sys: SystemView, qps: Sequence[QP]) -> str:
    """Returns the replay page of a trajectory.

    Raises:
        TypeError: ``sys`` is not a robot of this library.
        ValueError: ``qps`` is empty.
    """
    if not isinstance(sys, SystemView):
        raise TypeError(
            message("sys", sys, "env.sys of newton_qd, with brax_views=True")
        )
    if not len(qps):
        raise ValueError(message("qps", qps, "state.qp of at least one state"))
    from newton_qd.viewing.drawing import drawing_of_system
    from newton_qd.viewing.replay import replay_html
    from newton_qd.viewing.trajectory import Trajectory

    states = [qp.physics for qp in qps]
    steps = len(states) - 1
    rows = {
        name: np.stack([np.asarray(getattr(state, name)) for state in states])[None]
        for name in ("q", "feet_contact")
    }
    return replay_html(
        Trajectory(
            drawing=drawing_of_system(sys.system),
            q=rows["q"].astype(np.float32),
            lengths=np.array([steps]),
            dt=sys.config.dt,
            rewards=np.zeros((1, steps), np.float32),
            descriptors=np.zeros((1, steps + 1, 0), np.float32),
            descriptor_names=(),
            feet=rows["feet_contact"],
            labels=(sys.system.robot.name,),
        )
    )
