"""The replay page, as text, as a file, and in a notebook."""

from __future__ import annotations

import html
import os
from pathlib import Path

from newton_qd import checks
from newton_qd.files import write_atomically
from newton_qd.viewing.html import page, trajectory_data
from newton_qd.viewing.trajectory import Trajectory

_BODY = """
<header><h1 id="title"></h1><div id="facts"></div>
<button id="theme" type="button" title="Light or dark" aria-label="Light or dark">
&#9680;</button></header>
<div id="player" class="player"></div>
"""


def replay_html(trajectory: Trajectory, title: str | None = None) -> str:
    """Returns a page that shows a trajectory.

    Args:
        trajectory: The trajectory.
        title: Title of the page; ``None``: the name of the environment.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: The title is empty.
    """
    checks.instance("trajectory", trajectory, Trajectory, "a Trajectory")
    checks.text("title", title, optional=True)
    title = trajectory.drawing.name if title is None else title
    # the name of a folder may have bytes that are no text
    title = title.encode("utf-8", "replace").decode()
    data = {"title": title, "trajectory": trajectory_data(trajectory)}
    return page(f"{title} - newton_qd", _BODY, ("replay.js",), data)


def write_replay(
    trajectory: Trajectory, path: str | os.PathLike[str], title: str | None = None
) -> Path:
    """Writes a page that shows a trajectory. It opens in a browser from the disk.

    Args:
        trajectory: The trajectory.
        path: The HTML file; it is replaced if it exists.
        title: Title of the page; ``None``: the name of the environment.

    Returns:
        The path of the file.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: The title is empty.
        OSError: The file cannot be written.
    """
    target = Path(path)
    write_atomically(target, replay_html(trajectory, title).encode())
    return target


class Shown:
    """A page that a notebook displays.

    Attributes:
        page: The HTML of the page.
        height: Height of the frame in the notebook [px].
    """

    def __init__(self, page: str, height: int) -> None:
        """Stores a page.

        Args:
            page: The HTML of the page.
            height: Height of the frame in the notebook [px].
        """
        self.page = page
        self.height = height

    def _repr_html_(self) -> str:
        """Returns the page in a frame of its own, as notebooks ask for it."""
        source = html.escape(self.page)
        return (
            f'<iframe srcdoc="{source}" width="100%" height="{self.height}" '
            'style="border:0" sandbox="allow-scripts allow-downloads"></iframe>'
        )


def show(trajectory: Trajectory, *, height: int = 560) -> Shown:
    """Shows a trajectory in a notebook. Let it be the last line of a cell.

    Args:
        trajectory: The trajectory.
        height: Height of the frame [px].

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``height`` is not an integer above 0.
    """
    checks.integer("height", height)
    return Shown(replay_html(trajectory), height)
