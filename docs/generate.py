"""Write what the documentation says of environments and algorithms from their code.

python docs/generate.py            writes docs/environments.md, and parts of
                                   docs/evolve.md and docs/algorithm_options.md
python docs/generate.py --check    fails if a page is out of date
"""

from __future__ import annotations

import argparse
import functools
import inspect
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

import newton_qd
from newton_qd.assets import find_urdf
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.servos import Servos
from newton_qd.physics.system import JointKind
from newton_qd.qd.algorithms import ALGORITHMS
from newton_qd.qd.algorithms.options import option_texts
from newton_qd.scenes import Scene
from newton_qd.tasks import ENVIRONMENTS

PAGE = Path(__file__).with_name("environments.md")
EVOLVE_PAGE = Path(__file__).with_name("evolve.md")
OPTIONS_PAGE = Path(__file__).with_name("algorithm_options.md")

SEEN = "entries of the observation", "meaning"

HEAD = """# Environments

This page lists the observation, actions, reward, metrics and options of every
environment of `newton_qd.create`. It is generated from the code by `docs/generate.py`.

A dash means that there is no state descriptor. The first table of an environment is
its `observation_layout`: the entries of the observation. A task without such a table
has the observation of its robot. Options are keyword arguments of `create`.
`newton-qd envs` lists the names, and `newton-qd envs NAME` describes one environment.
[Differences](differences.md) compares these environments with those of QDax.

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


def _observation(env: Any) -> list[tuple[object, ...]]:
    rows, first = [], 0
    for block, size in env.observation_layout:
        last = first + size - 1
        rows.append((first if size == 1 else f"{first} to {last}", block))
        first += size
    return rows


def _descriptor(name: str, env: QDEnv) -> str:
    low, high = env.state_descriptor_limits
    found: Any = newton_qd.tables.descriptor_extractor[name]
    extractor = found.__name__
    offset = newton_qd.tables.reward_offset[name]
    original = newton_qd.tables.original_reward_offset.get(name)
    other = "" if original is None else f" (in the original suite: {original:g})"
    return (
        f"\nState descriptor: `{env.state_descriptor_name}`{_place(name)}, limits "
        f"({_numbers(low)}) to ({_numbers(high)}). Descriptor of an episode: "
        f"`{extractor}`. Reward offset: {offset:g}{other}.\n"
    )


def _place(name: str) -> str:
    """Of what the position is the descriptor, if not of the torso."""
    for spec in ENVIRONMENTS[name].wrappers:
        if "link" in spec.options:
            at = _numbers(spec.options["offset"])
            return f" of the point ({at}) of the link `{spec.options['link']}`"
    return ""


def _wrappers(name: str, base_name: str) -> str:
    """What the wrappers of a task change, and its options."""
    spec = ENVIRONMENTS[name]
    given = spec.base.keywords if isinstance(spec.base, functools.partial) else {}
    text = (
        f"The environment [`{base_name}`](#{base_name}){_given(given)} with these "
        "wrappers, from the inside to the outside:\n\n"
    )
    for one in spec.wrappers:
        meaning = " ".join((inspect.getdoc(one.wrapper) or "").split())
        title = f"`{getattr(one.wrapper, '__name__', '')}`{_given(one.options)}"
        text += f"- {title}: {meaning}\n"
    scene = given.get("scene") or spec.wrappers[-1].options.get("scene")
    if isinstance(scene, Scene):
        text += f"\nScene: {_head(scene)}\n"
    return text


def _given(options: Mapping[str, object]) -> str:
    """Options that differ from their defaults."""
    values = {
        name: value.name if isinstance(value, Scene) else value
        for name, value in options.items()
    }
    texts = [f"`{name}={value!r}`" for name, value in values.items()]
    return f" ({', '.join(texts)})" if texts else ""


def _head(scene: Scene) -> str:
    """The first paragraph of the comment at the head of a scene's file."""
    text = find_urdf(scene.urdf).read_text(encoding="utf-8")
    return " ".join(text.partition("<!--")[2].partition("\n\n")[0].split())


def _drive(env: PhysicsEnv, index: int) -> str:
    """What an action of 1 does to a joint: a servo goes to the end of its range."""
    system, (joint, gear) = env.system, env.robot.actuators[index]
    body = system.joint_names.index(joint)
    slides = system.joint_kind[body] == JointKind.PRISMATIC
    if isinstance(env, Servos):
        end = env.servo_range[1][index]
        if slides:
            return f"a place of {end:g} m, held with {gear:g} N/m"
        return f"an angle of {end:g} rad, held with {gear:g} N m/rad"
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
        (index, f"`{joint}`", _drive(env, index))
        for index, (joint, _) in enumerate(driven)
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
    seen = _table(SEEN, _observation(env))
    return "".join(
        "\n" + text for text in (seen, _actions(env), _metrics(env), options)
    )


def page() -> str:
    """Returns the text of the page."""
    summary, sections = [], ""
    described: dict[type, str] = {}
    layouts: dict[str, object] = {}
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
            layouts[known] = base.observation_layout
        elif layouts.get(known) != getattr(env, "observation_layout", None):
            sections += f"\n{_table(SEEN, _observation(env))}"
    rows = "".join(_table(row, []).splitlines(keepends=True)[0] for row in summary)
    return HEAD + rows + sections


def _algorithms() -> str:
    """Table of the algorithms of ``evolve``."""
    rows = [(f"`{spec.name}`", spec.summary) for spec in ALGORITHMS]
    return _table(("`--algorithm`", "what it is"), rows)


def _algorithm_options() -> str:
    """Tables of their options, one for each class that declares some."""
    bases = [base for spec in ALGORITHMS for base in spec.options.__mro__]
    kinds = [kind for kind in dict.fromkeys(bases) if inspect.get_annotations(kind)]
    sections = ""
    # what several algorithms have in common comes after all that inherit it
    for kind in sorted(kinds, key=lambda kind: sum(issubclass(k, kind) for k in kinds)):
        title = (inspect.getdoc(kind) or "").partition("\n")[0]
        names = [spec.name for spec in ALGORITHMS if issubclass(spec.options, kind)]
        rows = [
            (f"`{name}`", f"`{default}`" if default else "from the run", _code(meaning))
            for name, default, meaning in option_texts(kind, own=True)
        ]
        users = ", ".join(f"`{name}`" for name in names)
        sections += f"{users}: {_code(title)}\n\n"
        sections += _table(("option", "default", "meaning"), rows) + "\n"
    rows = [
        (f"`{spec.name}`", f"`{env_name}`", _defaults(tuned))
        for spec in ALGORITHMS
        for env_name, tuned in spec.tuned.items()
    ]
    rows = _merged(_merged(rows, 1), 0)
    sections += "Defaults that differ for an environment:\n\n"
    return sections + _table(("`--algorithm`", "environment", "defaults"), rows)


def _merged(rows: Sequence[tuple[str, ...]], column: int) -> list[tuple[str, ...]]:
    """Makes one row of those that differ in one column only."""
    cells: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        rest = (*row[:column], *row[column + 1 :])
        cells.setdefault(rest, []).append(row[column])
    return [
        (*rest[:column], ", ".join(found), *rest[column:])
        for rest, found in cells.items()
    ]


def _code(text: str) -> str:
    return text.replace("``", "`")


def _defaults(tuned: Mapping[str, object]) -> str:
    return ", ".join(f"`{name}` {value}" for name, value in tuned.items())


def evolve_page() -> str:
    """Returns the text of the page on ``evolve``, with its generated part anew."""
    return _renewed(EVOLVE_PAGE, "algorithms", _algorithms())


def options_page() -> str:
    """Returns the text of the page of options, with its generated part anew."""
    return _renewed(OPTIONS_PAGE, "options", _algorithm_options())


def _renewed(path: Path, name: str, part: str) -> str:
    """The text of a page with another part between two comments.

    Raises:
        ValueError: The page has no place for it.
    """
    text = path.read_text(encoding="utf-8")
    begin, end = f"<!-- {name}: docs/generate.py ", f"<!-- end of {name} -->"
    found = re.search(rf"(?s)({re.escape(begin)}.*?-->\n).*?({end})", text)
    if found is None:
        raise ValueError(f"{path.name}: no part {begin!r} to {end!r}")
    return f"{text[: found.end(1)]}\n{part}\n{text[found.start(2) :]}"


def main() -> int:
    """Writes the pages, or compares them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    texts = {PAGE: page(), EVOLVE_PAGE: evolve_page(), OPTIONS_PAGE: options_page()}
    if parser.parse_args().check:
        return int(any(p.read_text(encoding="utf-8") != t for p, t in texts.items()))
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
