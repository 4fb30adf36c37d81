"""The README: its commands exist, its examples run, its table is true."""

from __future__ import annotations

import functools
import itertools
import re
import shlex
from pathlib import Path

import pytest
from test_registry import created

import newton_qd

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def readme_blocks(language: str) -> list[str]:
    """Code blocks of the README in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.M | re.S)


def readme_commands() -> list[str]:
    """Commands of the README."""
    lines = itertools.chain.from_iterable(
        block.splitlines() for block in readme_blocks("bash")
    )
    return [line.strip() for line in lines if line.strip()]


def test_ci_runs_the_test_command_of_the_readme() -> None:
    (command,) = [line for line in readme_commands() if "pytest" in line][:1]
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert command in script
    # what the README leaves out runs too
    assert 'pytest -n auto -m "slow and not optimized" || failed=$?' in script
    mark = r"mark\.optimized"
    files = f"$(grep -l '{mark}' tests/test_*.py)"
    assert f"pytest -n auto --optimized -m optimized {files}" in script
    # ... and no helper marks a test so
    helpers = {*(ROOT / "tests").glob("*.py")} - {*(ROOT / "tests").glob("test_*.py")}
    assert not [path for path in helpers if re.search(mark, path.read_text("utf-8"))]


def test_readme_names_commands_that_exist() -> None:
    from newton_qd import cli

    (command,) = [line for line in readme_commands() if "newton-qd evolve" in line][:1]
    arguments = shlex.split(command.partition("newton-qd ")[2])
    with pytest.raises(SystemExit) as ended:
        cli.main([*arguments, "--help"])
    assert ended.value.code == 0


@pytest.mark.parametrize("index", range(len(readme_blocks("python"))))
def test_readme_examples_run(index: int) -> None:
    assert "state" in readme_namespace(index)


@functools.cache
def readme_namespace(index: int) -> dict[str, object]:
    """Names after a block of the README; each goes on where the last one ended."""
    namespace = dict(readme_namespace(index - 1)) if index else {}
    block = readme_blocks("python")[index]
    exec(compile(block, "README.md", "exec"), namespace)
    return namespace


def test_readme_table_of_environments() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \| (\d+) \| (\d+) \| (\d+|-) \|", README, re.MULTILINE
    )
    assert {row[0] for row in rows} == set(newton_qd.registered_envs())
    for name, observation, action, descriptor in rows:
        env = created(name)
        assert env.observation_size == int(observation)
        assert env.action_size == int(action)
        length = getattr(env, "descriptor_length", None)
        assert length == (None if descriptor == "-" else int(descriptor))
