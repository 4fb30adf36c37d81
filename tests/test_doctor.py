"""The gradient doctor: right about problems whose answer is known, and its files."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd import cli
from newton_qd.envs.state import State
from newton_qd.gradients import GradientReport, diagnose_gradients


class Growing:
    """x' = growth sin(x) + action; the reward is x'. Chaotic where growth is large."""

    observation_size = action_size = 1
    dtype, dt, name = np.dtype("float64"), 0.1, "growing"

    def __init__(self, growth: float, length: int = 1000) -> None:
        self.growth, self.length = growth, length

    def reset(self, rng: jax.Array) -> State:
        del rng
        return self._state(jnp.zeros((1,)), jnp.zeros((), jnp.int32))

    def step(self, state: State, action: jax.Array) -> State:
        x, steps = state.pipeline_state
        return self._state(self.growth * jnp.sin(x) + action, steps + 1)

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        done = (steps >= self.length).astype(x.dtype)
        return State((x, steps), x, x[0], done, {}, {})


HORIZONS = (1, 2, 4, 8, 16)


def diagnose(env: Any, **options: Any) -> GradientReport:
    return diagnose_gradients(env, horizons=HORIZONS, worlds=4, **options)


@pytest.mark.slow
def test_a_tame_system_is_usable_throughout(tmp_path: Path) -> None:
    report = diagnose(Growing(0.5))
    assert report.exact_horizon == report.useful_horizon == 16
    assert "up to 16 control steps (1.6 s)" in report.verdict
    assert "Use it over all of them." in report.verdict
    assert [row.alive for row in report.horizons] == [1.0] * 5
    assert all(row.worst_cosine > 1 - 1e-9 for row in report.horizons)
    assert all(abs(row.bias) < 5 * row.bias_error + 1e-9 for row in report.horizons)
    assert 1.0 < report.growth < 1.2
    report.write(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"horizons.csv", "contacts.csv", "report.txt", "gradients.png"}
    with open(tmp_path / "out" / "horizons.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == list(HORIZONS)
    assert float(rows[0]["norm"]) == report.horizons[0].norm
    assert (tmp_path / "out" / "report.txt").read_text() == f"{report}\n"


def test_a_chaotic_system_is_not() -> None:
    report = diagnose(Growing(20.0))
    last = report.horizons[-1]
    assert report.growth > 5
    assert report.useful_horizon < 16
    assert last.order < 0.01 and last.first_deviation > 100 * last.zeroth_deviation
    assert (
        f"window={min(report.exact_horizon, report.useful_horizon)}" in report.verdict
    )
    assert report.contacts[0].body == "no contact"


def test_short_episodes_are_told() -> None:
    report = diagnose(Growing(0.5, length=4))
    assert [row.alive for row in report.horizons] == [1, 1, 1, 0, 0]
    assert "Most episodes end before step 8" in report.verdict
    assert report.horizons[-1].norm == report.horizons[2].norm


def test_policies_are_diagnosed_too() -> None:
    def policy(genotype: Any, obs: jax.Array) -> jax.Array:
        return genotype["gain"] * obs + genotype["bias"]

    ones = np.linspace(0.1, 0.4, 4).reshape(4, 1)
    report = diagnose(
        Growing(0.5), policy=policy, genotypes={"gain": ones, "bias": ones}
    )
    assert not report.open_loop and report.exact_horizon == 16


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizons": (4, 2)}, "horizons=.*ascending"),
        ({"horizons": ()}, "horizons=.*ascending"),
        ({"worlds": 0}, "worlds=0: allowed"),
        ({"samples": 1}, "samples=1: allowed"),
        ({"sigma": 0.0}, "sigma=0.0: allowed"),
        ({"genotypes": 1}, "policy and genotypes"),
    ],
)
def test_bad_settings(options: dict[str, Any], message: str) -> None:
    env: Any = Growing(1.0)
    with pytest.raises(ValueError, match=message):
        diagnose_gradients(env, **options)


def test_single_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="float32; allowed: float64"):
        newton_qd.diagnose_gradients(newton_qd.create("hopper"))


def test_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "hopper"
    small = "--horizons 1,4 --worlds 2 --samples 2 --directions 2".split()
    code = cli.main(["doctor", "gradients", "hopper", *small, "--out", str(out)])
    captured = capsys.readouterr()
    assert code == cli.OK
    assert captured.err == ""
    assert "hopper: gradient of the return to open-loop actions" in captured.out
    assert "agrees with differences up to 4 control steps (0.032 s)" in captured.out
    assert (out / "gradients.png").read_bytes().startswith(b"\x89PNG")
    bad = ["doctor", "gradients", "hopper", "--horizons", "4,2"]
    assert cli.main(bad) == cli.BAD_ARGUMENTS
    assert "ascending" in capsys.readouterr().err
    assert cli.main(["doctor", "gradients", "nothing"]) == cli.BAD_ARGUMENTS
