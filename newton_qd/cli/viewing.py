"""``newton-qd replay`` and ``render``: pages and pictures of what a run has found."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from newton_qd import checks
from newton_qd.checks import Fact, listed, message
from newton_qd.cli import modules
from newton_qd.cli.arguments import (
    BAD_ARGUMENTS,
    OK,
    Commands,
    add_elite_choice,
    complain,
    holds_run,
    load_physics,
    picture_size,
    require_writable,
)
from newton_qd.cli.progress import ProgressCount
from newton_qd.cli.runs import checked_starts, opened
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.folder import PICTURE

if TYPE_CHECKING:
    from newton_qd.qd.run.opened import Run
    from newton_qd.qd.scoring.task import Task
    from newton_qd.viewing.trajectory import Trajectory

    TaskFactory = Callable[[EvolveConfig], Task] | None

_MOST_WORLDS = 50  # that a page shows at once
_RANDOM_STEPS = 250  # of an environment without a policy
_MOST_STEPS = 1_000_000  # of all its worlds: a page of an ant has 91 bytes for each


def add_parsers(commands: Commands) -> None:
    """Adds the commands to the subparsers of ``newton-qd``."""
    _add_replay(commands)
    _add_explore(commands)
    _add_render(commands)


def _add_replay(commands: Commands) -> None:
    parser = commands.add_parser(
        "replay",
        help="write a page that shows elites of a run, or an environment, moving",
        description="Writes one HTML file that opens in any browser, without a "
        "network: elites of a results folder, or an environment with random actions.",
    )
    _add_choice(parser)
    modules.add_argument(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="HTML file (default: replay.html in the results folder, or ENV.html)",
    )
    parser.set_defaults(run=replay)


def _add_explore(commands: Commands) -> None:
    parser = commands.add_parser(
        "explore",
        help="write a page with the archive of a run: click a cell, watch its elite",
        description="Writes one HTML file that opens in any browser, without a "
        "network: the archive of a run, or of two runs of the same robot. A click on a "
        "cell shows its elite moving.",
    )
    parser.add_argument(
        "folders",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="one or two results folders",
    )
    modules.add_argument(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="HTML file (default: explorer.html in the first folder)",
    )
    parser.add_argument(
        "--starts",
        type=int,
        default=0,
        metavar="N",
        help="also evaluate each elite from N other start states (default: 0)",
    )
    parser.add_argument(
        "--seed", type=int, metavar="N", help="seed of --starts (default: 0)"
    )
    parser.set_defaults(run=explore)


def _add_render(commands: Commands) -> None:
    parser = commands.add_parser(
        "render",
        help="write a picture, a GIF or a video of elites, without a screen",
        description="Writes a picture, a GIF or a video of elites of a results folder, "
        "or of an environment with random actions. Several worlds make a sheet.",
    )
    _add_choice(parser)
    modules.add_argument(parser)
    kinds = parser.add_mutually_exclusive_group()
    for kind, text in (
        ("png", "a picture of the middle of the episode, or of --time"),
        ("gif", "a moving picture (default)"),
        ("mp4", "a video; needs the extra video"),
    ):
        kinds.add_argument(f"--{kind}", action="store_true", help=text)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="file; its ending may choose the kind (default: elites.gif in the results "
        "folder, or ENV.gif)",
    )
    parser.add_argument(
        "--size",
        type=picture_size,
        default=(480, 360),
        metavar="WxH",
        help="size of the picture of one world [px] (default: 480x360)",
    )
    parser.add_argument(
        "--time", type=float, metavar="S", help="moment of a picture with --png [s]"
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="N",
        help="pictures per second of a GIF or video (default: 20)",
    )
    parser.set_defaults(run=render)


def _add_choice(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments that choose what is shown."""
    parser.add_argument(
        "what", metavar="DIR|ENV", help="results folder, or environment"
    )
    add_elite_choice(
        parser, "the N fittest elites (default: 1); of an environment, N worlds"
    )
    parser.add_argument(
        "--steps",
        type=int,
        metavar="N",
        help="control steps (default: an episode of the run, or "
        f"{_RANDOM_STEPS} of an environment, whose worlds have up to {_MOST_STEPS:,} "
        "together)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        metavar="N",
        help="seed of an environment's start and actions (default: 0)",
    )
    parser.add_argument(
        "--contacts", action="store_true", help="record the impulse of each contact"
    )


def replay(arguments: argparse.Namespace, task_factory: TaskFactory = None) -> int:
    """Writes a replay page. Returns the exit code.

    Raises:
        ConfigError: An argument is not allowed, the archive cannot be read, or there
            is neither a folder nor an environment of this name.
    """
    out = _target(arguments, "replay.html", ".html")
    _check_page(out)
    load_physics()
    from newton_qd.viewing import write_replay

    try:
        trajectory, title = _trajectory(arguments, task_factory)
    except (LookupError, ValueError) as error:
        return complain(arguments, error, BAD_ARGUMENTS)

    write_replay(trajectory, out, title)
    print(f"written: {out}\nopen it in a browser: {out.absolute().as_uri()}")
    return OK


def explore(arguments: argparse.Namespace, task_factory: TaskFactory = None) -> int:
    """Writes an explorer page. Returns the exit code.

    Raises:
        ConfigError: An argument is not allowed, or an archive cannot be read.
    """
    seed = checked_starts(arguments)
    if len(arguments.folders) > 2:
        given = Fact(f"{len(arguments.folders)} folders")
        raise ConfigError(message("DIR", given, "one folder or two"))
    out = arguments.out
    if out is None:
        out = arguments.folders[0] / "explorer.html"
    _check_target(out, given=arguments.out is not None)
    _check_page(out)
    load_physics()
    runs = [_drawable(folder, task_factory) for folder in arguments.folders]
    from newton_qd.viewing import write_explorer

    options = {"starts": arguments.starts, "seed": seed}
    try:
        with ProgressCount("elites") as progress:
            write_explorer(runs, out, progress=progress, **options)
    except ValueError as error:
        return complain(arguments, error, BAD_ARGUMENTS)
    print(f"written: {out}\nopen it in a browser: {out.absolute().as_uri()}")
    return OK


def render(arguments: argparse.Namespace, task_factory: TaskFactory = None) -> int:
    """Writes a picture, a GIF or a video. Returns the exit code.

    Raises:
        ConfigError: An argument is not allowed, the archive cannot be read, or there
            is neither a folder nor an environment of this name.
        MissingExtra: Pillow or imageio-ffmpeg is not installed.
    """
    checks.number("--time", arguments.time, least=0, optional=True, error=ConfigError)
    checks.number("--rate", arguments.rate, above=0, optional=True, error=ConfigError)
    chosen = [kind for kind in ("png", "gif", "mp4") if getattr(arguments, kind)]
    ending = f".{chosen[0]}" if chosen else ".gif"
    out = _target(arguments, f"elites{ending}", ending)
    load_physics()
    from newton_qd.viewing import render as write
    from newton_qd.viewing.video import FORMATS, require

    if out.suffix not in FORMATS or (chosen and out.suffix != ending):
        allowed = f"files that end with {ending if chosen else ', '.join(FORMATS)}"
        raise ConfigError(message("--out", str(out), allowed))
    unused = "rate" if out.suffix == ".png" else "time"
    if getattr(arguments, unused) is not None:
        allowed = "with --png" if unused == "time" else "with --gif or --mp4"
        given, why = getattr(arguments, unused), f"which has no effect on {out.name}"
        raise ConfigError(message(f"--{unused}", given, allowed, why=why))
    require(out.suffix)  # before the slow part
    width, height = arguments.size
    options = {"width": width, "height": height, "rate": arguments.rate or 20.0}
    try:
        trajectory, _ = _trajectory(arguments, task_factory)
        with ProgressCount("pictures") as progress:
            write(trajectory, out, time=arguments.time, progress=progress, **options)
    except (LookupError, ValueError) as error:
        return complain(arguments, error, BAD_ARGUMENTS)
    print(f"written: {out}")
    return OK


def _target(arguments: argparse.Namespace, name: str, ending: str) -> Path:
    """Returns the file to write: ``name`` in a results folder, or ENV with an ending.

    Raises:
        ConfigError: It is a folder, lies in no folder, or is a file of a run.
    """
    folder = Path(arguments.what)
    out = arguments.out
    if out is None:
        out = folder / name if folder.is_dir() else Path(f"{arguments.what}{ending}")
    _check_target(out, given=arguments.out is not None)
    return out


def _check_target(out: Path, *, given: bool) -> None:
    """Checks the file to write, before the slow part.

    Raises:
        ConfigError: It is a folder, lies in no folder, or is a file of a run.
    """
    if out.is_dir():
        why = "which is a folder"
        raise ConfigError(message("--out", str(out), "a file", why=why))
    if given and not out.parent.is_dir():
        why = f"and {out.parent} is no folder"
        raise ConfigError(message("--out", str(out), "a file in a folder", why=why))
    if out.name == PICTURE and holds_run(out.parent):
        why = "which is the picture of the archive of a run"
        raise ConfigError(message("--out", str(out), "a file of another name", why=why))
    require_writable("--out", out)


def _check_page(out: Path) -> None:
    """Checks that a page does not replace a file of another kind, such as a run's.

    Raises:
        ConfigError: The file does not end as a page does.
    """
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(message("--out", str(out), "files that end with .html"))


def _trajectory(
    arguments: argparse.Namespace, task_factory: TaskFactory
) -> tuple[Trajectory, str]:
    """Records what the arguments choose; returns it with a title.

    Raises:
        ConfigError: A number is not allowed, there is neither a folder nor an
            environment of this name, or the environment cannot be drawn.
    """
    seed = arguments.seed
    checks.integer("--steps", arguments.steps, optional=True, error=ConfigError)
    most = 2**32 - 1
    checks.integer("--seed", seed, least=0, most=most, optional=True, error=ConfigError)
    checks.integer(
        "--best", arguments.best, most=_MOST_WORLDS, optional=True, error=ConfigError
    )
    if Path(arguments.what).is_dir() and seed is not None:
        allowed = "an environment in the place of the results folder"
        why = "and elites begin where their run began"
        raise ConfigError(message("--seed", seed, allowed, why=why))
    if not Path(arguments.what).is_dir():
        return _random_trajectory(arguments), f"{arguments.what}, random actions"
    from newton_qd.viewing import record_elites

    run = _drawable(Path(arguments.what), task_factory)
    return (
        record_elites(
            run,
            _cells(run, arguments),
            steps=arguments.steps,
            contacts=arguments.contacts,
        ),
        f"{run.config.env_name}, {run.path}",
    )


def _drawable(folder: Path, task_factory: TaskFactory) -> Run:
    """Opens a run whose environment can be drawn.

    Raises:
        ConfigError: It cannot be drawn, or the folder holds no run.
    """
    from newton_qd.viewing import can_draw

    run = opened(folder, task_factory)
    if not can_draw(run.task.env):
        given = Fact(type(run.task.env).__name__)
        raise ConfigError(message("env", given, "simulated robots, and pointmaze"))
    return run


def _cells(run: Run, arguments: argparse.Namespace) -> list[int]:
    """Returns the cells that the arguments choose.

    Raises:
        ConfigError: The archive is empty.
        LookupError: There is no such cell, or it is empty.
        ValueError: ``--near`` has a wrong length.
    """
    if not len(run.cells):
        raise ConfigError(message(str(run.path), Fact("no elite"), "at least one"))
    if arguments.cell is not None:
        return [run.elite(arguments.cell).cell]
    if arguments.near is not None:
        return [run.nearest(arguments.near)[0].cell]
    return [elite.cell for elite in run.best(arguments.best or 1)]


def _random_trajectory(arguments: argparse.Namespace) -> Trajectory:
    """Records an environment with random actions.

    Raises:
        ConfigError: An option needs a results folder, or there is neither a folder nor
            an environment of this name.
    """
    import newton_qd

    if arguments.what not in newton_qd.registered_envs():
        why = "is a file" if Path(arguments.what).exists() else "does not exist"
        allowed = f"a results folder, or one of {listed(newton_qd.registered_envs())}"
        refused = message("DIR|ENV", arguments.what, allowed, why=f"which {why}")
        raise ConfigError(f"{refused}; --module NAME adds environments of yours")
    for name in ("cell", "near"):
        if getattr(arguments, name) is not None:
            allowed = "a results folder in the place of the environment"
            raise ConfigError(message(f"--{name}", getattr(arguments, name), allowed))
    import jax

    from newton_qd.viewing import record
    from newton_qd.viewing.recording import check_memory

    steps, worlds = arguments.steps or _RANDOM_STEPS, arguments.best or 1
    name = "--steps" if worlds == 1 else f"--steps of each of {worlds} worlds"
    checks.integer(name, steps, most=_MOST_STEPS // worlds, error=ConfigError)
    env = newton_qd.create(arguments.what, episode_length=steps, auto_reset=False)
    check_memory(env, steps, worlds)
    start, noise = jax.random.split(jax.random.key(arguments.seed or 0))
    shape = (worlds, steps, env.action_size)
    actions = jax.random.uniform(noise, shape, env.dtype, -1, 1)
    return record(env, actions, start, contacts=arguments.contacts)
