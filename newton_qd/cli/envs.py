"""``newton-qd envs``: lists the environments, or describes one."""

from __future__ import annotations

import argparse
import functools
import inspect
import json
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from newton_qd.cli import modules
from newton_qd.cli.arguments import (
    FAILED,
    OK,
    Commands,
    complain,
    print_table,
    terminal_width,
)


def add_parser(commands: Commands) -> None:
    """Adds the command to the subparsers of ``newton-qd``."""
    parser = commands.add_parser(
        "envs",
        help="list the environments, or describe one",
        description="Lists the environments. With NAME, describes one: sizes, limits, "
        "terms of the reward, wrappers.",
    )
    parser.add_argument(
        "name", nargs="?", metavar="NAME", help="environment, for example ant_uni"
    )
    parser.add_argument("--json", action="store_true", help="print JSON, for scripts")
    modules.add_argument(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Prints the table or a description, and returns the exit code.

    The table has what can be made. Standard error says what cannot, and why.

    Raises:
        UnknownEnvironment: No environment has this name.
    """
    import newton_qd

    if arguments.name is not None:
        found = _facts(arguments.name, whole=True)
        print(json.dumps(found, indent=2) if arguments.json else _description(found))
        return OK
    rows: list[dict[str, Any]] = []
    failures: list[str] = []
    for name in newton_qd.registered_envs():
        try:
            rows.append(_facts(name, whole=False))
        except Exception as error:  # the code of a user may raise any
            failures.append(f"{name} cannot be made: {type(error).__name__}: {error}")
    if arguments.json:
        print(json.dumps(rows, indent=2))
    else:
        _print_table(rows)
    for failure in failures:
        complain(arguments, failure, FAILED)
    return FAILED if failures else OK


def _print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Prints the table of environments."""
    table = []
    for row in rows:
        descriptor = offset = "-"
        if row["descriptor"] is not None:
            descriptor = f"{row['descriptor']['name']} ({row['descriptor']['size']})"
            offset = _number(row["reward_offset"])
        sizes = row["observation_size"], row["action_size"]
        table.append((row["name"], *sizes, descriptor, offset))
    head = ("name", "observation", "action", "descriptor", "reward offset")
    print_table(head, table)


def _facts(name: str, *, whole: bool) -> dict[str, Any]:
    """Returns what is known of an environment, as a JSON value.

    Args:
        name: Its name.
        whole: Whether to add what only the description of one environment shows.

    Raises:
        UnknownEnvironment: No environment has this name.
    """
    import numpy as np

    import newton_qd

    env: Any = newton_qd.create(name)
    found: dict[str, Any] = {
        "name": name,
        "observation_size": env.observation_size,
        "action_size": env.action_size,
        "step_seconds": env.dt,
        "descriptor": None,
        "reward_offset": newton_qd.tables.reward_offset.get(name),
    }
    if name in newton_qd.tables.descriptor_extractor:
        low, high = (np.asarray(ends, float) for ends in env.state_descriptor_limits)
        found["descriptor"] = {
            "name": env.state_descriptor_name,
            "size": env.descriptor_length,
            "low": low.tolist(),
            "high": high.tolist(),
        }
    if not whole:
        return found
    base = env.unwrapped
    # not the text of a base class, which says nothing about this environment
    text = inspect.cleandoc(vars(type(base)).get("__doc__") or "")
    text, _, section = text.partition("\n\nMetrics:\n")
    terms = re.findall(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", section, flags=re.MULTILINE)
    found["description"] = " ".join(text.split("\n\n")[0].split())
    found["about"] = [" ".join(part.split()) for part in text.split("\n\n")[1:]]
    found["metrics"] = {term: " ".join(meaning.split()) for term, meaning in terms}
    found["observation"] = [
        {"name": block, "size": size}
        for block, size in getattr(env, "observation_layout", ())
    ]
    found["actuators"] = [
        {"joint": joint, "gear": gear}
        for joint, gear in getattr(getattr(base, "robot", None), "actuators", ())
    ][: env.action_size]
    found["base"] = type(base).__name__
    found["changes"] = _changes(name)
    found["wrappers"] = _wrappers(env)
    found["picture"] = _picture(name)
    return found


def _numbers(count: int) -> str:
    return "1 number" if count == 1 else f"{count} numbers"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def _wrappers(env: Any) -> list[str]:
    """Returns the names of the wrappers, from the inside to the outside."""
    found = []
    while env is not env.unwrapped:
        found.insert(0, type(env).__name__)
        env = env.env
    return found


def _changes(name: str) -> list[dict[str, str]]:
    """Returns the texts of the task's own wrappers, from the inside to the outside."""
    from newton_qd import tasks

    found = []
    for spec in tasks.ENVIRONMENTS[name].wrappers:
        wrapper = spec.wrapper
        while isinstance(wrapper, functools.partial):  # whose text is about partial
            wrapper = wrapper.func
        # without sections such as "Args:", which are about the code
        whole = inspect.cleandoc(wrapper.__doc__ or "")
        text = " ".join(re.split(r"^\w+:\n", whole, flags=re.MULTILINE)[0].split())
        label = getattr(wrapper, "__name__", "wrapper")
        found.append({"wrapper": label, "meaning": text or "it has no description"})
    return found


def _picture(name: str) -> str | None:
    """Returns the path of the picture in a checkout, or ``None``."""
    import newton_qd

    root = Path(newton_qd.__file__).resolve().parent.parent
    path = root / "docs" / "gallery" / f"{name}.gif"
    return str(path) if path.is_file() else None


def _description(found: dict[str, Any]) -> str:
    """Returns the text that describes an environment."""
    name, descriptor = found["name"], found["descriptor"]
    title, lines = name, []
    if found["changes"]:  # they may change reward, end and observation of the base
        title = found["base"]
        names = ", ".join(change["wrapper"] for change in found["changes"])
        lines = [f"{name}: {title}, changed by {names}", ""]
    lines.append(f"{title}: {found['description'] or 'its class has no description'}")
    lines += ["", *(line for part in found["about"] for line in (part, ""))]
    for change in found["changes"]:
        lines += [f"{change['wrapper']}: {change['meaning']}", ""]
    lines += [
        f"step: {found['step_seconds']:g} s",
        f"observation: {_numbers(found['observation_size'])}",
    ]
    lines += [f"  {block['size']:4}  {block['name']}" for block in found["observation"]]
    lines.append(f"action: {_numbers(found['action_size'])}")
    lines += [
        f"  {motor['joint']}, gear {motor['gear']:g}" for motor in found["actuators"]
    ]
    if descriptor is None:
        lines.append("descriptor: none")
    else:
        ends = zip(descriptor["low"], descriptor["high"], strict=True)
        limits = ", ".join(f"{low:g} to {high:g}" for low, high in ends)
        lines.append(f"descriptor: {descriptor['name']}, limits {limits}")
        lines.append(f"reward offset: {_number(found['reward_offset'])}")
    if found["metrics"]:
        lines.append("metrics, the terms of the reward and more:")
    lines += [f"  {term}: {meaning}" for term, meaning in found["metrics"].items()]
    lines.append(f"wrappers: {', '.join(found['wrappers']) or 'none'}")
    picture = found["picture"] or f"newton-qd render {name} --png makes one"
    lines.append(f"picture: {picture}")
    wrapped = [
        textwrap.fill(
            line,
            terminal_width(),
            subsequent_indent="    " if line.startswith("  ") else "",
            break_on_hyphens=False,
            break_long_words=False,
        )
        for line in lines
    ]
    return "\n".join(wrapped)
