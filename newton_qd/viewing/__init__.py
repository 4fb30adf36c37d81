"""See it: trajectories, and pages that show them in a browser.

- ``record(env, policy, key)``: runs episodes and returns a ``Trajectory``
- ``record_elites(run, cells)``: the same for elites of ``newton_qd.qd.load_run(DIR)``
- ``write_replay(trajectory, path)``: one HTML file that shows it, without a network
- ``show(trajectory)``: the same in a notebook
- ``write_explorer([run], path)``: one HTML file with the archive of a run; a click on a
  cell shows its elite
- ``render(trajectory, path)``: a picture, a GIF or a video, without a screen
- ``play(trajectory, viewer)``: shows it in a viewer of Newton
- ``joined([...])``: trajectories of one robot as one, to see them together

Importing this package imports no other module of it. Each name is loaded when it is
first used. Pages need no extra, pictures and GIFs need ``viz``, videos ``video``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from newton_qd.lazy import loaded_name

if TYPE_CHECKING:
    from newton_qd.viewing.drawing import Drawing, DrawnShape, can_draw, drawing_of
    from newton_qd.viewing.elites import record_elites
    from newton_qd.viewing.explorer import explorer_html, write_explorer
    from newton_qd.viewing.newton_viewers import play
    from newton_qd.viewing.recording import Recorder, record
    from newton_qd.viewing.replay import replay_html, show, write_replay
    from newton_qd.viewing.trajectory import Contacts, Trajectory, joined
    from newton_qd.viewing.video import render

__all__ = [
    "Contacts",
    "Drawing",
    "DrawnShape",
    "Recorder",
    "Trajectory",
    "can_draw",
    "drawing_of",
    "explorer_html",
    "joined",
    "play",
    "record",
    "record_elites",
    "render",
    "replay_html",
    "show",
    "write_explorer",
    "write_replay",
]

_HOME = {
    "Contacts": ".trajectory",
    "Drawing": ".drawing",
    "DrawnShape": ".drawing",
    "Recorder": ".recording",
    "Trajectory": ".trajectory",
    "can_draw": ".drawing",
    "drawing_of": ".drawing",
    "explorer_html": ".explorer",
    "joined": ".trajectory",
    "play": ".newton_viewers",
    "record": ".recording",
    "record_elites": ".elites",
    "render": ".video",
    "replay_html": ".replay",
    "show": ".replay",
    "write_explorer": ".explorer",
    "write_replay": ".replay",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    return loaded_name(globals(), name, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
