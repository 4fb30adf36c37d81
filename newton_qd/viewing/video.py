"""Writes pictures, GIFs and videos."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.errors import require_extra
from newton_qd.files import remove_abandoned, temporary_name
from newton_qd.viewing.camera import pictures, times
from newton_qd.viewing.trajectory import Trajectory

FORMATS = (".png", ".gif", ".mp4")
_RATE = 20.0  # pictures per second of a GIF or video
_COLORS = 48  # of a GIF
_SLOWEST, _FASTEST = 0.01, 50.0  # pictures per second of a GIF
_MOST_VIDEO = 1000.0  # pictures per second


def require(ending: str) -> None:
    """Checks that the package that writes files with an ending is installed.

    Args:
        ending: One of ``FORMATS``.

    Raises:
        MissingExtra: It is not installed.
    """
    if ending == ".mp4":
        require_extra("imageio_ffmpeg", "video")
    else:
        require_extra("PIL", "viz")


def render(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    width: int = 640,
    height: int = 480,
    time: float | None = None,
    rate: float = _RATE,
    zoom: float = 1.0,
    elevation: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Renders a trajectory to a file, without a screen. Several worlds make a sheet.

    Args:
        trajectory: The trajectory.
        path: A file that ends with ``.png``, ``.gif`` or ``.mp4``.
        width: Width of the picture of one world [px].
        height: Height of the picture of one world [px].
        time: Moment of a picture [s], up to the end of the longest episode; ``None``:
            the middle. Only for ``.png``.
        rate: Pictures per second of a GIF or a video [1/s]; of a GIF 0.01 to 50, of a
            video up to 1,000.
        zoom: Size of the robot in the picture; 1: as in the pages.
        elevation: Angle of the view above the ground [deg]; ``None``: as in the pages.
        progress: Called after each picture with its number from 1 and their count.

    Returns:
        The path of the file.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: The path has another ending, or a number is not allowed.
        MissingExtra: Pillow (for ``.png`` and ``.gif``) or imageio-ffmpeg (for
            ``.mp4``) is not installed.
        OSError: The file cannot be written.
    """
    checks.instance("trajectory", trajectory, Trajectory, "a Trajectory")
    target = Path(path)
    ending = target.suffix.lower()
    if ending not in FORMATS:
        raise ValueError(message("path", str(path), f"files with {listed(FORMATS)}"))
    if ending == ".gif":
        # it has hundredths of a second, and browsers slow down below two of them
        checks.number("rate of a GIF", rate, least=_SLOWEST, most=_FASTEST)
    checks.number("rate", rate, above=0, most=_MOST_VIDEO if ending == ".mp4" else None)
    if ending == ".mp4":  # a video has even sizes
        checks.integer("width", width, least=2)
        checks.integer("height", height, least=2)
    last = int(trajectory.lengths.max())
    _check_time(time, ending, last * trajectory.dt)
    require(ending)
    if ending == ".png":
        middle = last // 2 if time is None else round(time / trajectory.dt)
        frames = np.array([min(middle, last)])
    else:
        frames = times(trajectory, rate)
    found = pictures(
        trajectory,
        frames,
        width=width,
        height=height,
        zoom=zoom,
        elevation=elevation,
        progress=progress,
    )
    temporary = temporary_name(target)
    try:
        if ending == ".mp4":
            try:
                _write_video(found, temporary, rate)
            except OSError as error:
                raise OSError(f"{target} is not written: {error}") from error
        else:
            _write_images(found, temporary, rate, ending)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    remove_abandoned(target)
    return target


def _check_time(time: float | None, ending: str, end: float) -> None:
    """Checks the moment of a picture.

    Raises:
        TypeError: It is not a number.
        ValueError: It is not in the trajectory, or the file is no picture.
    """
    checks.number("time", time, least=0, optional=True)
    if time is None:
        return
    if ending != ".png":
        why = f"and a {ending} file shows all moments"
        raise ValueError(message("time", time, "None, or a file .png", why=why))
    if time > end * (1.0 + 1e-6):  # an end in decimal digits may be rounded up
        allowed = f"numbers from 0 to {end:.6g}, the end of the longest episode [s]"
        raise ValueError(message("time", time, allowed))


def _write_images(
    found: Iterable[np.ndarray], path: Path, rate: float, ending: str
) -> None:
    """Writes a picture, or a GIF."""
    from PIL import Image

    images = [Image.fromarray(image) for image in found]
    if ending == ".png":
        images[0].save(path, format="PNG", optimize=True)
        return
    # one palette for all pictures: without dithering, still parts do not change
    middle = images[len(images) // 2].quantize(_COLORS)
    small = [
        image.quantize(palette=middle, dither=Image.Dither.NONE) for image in images
    ]
    small[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=small[1:],
        duration=_durations(len(small), rate),
        loop=0,
        optimize=True,
    )


def _durations(count: int, rate: float) -> list[int]:
    """Returns how long a GIF shows each picture [ms].

    The file has hundredths of a second, so the ends of the pictures are rounded, and
    errors do not add up.
    """
    ends = np.rint(100.0 * np.arange(count + 1) / rate)
    return (10 * np.diff(ends)).astype(int).tolist()


def _write_video(found: Iterable[np.ndarray], path: Path, rate: float) -> None:
    """Writes a video in H.264.

    Raises:
        OSError: The video is not complete, for example because the disk is full.
    """
    import imageio_ffmpeg

    path = path.absolute()  # ffmpeg takes what is before a colon for a protocol
    write: Any = imageio_ffmpeg.write_frames  # takes fractions, too
    writer = None
    try:
        for image in found:
            height, width = (size - size % 2 for size in image.shape[:2])
            if writer is None:
                writer = write(
                    path,
                    (width, height),
                    fps=rate,
                    macro_block_size=2,
                    quality=7,
                    output_params=["-f", "mp4"],
                    ffmpeg_log_level="error",
                )
                with warnings.catch_warnings():
                    # the forked process starts another program at once
                    warnings.filterwarnings("ignore", r"os.fork\(\) was called")
                    writer.send(None)
            writer.send(np.ascontiguousarray(image[:height, :width]).tobytes())
    except OSError as error:  # its text has the command and all output of ffmpeg
        raise OSError(f"ffmpeg stopped: {str(error).splitlines()[0]}") from error
    finally:
        if writer is not None:
            writer.close()
    try:  # ffmpeg does not say whether it could write the end of the file
        imageio_ffmpeg.count_frames_and_secs(path)
    except RuntimeError as error:
        why = "ffmpeg wrote no complete video; the disk may be full"
        raise OSError(why) from error
