"""Pictures of a trajectory without a screen: Newton's ray tracer on CPU or GPU."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from newton_qd import checks
from newton_qd.viewing.drawing import Drawing, body_frames
from newton_qd.viewing.newton_model import newton_model
from newton_qd.viewing.sight import FIELD, camera_offset
from newton_qd.viewing.trajectory import Trajectory

_SKY = 0x00F2EDE8  # blue, green, red: the light theme of the pages
_SAMPLES = 4  # rays of a pixel
_REACH = 7.0  # half width of the grid around the way of a robot [radii]


class Camera:
    """Takes pictures of one world.

    Attributes:
        width: Width of a picture [px].
        height: Height of a picture [px].
    """

    def __init__(
        self,
        drawing: Drawing,
        area: tuple[np.ndarray, np.ndarray],
        width: int = 640,
        height: int = 480,
        zoom: float = 1.0,
        elevation: float | None = None,
    ) -> None:
        """Builds the scene.

        Args:
            drawing: What is drawn.
            area: Lowest and highest x and y (2,) of the grid on the ground [m].
            width: Width of a picture [px].
            height: Height of a picture [px].
            zoom: Size of the robot in the picture; 1: as in the pages.
            elevation: Angle of the view above the ground [deg]; ``None``: as in the
                pages.

        Raises:
            ValueError: A number is not allowed.
        """
        checks.integer("width", width)
        checks.integer("height", height)
        checks.number("zoom", zoom, above=0)
        checks.number("elevation", elevation, above=0, below=90, optional=True)
        import warp as wp
        from newton.sensors import SensorCamera

        self.width, self.height = width, height
        self._drawing = drawing
        self._offset = camera_offset(drawing, zoom=zoom, elevation=elevation)
        self._model = newton_model(drawing, area)
        self._state = self._model.state()
        options = SensorCamera.RenderConfig()
        options.enable_shadows = True
        options.anti_aliasing = SensorCamera.AntiAliasing.SSAA
        clear = SensorCamera.ClearData(clear_color=_SKY)
        self._sensor = SensorCamera(
            self._model, default_render_config=options, default_clear_data=clear
        )
        direction = wp.vec3f(0.329, 0.423, -0.844)  # of length 1
        self._sensor.create_default_light(direction=direction)
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            width, height, camera_fov=FIELD, sample_count=_SAMPLES
        )
        self._image = self._sensor.allocate_image_color(1, width, height)

    def picture(self, q: np.ndarray) -> np.ndarray:
        """Returns a picture of the robot.

        Args:
            q: (nq,) coordinates [m or rad].

        Returns:
            (height, width, 3) red, green and blue, uint8.
        """
        import warp as wp

        frames = body_frames(self._drawing, q)
        assert self._state.body_q is not None
        self._state.body_q.assign(frames.astype(np.float32))
        self._model.bvh_refit_shapes(self._state)
        aim = np.array(self._drawing.centre)
        if self._drawing.follow:
            # the height stays, so that a hopping robot is seen to hop
            aim[:2] = frames[self._drawing.torso, :2]
        pose = _pose(aim, self._offset)
        place = wp.array([wp.transform(*pose)], dtype=wp.transformf)
        self._sensor.update(self._state, place, self._rays, color_image=self._image)
        image: Any = self._image
        packed = image.numpy()[0]
        parts = [(packed >> shift) & 255 for shift in (0, 8, 16)]
        return np.stack(parts, axis=-1).astype(np.uint8)


def _pose(aim: np.ndarray, offset: np.ndarray) -> list[float]:
    """Returns the frame (7,) of a camera that looks at a point from an offset (3,)."""
    back = offset / np.linalg.norm(offset)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.stack([right, np.cross(back, right), back], axis=1)
    w = math.sqrt(max(0.0, 1.0 + np.trace(matrix))) / 2
    vector = np.array(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    ) / (4 * w)
    return [float(x) for x in (*(aim + offset), *vector, w)]


def times(trajectory: Trajectory, rate: float) -> np.ndarray:
    """Returns the frames (n,) of a trajectory that a video with a rate [1/s] shows."""
    # a maze without physics counts time in steps: it shows all of them
    step = trajectory.dt if trajectory.dt != 1.0 else 1.0 / rate
    last = int(trajectory.lengths.max())
    count = max(1, round(last * step * rate))
    return np.minimum(np.rint(np.arange(count + 1) / (step * rate)), last).astype(int)


def pictures(
    trajectory: Trajectory,
    frames: np.ndarray,
    *,
    width: int = 640,
    height: int = 480,
    zoom: float = 1.0,
    elevation: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[np.ndarray]:
    """Yields pictures of all worlds, beside and below each other.

    Args:
        trajectory: The trajectory.
        frames: (n,) numbers of the frames.
        width: Width of the picture of one world [px].
        height: Height of the picture of one world [px].
        zoom: Size of the robot in the picture; 1: as in the pages.
        elevation: Angle of the view above the ground [deg]; ``None``: as in the pages.
        progress: Called after each picture with its number from 1 and n.

    Yields:
        (rows * height, columns * width, 3) red, green and blue, uint8.

    Raises:
        ValueError: ``width``, ``height``, ``zoom`` or ``elevation`` is not allowed.
    """
    drawing = trajectory.drawing
    torso = body_frames(drawing, trajectory.q)[..., drawing.torso, :2].reshape(-1, 2)
    reach = max(_REACH * drawing.radius / min(zoom, 1.0), 2 * drawing.grid)
    area = torso.min(axis=0) - reach, torso.max(axis=0) + reach
    camera = Camera(drawing, area, width, height, zoom, elevation)
    columns = math.ceil(math.sqrt(trajectory.worlds))
    rows = math.ceil(trajectory.worlds / columns)
    for number, frame in enumerate(frames):
        sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
        for world in range(trajectory.worlds):
            at = min(int(frame), int(trajectory.lengths[world]))
            row, column = divmod(world, columns)
            place = slice(row * height, (row + 1) * height)
            sheet[place, column * width : (column + 1) * width] = camera.picture(
                trajectory.q[world, at]
            )
        yield sheet
        if progress is not None:
            progress(number + 1, len(frames))
