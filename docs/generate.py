"""Write the page of the environments from their code.

python docs/generate.py            writes docs/environments.md
python docs/generate.py --check    fails if the page is out of date
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import jax
import numpy as np

import newton_qd
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.physics.system import JointKind
from newton_qd.tasks import ENVIRONMENTS

PAGE = Path(__file__).with_name("environments.md")

HEAD = """# Environments

This page lists the observation, actions, reward, metrics and options of every
environment of `newton_qd.create`. It is generated from the code by `docs/generate.py`.

A dash means that there is no state descriptor. Options are keyword arguments of
`create`. [Differences](differences.md) compares these environments with the original
ones.

| name | robot or task | observation | action | step [s] | state descriptor |
|---|---|---|---|---|---|
"""


def _table(head: tuple[str, ...], rows: Sequence[tuple[object, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "".join(
        "| " + " | ".join(str(cell) for cell in row) + " |\n" for row in lines
    )


def _numbers(values: object) -> str:
    return ", ".join(f"{value:g}" for value in np.asarray(values).ravel())


def _summary(name: str, env: Env) -> tuple[object, ...]:
    descriptor = "-"
    if name in newton_qd.tables.descriptor_extractor:
        qd = cast(QDEnv, env)
        descriptor = f"`{qd.state_descriptor_name}` ({qd.state_descriptor_length})"
    link = f"[`{name}`](#{name})"
    sizes = env.observation_size, env.action_size, f"{env.dt:g}"
    return (link, f"`{env.name}`", *sizes, descriptor)


def _options(base: type) -> list[tuple[object, ...]]:
    """Constructor options, with the defaults of the signature and their docstring."""
    text = inspect.getdoc(base.__init__) or ""
    rows = []
    for parameter in inspect.signature(base).parameters.values():
        found = re.search(
            rf"^ +{parameter.name}: (.*(?:\n {{8,}}.*)*)", text, flags=re.MULTILINE
        )
        meaning = " ".join(found.group(1).split()) if found else ""
        rows.append((f"`{parameter.name}`", f"`{parameter.default!r}`", meaning))
    return rows


def _observation(env: PhysicsEnv | PointMaze) -> list[tuple[object, ...]]:
    rows, first = [], 0
    for block, size in env.observation_layout:
        last = first + size - 1
        rows.append((first if size == 1 else f"{first} to {last}", block))
        first += size
    return rows


def _descriptor(name: str, env: QDEnv) -> str:
    low, high = env.state_descriptor_limits
    extractor = newton_qd.tables.descriptor_extractor[name].__name__
    offset = newton_qd.tables.reward_offset[name]
    original = newton_qd.tables.original_reward_offset[name]
    return (
        f"\nState descriptor: `{env.state_descriptor_name}`, limits ({_numbers(low)}) "
        f"to ({_numbers(high)}). Descriptor of an episode: `{extractor}`. Reward "
        f"offset: {offset:g} (in the original suite: {original:g}).\n"
    )


def _wrappers(name: str, base_name: str) -> str:
    """What the wrappers of a task change."""
    text = (
        f"The environment [`{base_name}`](#{base_name}) with these wrappers, from the "
        "inside to the outside:\n\n"
    )
    for spec in ENVIRONMENTS[name].wrappers:
        meaning = " ".join((inspect.getdoc(spec.wrapper) or "").split())
        text += f"- `{getattr(spec.wrapper, '__name__', '')}`: {meaning}\n"
    return text


def _drive(env: PhysicsEnv, joint: str, gear: float) -> str:
    """What an action of 1 does to a joint: a servo goes to the end of its range."""
    system = env.system
    body = system.joint_names.index(joint)
    if joint in env.robot.servos:
        end = system.limit_upper[system.v_start[body]]
        return f"an angle of {end:g} rad, held with {gear:g} N m/rad"
    slides = system.joint_kind[body] == JointKind.PRISMATIC
    return f"a force of {gear:g} N" if slides else f"a torque of {gear:g} N m"


def _actions(env: PhysicsEnv | PointMaze) -> str:
    if isinstance(env, PointMaze):
        rows = [
            (index, f"a move of {env.reach:g} along {axis}")
            for index, axis in enumerate("xy")
        ]
        return _table(("action", "an action of 1 is"), rows)
    driven = env.robot.actuators[: env.action_size]
    rows = [
        (index, f"`{joint}`", _drive(env, joint, gear))
        for index, (joint, gear) in enumerate(driven)
    ]
    return _table(("action", "joint", "an action of 1 is"), rows)


def _meanings(base: type) -> tuple[str, dict[str, str]]:
    """The docstring of an environment, and what it says about its metrics."""
    text, _, section = (inspect.getdoc(base) or "").partition("\n\nMetrics:\n")
    rows = re.findall(r"^    (\w+): (.*(?:\n {8,}.*)*)", section, flags=re.MULTILINE)
    return text, {name: " ".join(meaning.split()) for name, meaning in rows}


def _metrics(env: PhysicsEnv | PointMaze) -> str:
    """Table of the metrics.

    Raises:
        ValueError: The docstring has others.
    """
    metrics = sorted(jax.eval_shape(env.reset, jax.random.key(0)).metrics)
    meanings = _meanings(type(env))[1]
    if metrics != sorted(meanings):
        raise ValueError(
            f"{type(env).__name__}: metrics {metrics}, docstring {sorted(meanings)}"
        )
    if not metrics:
        return "No metrics.\n"
    rows = [(f"`{name}`", meaning) for name, meaning in meanings.items()]
    return _table(("metric", "meaning"), rows)


def _tables(env: PhysicsEnv | PointMaze) -> str:
    """What all environments of one base share."""
    options = _table(("option", "default", "meaning"), _options(type(env)))
    seen = _table(("entries of the observation", "meaning"), _observation(env))
    return "".join(
        "\n" + text for text in (seen, _actions(env), _metrics(env), options)
    )


def page() -> str:
    """Returns the text of the page."""
    summary, sections = [], ""
    described: dict[type, str] = {}
    for name in newton_qd.registered_envs():
        env = newton_qd.create(name, auto_reset=False)
        base = env.unwrapped
        summary.append(_summary(name, env))
        sections += f"\n## {name}\n\n"
        known = described.setdefault(type(base), name)
        if known != name:
            sections += _wrappers(name, known)
        else:
            sections += f"{_meanings(type(base))[0]}\n"
        if name in newton_qd.tables.descriptor_extractor:
            sections += _descriptor(name, cast(QDEnv, env))
        if known == name and isinstance(base, PhysicsEnv | PointMaze):
            sections += _tables(base)
    rows = "".join(_table(row, []).splitlines(keepends=True)[0] for row in summary)
    return HEAD + rows + sections


def main() -> int:
    """Writes the page, or compares it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    text = page()
    if parser.parse_args().check:
        return int(PAGE.read_text(encoding="utf-8") != text)
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
