"""The gradient doctor: right about problems whose answer is known, and its files."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import line_env
import numpy as np
import pytest

import newton_qd
from newton_qd import cli, tasks
from newton_qd.envs.state import State
from newton_qd.errors import FaultError
from newton_qd.gradients import GradientReport, diagnose_gradients
from newton_qd.gradients.doctor_input import checked_genotypes
from newton_qd.gradients.measurements import Subject
from newton_qd.gradients.report import HorizonRow


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
    assert report.plot()._repr_png_().startswith(b"\x89PNG")
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
        ({"horizons": (4, 2)}, r"horizons: got \(4, 2\); allowed: ascending"),
        ({"horizons": ()}, r"horizons: got \(\); allowed: ascending"),
        ({"horizons": (1.5, 2)}, r"horizons\[0\]: got 1.5; allowed: integers"),
        ({"horizons": (1, 10**12)}, r"horizons\[1\]: got 1000000000000; allowed"),
        ({"seed": 10**30}, "seed: got 1000.*; allowed: integers from 0"),
        ({"sigma": float("inf")}, "sigma: got inf; allowed: finite numbers"),
        ({"worlds": 10**12}, "worlds: got 1000000000000; allowed"),
        ({"worlds": 0}, "worlds: got 0; allowed"),
        ({"samples": 1}, "samples: got 1; allowed"),
        ({"sigma": 0.0}, "sigma: got 0.0; allowed"),
        ({"genotypes": 1}, "genotypes: got leaves of shapes"),
        ({"genotypes": np.zeros((2, 3, 1))}, "got plans of 3 steps; .*at least 64"),
        (
            {"genotypes": np.zeros((2, 16, 2))},
            r"allowed: .*\(worlds, steps, 1\)",
        ),
        (
            {"policy": lambda x, y: y, "genotypes": np.zeros((2, 1), int)},
            r"genotypes: got a leaf of int..; allowed: floating-point",
        ),
        ({"policy": lambda x, y: y}, "genotypes: got None; allowed: with a policy"),
    ],
)
def test_bad_settings(options: dict[str, Any], message: str) -> None:
    env: Any = Growing(1.0)
    with pytest.raises(ValueError, match=message):
        diagnose_gradients(env, **options)


@pytest.mark.parametrize(
    "options",
    [{"horizons": 5}, {"horizons": "12"}, {"sigma": "a"}, {"env": None}],
    ids=str,
)
def test_bad_types(options: dict[str, Any]) -> None:
    given: dict[str, Any] = {"env": Growing(1.0), **options}
    with pytest.raises(TypeError, match=f"{next(iter(options))}: got .*allowed"):
        diagnose_gradients(**given)


def test_plans_of_ones_own_are_diagnosed_too() -> None:
    """In any precision, as many as there are, as far as the longest horizon."""
    plans = np.linspace(-1.0, 1.0, 2 * 20, dtype=np.float32).reshape(2, 20, 1)
    report = diagnose(Growing(0.5), genotypes=plans)
    assert report.open_loop and report.exact_horizon == 16
    one = diagnose_gradients(Growing(0.5), genotypes=plans, horizons=(1,))  # pyright: ignore[reportArgumentType]
    assert np.isnan(one.growth) and "The norm grows" not in str(one)
    assert "up to 1 control step (0.1 s)" in str(one)


class Failing(Growing):
    """At fault where x is above 2."""

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        fault = (x[0] > 2.0).astype(jnp.int32)
        sound = super()._state(jnp.where(fault == 0, x, 0.0), steps)
        return sound.replace(info={"fault": fault})


def test_small_types_are_diagnosed_in_double_precision() -> None:
    plans = 0.1 * jax.random.normal(jax.random.key(0), (2, 20, 1), jnp.bfloat16)
    with jax.enable_x64(True):
        found = checked_genotypes(plans, Growing(0.5), lambda w, _: w, 16)  # pyright: ignore[reportArgumentType]
    assert isinstance(found, jax.Array) and found.dtype == np.float64


def test_faults_are_no_agreement() -> None:
    """Gradients of worlds at fault are 0, as are their differences."""
    plans = np.zeros((2, 16, 1))
    plans[1, 4] = 3.0
    with pytest.raises(FaultError, match=r"1 of 2 worlds.*first one in control step 5"):
        diagnose(Failing(0.5), genotypes=plans)
    with pytest.raises(FaultError, match=r"sigma: got 100.0, fewer than two pairs"):
        diagnose(Failing(0.5), sigma=100.0, samples=2)


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
    (tmp_path / "file").write_text("")
    taken = ["doctor", "gradients", "hopper", *small, "--out", str(tmp_path / "file")]
    assert cli.main(taken) == cli.BAD_ARGUMENTS
    captured = capsys.readouterr()
    assert "--out" in captured.err and not captured.out  # before any work
    assert cli.main(["doctor", "gradients", "nothing"]) == cli.BAD_ARGUMENTS


class Miscounted(Growing):
    """A reward whose gradient is wrong by a factor."""

    def __init__(self, factor: float) -> None:
        super().__init__(0.5)
        self.factor = factor

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        state = super()._state(x, steps)
        still = jax.lax.stop_gradient(state.reward)
        return state.replace(reward=still + self.factor * (state.reward - still))


@pytest.mark.parametrize("factor", [0.0, 2.0])
def test_a_wrong_gradient_is_found(factor: float) -> None:
    """One of length 0, and one of the right direction and the wrong length."""
    env: Any = Miscounted(factor)
    report = diagnose_gradients(env, horizons=(1, 2), worlds=2, directions=2, samples=4)
    assert report.exact_horizon == 0
    assert "over none of these horizons" in report.verdict
    for row in report.horizons:
        assert row.cosine == pytest.approx(0.0 if factor == 0 else 1.0)
        assert row.length < 1e-9 if factor == 0 else row.length == pytest.approx(2)


@pytest.mark.parametrize("directions", [1, 3])
def test_few_directions_are_enough(directions: int) -> None:
    """One direction has a cosine of 1 or -1 at every distance."""
    env: Any = Growing(3.0)
    report = diagnose_gradients(
        env, horizons=(4, 12), worlds=4, directions=directions, samples=4
    )
    assert report.exact_horizon == 12


def first_is(action: float) -> np.ndarray:
    """Four plans of one step; the actions of the others are 0."""
    return np.array([action, 0.0, 0.0, 0.0]).reshape(4, 1, 1)


class Turned(Growing):
    """The gradient is that of the negative reward where actions are above 1."""

    def step(self, state: State, action: jax.Array) -> State:
        after = super().step(state, action)
        still = jax.lax.stop_gradient(after.reward)
        sign = jnp.where(action[0] > 1, -1.0, 1.0)
        return after.replace(reward=still + sign * (after.reward - still))


def test_the_worst_world_decides() -> None:
    env: Any = Turned(0.5)
    report = diagnose_gradients(env, horizons=(1,), genotypes=first_is(2.0), samples=4)
    row = report.horizons[0]
    assert row.cosine > 0.99 and row.worst_cosine < -0.99


class Fragile(Growing):
    """At fault where actions are above a million, and not nearly ten millions."""

    def step(self, state: State, action: jax.Array) -> State:
        fault = (action[0] > 1e6) & (jnp.abs(action[0] - 1e7) > 0.1)
        after = super().step(state, action)
        return after.replace(info={"fault": fault.astype(jnp.int32)})

    def reset(self, rng: jax.Array) -> State:
        return super().reset(rng).replace(info={"fault": jnp.zeros((), jnp.int32)})


def test_one_world_without_sound_samples_is_told() -> None:
    env: Any = Fragile(0.5)
    options: Any = {"genotypes": first_is(1e7), "sigma": 100.0, "samples": 4}
    with pytest.raises(FaultError, match=r"sigma: got 100.0, fewer than two pairs"):
        diagnose_gradients(env, horizons=(1,), **options)


class Rounded(Growing):
    """A reward that does not change, except for its last digits."""

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        reward = jnp.sin(x[0]) ** 2 + jnp.cos(x[0]) ** 2
        return super()._state(x, steps).replace(reward=reward)


class Flat(Growing):
    """A reward whose slope is smaller than what differences can see."""

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        return super()._state(x, steps).replace(reward=jnp.tanh(20 + x[0]))


@pytest.mark.parametrize("kind", [Rounded, Flat])
def test_rounding_is_no_difference(kind: Any) -> None:
    report = diagnose_gradients(kind(0.5), horizons=(1, 4), worlds=2, samples=4)
    assert report.exact_horizon == 4


class Still(Growing):
    """A reward that does not change."""

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        return super()._state(x, steps).replace(reward=jnp.ones(()))


def test_a_gradient_of_nothing_is_of_no_use(tmp_path: Path) -> None:
    env: Any = Still(0.5)
    report = diagnose_gradients(env, horizons=(1, 2), worlds=2, samples=4)
    assert report.exact_horizon == 2 and report.useful_horizon == 0
    assert report.verdict.startswith("The gradient is 0 up to 2 control steps (0.2 s)")
    report.write(tmp_path)


class Invented(Growing):
    """A reward that does not change, with a gradient."""

    def _state(self, x: jax.Array, steps: jax.Array) -> State:
        reward = 1 + x[0] - jax.lax.stop_gradient(x[0])
        return super()._state(x, steps).replace(reward=reward)


def test_a_gradient_where_nothing_changes_is_wrong() -> None:
    env: Any = Invented(0.5)
    report = diagnose_gradients(env, horizons=(1, 2), worlds=2, samples=4)
    assert report.exact_horizon == 0 and np.isinf(report.horizons[0].length)


def report_of(*changes: dict[str, Any]) -> GradientReport:
    """A report whose numbers are all 1, except for these of its horizons."""
    ones: Any = dict.fromkeys((f.name for f in dataclasses.fields(HorizonRow)), 1.0)
    rows = tuple(HorizonRow(**{**ones, **change}) for change in changes)
    return GradientReport("growing", 0.1, True, 0.1, rows, ())


def test_a_horizon_ends_at_the_first_bad_row() -> None:
    bad = {"steps": 2, "worst_cosine": 0.0, "order": 0.0}
    report = report_of({"steps": 1}, bad, {"steps": 4})
    assert report.exact_horizon == report.useful_horizon == 1


def test_most_episodes_are_more_than_half() -> None:
    few, most = (
        report_of({"steps": 1}, {"steps": 2, "alive": alive}) for alive in (0.75, 0.25)
    )
    assert "Most episodes end" not in few.verdict
    assert "Most episodes end before step 2" in most.verdict


def test_an_environment_without_precision(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "ENVIRONMENTS", dict(tasks.ENVIRONMENTS))
    newton_qd.register("single_only", lambda: newton_qd.create("pointmaze").unwrapped)
    assert cli.main(["doctor", "gradients", "single_only"]) == cli.BAD_ARGUMENTS
    assert "error: dtype: got 'float64', which is not" in capsys.readouterr().err


def test_a_fault_after_the_end_is_none() -> None:
    class Breaking(line_env.Line):
        def step(self, state: State, action: jax.Array, params: Any = None) -> State:
            after = super().step(state, action, params)
            fault = (after.pipeline_state > 3).astype(np.int32)
            return after.replace(info={**after.info, "fault": fault})

    for end, long in ((1.5, False), (9.0, True)):
        subject = Subject(Breaking(end), None, 4, line_env.KEY)
        rewards, (alive, _, faults) = subject.rewards(jnp.ones((4, 1)))
        assert alive.tolist() == [True, True, long, long]
        assert faults.tolist() == [False, False, long, long]
        assert ((rewards > 0) == alive).all()
