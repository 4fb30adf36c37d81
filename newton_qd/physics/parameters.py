"""Physical parameters of a world. They may differ between copies of one robot."""

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
from newton_qd.physics.system import System, takes_system
from newton_qd.real_numbers import real_numbers


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class PhysicsParams:
    """Physical parameters of one world. In a batch each field has a leading batch axis.

    Gravity and friction are absolute values. All other fields are scale factors for the
    values in the robot's files; 1 keeps the value. Scale factors are used because the
    masses, dampings and gears of a robot differ by orders of magnitude, and some are
    zero.

    A step is differentiable with respect to every field.

    Attributes:
        gravity: () downward acceleration [m/s^2], 0 or more.
        friction: () Coulomb coefficient of all contacts [-], 0 or more.
        contact_stiffness_scale: () scale of the stiffness of all contacts [-], 0 or
            more. The unscaled stiffness is computed from the weight in the files. It
            does not change with ``mass_scale`` or ``gravity``.
        mass_scale: (nb,) scale of the mass of each body [-], above 0. The inertia is
            scaled too, as for a change of density.
        inertia_scale: (nb,) additional scale of the inertia of each body about its
            centre of mass [-], above 0. It multiplies ``mass_scale``.
        damping_scale: (nv,) scale of the damping of each degree of freedom [-], 0 or
            more.
        gear_scale: (nu,) scale of the gear of each action [-], 0 or more. It does not
            change the stiffness of joint limits, which is computed from the unscaled
            gear.
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
PARAMS = "None, or PhysicsParams, as env.default_params.replace(friction=0.5)"
"""What a step takes, for errors."""
_POSITIVE = ("mass_scale", "inertia_scale")


def parameter_shapes(system: System) -> dict[str, tuple[int, ...]]:
    """Returns the shape of each parameter of one world, in the order of the fields."""
    return layout.parameters(system).shapes


@takes_system
def default_params(system: System) -> PhysicsParams:
    """Returns the parameters of one world with the values of the robot's files.

    Raises:
        ValueError: The system is float64 and JAX x64 is off.
    """
    robot = system.robot
    values = dict.fromkeys(FIELDS, 1.0)
    values |= {"gravity": robot.gravity, "friction": robot.material.friction}
    dtype = jnp.dtype(system.dtype)
    checks.x64(dtype)
    shapes = parameter_shapes(system)
    return PhysicsParams(**{k: jnp.full(shapes[k], values[k], dtype) for k in FIELDS})


def check_bounds(name: str, values: np.ndarray) -> None:
    """Checks that all values of a parameter are within its bounds.

    Args:
        name: Name of the parameter.
        values: Values, of any shape.

    Raises:
        ValueError: A value is not finite, is negative, or is 0 where the parameter
            must be positive.
    """
    positive = name in _POSITIVE
    valid = np.isfinite(values) & ((values > 0) if positive else (values >= 0))
    if not np.all(valid):
        allowed = f"finite numbers {'above' if positive else 'from'} 0"
        wrong = np.extract(~valid, values)[0].item()
        raise ValueError(message(f"params.{name}", wrong, allowed))


def check_values(params: object) -> None:
    """Checks the values of parameters that are not traced.

    Args:
        params: Parameters of one world or of several; the step refuses other objects.

    Raises:
        ValueError: A value is out of bounds.
    """
    if isinstance(params, PhysicsParams):
        for name in FIELDS:
            values = real_numbers(getattr(params, name))
            if values is not None:  # the step refuses what is no number
                check_bounds(name, values)


def _checked(
    name: str, value: jax.Array, shape: tuple[int, ...], dtype: np.dtype
) -> jax.Array:
    """Returns one parameter as an array with a strong type.

    Numbers with a weak type are converted.
    """
    array = checks.array(f"params.{name}", value, shape, dtype, scalars=True)
    if not isinstance(array, Tracer):
        check_bounds(name, np.asarray(array))
    return array


def parameter_row(system: System, params: PhysicsParams) -> jax.Array:
    """Returns the parameters of one world as the row that the kernels read.

    Args:
        system: The system.
        params: The parameters. Bounds are checked for concrete values only, not for
            traced values inside ``jit`` and ``vmap``.

    Raises:
        TypeError: ``params`` is not a ``PhysicsParams``, or the type of a field is not
            that of the system.
        ValueError: A field has the wrong shape, or a value out of bounds.
    """
    checks.instance("params", params, PhysicsParams, PARAMS)
    dtype = np.dtype(system.dtype)
    return jnp.concatenate(
        [
            _checked(name, getattr(params, name), shape, dtype).reshape(-1)
            for name, shape in parameter_shapes(system).items()
        ]
    )
