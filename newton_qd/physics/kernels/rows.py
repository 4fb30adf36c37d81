"""Where each field of a world's row begins, and how long the row is.

:mod:`newton_qd.physics.layout` is the one table of the rows; the launch fills these
structs from it. The names are those of its fields.
"""

import warp as wp


@wp.struct
class Coordinates:
    """Coordinates and velocities, for kernels that use :mod:`.coordinates`."""

    size: int
    q: int
    v: int


@wp.struct
class Inputs:
    """A row that a step reads."""

    size: int
    q: int
    v: int
    control: int
    # where every world brings physical parameters of its own, else not read
    gravity: int
    friction: int
    contact_stiffness_scale: int
    mass_scale: int
    inertia_scale: int
    damping_scale: int
    gear_scale: int


@wp.struct
class Outputs:
    """A row that a step writes; where the model reports them, then the bodies."""

    size: int
    q: int
    v: int
    impulse: int
    normal_impulse: int
    fault: int
    feet_contact: int
    smooth_feet_contact: int
    torso_xy: int


@wp.struct
class Bodies:
    """The bodies, in a row of their own or in that of a step."""

    size: int
    position: int
    rotation: int
    com: int
    linear_velocity: int
    angular_velocity: int


@wp.struct
class Dynamics:
    """The mass matrix and the bias forces."""

    size: int
    mass_matrix: int
    bias: int


@wp.struct
class Parameters:
    """The physical parameters of a pack in the scratch."""

    size: int
    gravity: int
    friction: int
    contact_stiffness: int
    total_mass: int
    mass: int
    inertia_scale: int
    damping: int
