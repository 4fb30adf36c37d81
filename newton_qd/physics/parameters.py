"""Physical parameters of a world: what differs between the copies of one robot."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.physics import layout
from newton_qd.physics.system import System


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class PhysicsParams:
    """Physical parameters of one world; in a batch every field has its axis in front.

    A robot has many masses, dampings and gears of very different size, some of them
    zero: these are scales of what its files say, 1 being as it is there. Gravity and
    friction are one number each, and values.

    A step is differentiable with respect to every field.

    Attributes:
        gravity: () downward acceleration [m/s^2], 0 or more.
        friction: () Coulomb coefficient of every contact [-], 0 or more.
        contact_stiffness_scale: () of the stiffness of every contact [-], 0 or more.
            The stiffness itself is chosen for the weight that the files give; it does
            not follow masses or gravity.
        mass_scale: (nb,) of the mass of each body and of its inertia, as if it were
            denser [-], above 0.
        inertia_scale: (nb,) of the inertia of each body about its centre of mass, on
            top of ``mass_scale`` [-], above 0.
        damping_scale: (nv,) of the damping of each degree of freedom [-], 0 or more.
        gear_scale: (nu,) of the gear of each action [-], 0 or more. Joint limits keep
            the stiffness that is chosen for the gear of the files.
    """

    gravity: jax.Array
    friction: jax.Array
    contact_stiffness_scale: jax.Array
    mass_scale: jax.Array
    inertia_scale: jax.Array
    damping_scale: jax.Array
    gear_scale: jax.Array

    def replace(self, **changes: ArrayLike) -> PhysicsParams:
        """Returns a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


FIELDS = tuple(field.name for field in dataclasses.fields(PhysicsParams))
"""Names of the parameters, in the order in which the kernels read them."""
_POSITIVE = ("mass_scale", "inertia_scale")


def parameter_shapes(system: System) -> dict[str, tuple[int, ...]]:
    """Returns the shape of each parameter of one world, in the order of the fields."""
    return layout.parameters(system).shapes


def parameter_count(system: System) -> int:
    """Returns how many numbers the parameters of one world are."""
    return layout.parameters(system).size


def default_params(system: System) -> PhysicsParams:
    """Returns the parameters of one world as in the robot's files."""
    robot = system.robot
    values = dict.fromkeys(FIELDS, 1.0)
    values |= {"gravity": robot.gravity, "friction": robot.material.friction}
    dtype = jnp.dtype(system.dtype)
    shapes = parameter_shapes(system)
    return PhysicsParams(**{k: jnp.full(shapes[k], values[k], dtype) for k in FIELDS})


def check_bounds(name: str, values: np.ndarray) -> None:
    """Checks that all numbers are allowed values of a parameter.

    Args:
        name: Name of the parameter.
        values: Numbers, of any shape.

    Raises:
        ValueError: A number is not finite, is negative, or is 0 if that is not allowed.
    """
    positive = name in _POSITIVE
    valid = np.isfinite(values) & ((values > 0) if positive else (values >= 0))
    if not np.all(valid):
        allowed = f"finite numbers {'above' if positive else 'from'} 0"
        wrong = np.extract(~valid, values)[0].item()
        raise ValueError(message(f"params.{name}", wrong, allowed))


def _checked(
    name: str, value: jax.Array, shape: tuple[int, ...], dtype: np.dtype
) -> jax.Array:
    """Returns one parameter, strongly typed; weakly typed numbers are converted."""
    array = checks.array(f"params.{name}", value, shape, dtype, scalars=True)
    if not isinstance(array, Tracer):
        check_bounds(name, np.asarray(array))
    return array


def parameter_row(system: System, params: PhysicsParams) -> jax.Array:
    """Returns the parameters of one world in a row, as the kernels read them.

    Args:
        system: The system.
        params: Its parameters. Values are checked where they are concrete: not inside
            ``jit`` and ``vmap``.

    Raises:
        TypeError: ``params`` is something else, or a field has another type than the
            system.
        ValueError: A field has another shape, or a number that is out of bounds.
    """
    allowed = "None, or PhysicsParams, as env.default_params.replace(friction=0.5)"
    checks.instance("params", params, PhysicsParams, allowed)
    dtype = np.dtype(system.dtype)
    return jnp.concatenate(
        [
            _checked(name, getattr(params, name), shape, dtype).reshape(-1)
            for name, shape in parameter_shapes(system).items()
        ]
    )
