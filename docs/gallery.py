"""Make the pictures of the gallery from the code, one GIF for each environment.

python docs/gallery.py             writes docs/gallery/NAME.gif of every environment,
                                   and docs/gallery.md
python docs/gallery.py ant hopper  writes those of some environments
python docs/gallery.py --run DIR   writes docs/gallery/evolved.gif: four elites of a run

A robot moves its joints as sines of time. Of 64 random sets of amplitudes, frequencies
and phases, the GIF shows the one with the highest return. Nothing is learned.
"""

from __future__ import annotations

import inspect
import math
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.qd import load_run
from newton_qd.scenes import HURDLES
from newton_qd.tasks import ENVIRONMENTS
from newton_qd.viewing import record, record_elites, render
from newton_qd.wrappers import MazeWrapper

FOLDER = Path(__file__).with_name("gallery")
PAGE = Path(__file__).with_name("gallery.md")
SECONDS = 2.4  # of motion
RATE = 12.5  # pictures per second: GIFs count in hundredths of a second
SIZE = 200, 150  # [px]
GAITS = 64
CLOSE, WALLS = 1.15, 0.4  # zoom; walls are seen from farther away
# the boxes of a maze are higher than a robot: zoom and elevation [deg]
MAZE, ABOVE = 0.32, 65.0
MAZE_STEPS = 30  # of the point maze, which has no time

HEAD = """# Gallery

Each picture shows an environment whose joints move as sines of time. It is the gait
with the highest return of 64 random ones. Nothing is learned.
[Environments](environments.md) has the details. `newton-qd replay NAME` makes a page on
which you can turn the view. `docs/gallery.py` makes the pictures from the code.

<div class="gallery" markdown>
"""

DESCRIPTORS = {
    "get_feet_contact_proportion": "the share of the steps that each foot touches the "
    "ground",
    "get_final_xy_position": "the final position",
}
"""What the extractors of the suite compute."""

CHANGES = {
    "TrapWrapper": "Here, a trap of three walls is ahead.",
    "MazeWrapper": "It is in a maze, and the reward is minus the distance to a target.",
}
"""What wrappers change of a task, beside its descriptor."""

OTHER_REWARD = {"MazeWrapper", "NoForwardRewardWrapper"}
"""Wrappers that do not reward what the robot is rewarded for."""


def actions(env: Any, steps: int) -> jax.Array:
    """Returns open-loop actions (GAITS, steps, nu)."""
    amplitude, rate, phase, middle = jax.random.uniform(
        jax.random.key(0), (4, GAITS, 1, env.action_size)
    )
    time = jnp.arange(steps)[:, None] * (env.dt if env.dt < 1 else 0.1)
    turn = 2 * math.pi * ((0.5 + 2.0 * rate) * time + phase)
    wave = amplitude * jnp.sin(turn) + 0.4 * (middle - 0.5)
    return jnp.clip(wave, -1.0, 1.0)


def make(name: str) -> Path:
    """Writes the GIF of an environment and returns its path."""
    env: Any = newton_qd.create(name, auto_reset=False)
    steps = MAZE_STEPS if env.dt == 1 else math.ceil(SECONDS / env.dt)
    found = record(env, actions(env, steps), jax.random.key(1))
    score = np.where(found.lengths == steps, found.returns, -np.inf)
    best = int((score if np.isfinite(score).any() else found.lengths).argmax())
    path = FOLDER / f"{name}.gif"
    shown = found.world(best)
    system = getattr(env.unwrapped, "system", None)
    walls = system is not None and system.scene is not None
    maze = walls and system.has_boxes and MazeWrapper in _wrappers(name)
    width, height = SIZE
    return render(
        shown,
        path,
        width=width,
        height=height,
        rate=RATE,
        zoom=MAZE if maze else WALLS if walls else CLOSE,
        elevation=ABOVE if maze else None,
    )


def _wrappers(name: str) -> list[Any]:
    return [one.wrapper for one in ENVIRONMENTS[name].wrappers]


def evolved(folder: str) -> Path:
    """Writes the GIF of four elites of a run that are fit and far from each other."""
    run = load_run(folder)
    elites = run.best(max(4, len(run.cells) // 4))
    chosen = [elites.pop(0)]
    while len(chosen) < 4:
        places = np.stack([elite.descriptor for elite in chosen])
        away = [
            float(np.linalg.norm(places - elite.descriptor, axis=1).min())
            for elite in elites
        ]
        chosen.append(elites.pop(int(np.argmax(away))))
    steps = math.ceil(3.2 / run.task.env.dt)
    found = record_elites(run, [elite.cell for elite in chosen], steps=steps)
    path = FOLDER / "evolved.gif"
    return render(found, path, width=200, height=150, rate=RATE, zoom=CLOSE)


def page() -> str:
    """Returns the text of the page."""
    text = HEAD
    for name, spec in ENVIRONMENTS.items():
        base: Any = spec.base
        options = getattr(base, "keywords", {})
        about = inspect.getdoc(getattr(base, "func", base)) or ""
        summary = " ".join(about.split("\n\n")[0].split())
        if options.get("scene") == HURDLES:
            summary += " Here, five hurdles are ahead."
        wrappers = [getattr(one.wrapper, "__name__", "") for one in spec.wrappers]
        changes = [CHANGES[one] for one in wrappers if one in CHANGES]
        if OTHER_REWARD & set(wrappers):
            summary = summary.partition(", rewarded")[0].removesuffix(".") + "."
        summary = " ".join([summary, *changes])
        extractor = getattr(spec.descriptor_extractor, "__name__", None)
        if extractor is not None:
            summary += f" Descriptor: {DESCRIPTORS[extractor]}."
        picture = f"![{name}, moving](gallery/{name}.gif)"
        text += f"\n<div markdown>\n\n## {name}\n\n{picture}\n\n{summary}\n\n</div>\n"
    return f"{text}\n</div>\n"


def main() -> None:
    """Writes the GIFs that the arguments name, or all of them and the page."""
    FOLDER.mkdir(exist_ok=True)
    if sys.argv[1:2] == ["--run"]:
        print(evolved(sys.argv[2]))
        return
    for name in sys.argv[1:] or newton_qd.registered_envs():
        path = make(name)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)
    if not sys.argv[1:]:
        PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
