"""A drawing as a model of Newton, for its camera and its viewers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from newton_qd.viewing.drawing import Drawing

if TYPE_CHECKING:
    import newton

GROUND, LINES = (0.82, 0.85, 0.88), (0.45, 0.5, 0.56)
_LINE = 0.012  # width of a line of the grid [steps of the grid]
_MOST_LINES = 60  # along each axis


def newton_model(
    drawing: Drawing, area: tuple[np.ndarray, np.ndarray] | None = None
) -> newton.Model:
    """Returns a model of Newton that is only seen: it has shapes, but no contacts.

    Args:
        drawing: What is drawn. Body ``i`` of the model is its body ``i``.
        area: Lowest and highest x and y (2,) of a grid on the ground [m]; ``None``: no
            grid.
    """
    import newton
    import warp as wp

    builder = newton.ModelBuilder()
    seen = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False)
    for name in drawing.body_names:
        builder.add_body(label=name)
    adders = {
        "sphere": lambda size: (builder.add_shape_sphere, {"radius": size[0]}),
        "capsule": lambda size: (
            builder.add_shape_capsule,
            {"radius": size[0], "half_height": size[1]},
        ),
        "cylinder": lambda size: (
            builder.add_shape_cylinder,
            {"radius": size[0], "half_height": size[1]},
        ),
        "box": lambda size: (
            builder.add_shape_box,
            {"hx": size[0], "hy": size[1], "hz": size[2]},
        ),
    }
    for shape in drawing.shapes:
        if not shape.visual:
            continue
        if shape.kind == "mesh":
            mesh = newton.Mesh(shape.vertices, shape.faces.ravel())
            add, options = builder.add_shape_mesh, {"mesh": mesh, "scale": shape.size}
        else:
            add, options = adders[shape.kind]([float(part) for part in shape.size])
        frame = wp.transform(*(float(part) for part in shape.frame))
        *color, opacity = shape.color
        add(shape.body, xform=frame, cfg=seen, color=color, opacity=opacity, **options)
    builder.add_ground_plane(cfg=seen, color=GROUND)
    if area is not None:
        _add_grid(builder, seen, drawing.grid, area)
    return builder.finalize(skip_validation_inertia=True)  # the bodies have none


def _add_grid(
    builder: newton.ModelBuilder,
    seen: newton.ModelBuilder.ShapeConfig,
    step: float,
    area: tuple[np.ndarray, np.ndarray],
) -> None:
    """Adds lines of a grid on the ground."""
    import warp as wp

    low, high = (np.asarray(ends, float) for ends in area)
    high = np.minimum(high, low + _MOST_LINES * step)
    for axis in (0, 1):
        for number in range(
            int(np.ceil(low[axis] / step)), int(np.floor(high[axis] / step)) + 1
        ):
            middle, half = (low + high) / 2, (high - low) / 2
            middle[axis], half[axis] = number * step, _LINE * step
            if number % 5 == 0:
                half[axis] *= 2
            builder.add_shape_box(
                -1,
                xform=wp.transform(float(middle[0]), float(middle[1]), 0.0, 0, 0, 0, 1),
                hx=float(half[0]),
                hy=float(half[1]),
                hz=0.002 * step,
                cfg=seen,
                color=LINES,
            )
