"""Options of the algorithms: what is refused, and how they are written."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import pytest
from point_runs import SMALL, interrupt_after, point_task, run

import newton_qd.compat
from newton_qd import cli
from newton_qd.qd.algorithms.cma_me import CMAMEOptions
from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    check_smoothed,
)
from newton_qd.qd.algorithms.me_conditioned import ConditionedOptions
from newton_qd.qd.algorithms.options import read_options
from newton_qd.qd.algorithms.spec import AlgorithmSpec
from newton_qd.qd.algorithms.variation import parents_in
from newton_qd.qd.config import ConfigError, EvolveConfig, read_config
from newton_qd.qd.scoring.task import make_task


def test_what_does_not_exist_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(
        ConfigError, match=r"algorithm: got 'ga', .* not exist; allowed: me"
    ):
        run(SMALL.replace(algorithm="ga"), out=out)
    with pytest.raises(
        ConfigError, match=r"options: got 'noise', .* 'me' .*; allowed: none"
    ):
        run(SMALL.replace(options={"noise": 1}), out=out)
    cma = SMALL.replace(algorithm="cma-me", options={"sigma": 1})
    with pytest.raises(
        ConfigError, match=r"got 'sigma', .*; allowed: emitters, sigma_g"
    ):
        run(cma, out=out)
    assert not out.exists()


@pytest.mark.parametrize("probes", [0, 4])
def test_probes_are_shared_equally(probes: int) -> None:
    options = {"probes": probes, "points": 2}
    config = SMALL.replace(algorithm="cma-maega-actor-critic", options=options)
    with pytest.raises(ConfigError, match=f"probes: got {probes}, .* multiples of 3"):
        run(config)


def test_shares_of_a_batch_that_do_not_fit_are_refused() -> None:
    for options in ({"ga_batch_size": 9}, {"dcrl_batch_size": 5, "ga_batch_size": 12}):
        config = SMALL.replace(algorithm="dcrl-me", options=options)
        with pytest.raises(ConfigError, match=r"got .* add up to batch_size \(16\)"):
            run(config)
    for algorithm, name in (("pga-me", "env_batch_size"), ("me-es", "sample_number")):
        config = SMALL.replace(algorithm=algorithm, options={name: 8})
        with pytest.raises(
            ConfigError, match=rf"{name}: got 8; allowed: batch_size \(16\)"
        ):
            run(config)
    newton_qd.compat.uninstall()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "me-gradient",
            {"share": 0},
            "share: got 0.0; allowed: numbers above 0 up to 1",
        ),
        ("me-gradient", {"share": "a"}, "share: got 'a'; allowed: finite number"),
        ("me-gradient", {"branches": 1.5}, "branches: got 1.5; allowed: integers"),
        ("me-gradient", {"branches": 0}, "branches: got 0; allowed: .* from 1"),
        (
            "me-gradient",
            {"branches": 9},
            "share: got .* at least 9 / batch_size = 9 / 16, the offspring of a",
        ),
        (
            "me-gradient",
            {"shortest": 3.0},
            "longest: got 0.5; allowed: finite numbers from 3.0",
        ),
        ("me-actor-critic", {"worlds": 0}, "worlds: got 0; allowed: .* from 1"),
        (
            "me-actor-critic",
            {"discount": 1.0},
            "discount: got 1.0; allowed: numbers from 0, below 1",
        ),
        (
            "me-actor-critic",
            {"steered": 2.0},
            "steered: got 2.0; allowed: .* from 0 to 1",
        ),
        ("me-actor-critic", {}, r"copies: got \(.*, 8\); allowed: .*batch_size = 16"),
        (
            "me-conditioned",
            {"copies": 0.9, "between": 0.9},
            r"copies, between: got \(0.9, 0.9\); allowed: .* batch_size = 16",
        ),
        ("me-conditioned", {"tolerance": 0}, "tolerance: got 0.0; allowed: .*above 0"),
        ("ascii-me", {"share": 0.01}, "share: got 0.01; allowed: at least 1 / batch"),
        ("ascii-me", {"deviation": 0}, "deviation: got 0.0; allowed: .*above 0"),
        (
            "ascii-me-exact",
            {"branches": 9},
            "share: got .* at least 9 / batch_size = 9 / 16, the offspring of a",
        ),
        ("ascii-me-exact", {"slowest": 1.0}, r"rates: got \(1.0, 0.003\); allowed"),
        ("me-actor-critic", {"fitness": float("nan")}, "fitness: got nan; allowed"),
        ("omg-mega", {"sigma_g": 0.0}, "sigma_g: got 0.0; allowed: .*above 0"),
        ("omg-mega", {"window": -1}, "window: got -1; allowed: integers from 0"),
        ("omg-mega", {"samples": 1}, "samples"),
        (
            "omg-mega",
            {"smooth_width": -1},
            "options: smooth_width: got -1; allowed: .* from 0",
        ),
        ("cma-mega", {"adam": -1.0}, "adam: got -1.0; allowed: finite .* from 0"),
        ("cma-mega", {"points": 3}, "points: got 3; allowed: .*batch_size = 16"),
        (
            "cma-mega",
            {"points": 8},
            "points: got 8, .* leave 2 of batch_size = 16 each; ",
        ),
        ("cma-maega", {"learning_rate": 2.0}, "learning_rate: got 2.0; .* 0 to 1"),
        ("cma-me", {"emitters": 0}, "emitters: got 0; allowed: integers from 1"),
        ("cma-me", {"sigma_g": 0}, "sigma_g: got 0.0; allowed: .*above 0"),
        ("pga-me", {"proportion_mutation_ga": 2}, "proportion_mutation_ga: got 2.0; "),
        (
            "pga-me",
            {"critic_hidden_layer_size": 3},
            "got 3; allowed: a tuple of integers",
        ),
        ("me-es", {"adam_optimizer": "a"}, "adam_optimizer: got 'a'; allowed: true or"),
        (
            "me-es",
            {"novelty_nearest_neighbors": 0},
            "neighbors: got 0; allowed: integers",
        ),
        (
            "me-es",
            {"num_optimizer_steps": 2**31},
            "steps: got 2147483648; allowed: .* to 2147483647",
        ),
        ("me-es", {"sample_sigma": 0}, "sample_sigma: got 0.0; allowed: .*above 0"),
        (
            "me-es",
            {"use_explore": False, "use_exploit": False},
            r"use_explore, use_exploit: got \(False, False\); allowed: at least one",
        ),
        ("dcrl-me", {"lengthscale": 0}, "lengthscale: got 0.0; allowed: .*above 0"),
        ("dcrl-me", {"discount": 1.5}, "discount: got 1.5; allowed: .* up to 1"),
        ("pga-me", {"soft_tau_update": 2}, "update: got 2.0; allowed: .* up to 1"),
        *(
            (name, {"noise": 0.02}, "noise: got 0.02, .*no effect with samples = 0; ")
            for name in ("omg-mega", "cma-mega", "cma-maega")
        ),
        ("omg-mega", {"noise": 0.1, "samples": 0}, "no value, or another samples"),
        ("me-actor-critic", {"climb_window": 0}, "window: got 0, .* climbers = 0; "),
        (
            "me-actor-critic",
            {"episode_updates": 2, "climbers": 1},
            "episode_updates: got 2, .* episodes_after = 0; ",
        ),
        (
            "me-conditioned",
            {"tolerance": 0.2, "conditioned": False},
            "tolerance: got 0.2, .* conditioned = False; ",
        ),
    ],
)
def test_options_out_of_range_are_refused(
    name: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        run(SMALL.replace(algorithm=name, options=options))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"algorithm": "cma-me", "iso_sigma": 0.1}, "iso_sigma: got 0.1; .* no iso"),
        ({"algorithm": "me-es", "line_sigma": 0}, "line_sigma: got 0.0; .*0.2, the"),
        (
            {"algorithm": "omg-mega", "options": {"algebraic_tail": True}},
            "options: algebraic_tail: got True, .* no effect on 'point', without feet",
        ),
        (
            {"algorithm": "me-actor-critic", "options": {"smooth_width": 0.2}},
            "options: smooth_width: got 0.2, .*; allowed: no value, or another env",
        ),
        ({"statistic": "median"}, "statistic: got 'median'; .*'mean', .* starts = 1"),
    ],
)
def test_settings_without_effect_are_refused(
    settings: dict[str, Any], message: str
) -> None:
    """In a new run; others can be resumed, as those with such an option."""
    with pytest.raises(ConfigError, match=f"^{message}"):
        run(SMALL.replace(**settings))


def test_smooth_feet_are_an_option_of_tasks_with_feet() -> None:
    options: Any = {"smooth_width": 0.2}
    for name in ("hopper_uni", "pointmaze"):
        config = EvolveConfig(
            env_name=name, algorithm="omg-mega", options=options, episode_length=10
        )
        given, task = read_options(DifferentiableOptions, config), make_task(config)
        if name == "hopper_uni":
            check_smoothed(config, given, task)
            continue
        with pytest.raises(ConfigError, match="no effect on 'pointmaze', without feet"):
            check_smoothed(config, given, task)


@pytest.mark.slow
def test_a_run_with_an_option_without_effect_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Earlier versions began such runs, and a resume cannot change an option."""
    options = {"noise": 0.02}
    config = SMALL.replace(algorithm="omg-mega", options=options, iterations=1)
    config = config.replace(statistic="median", line_sigma=0.1)
    out = tmp_path / "new"
    with pytest.raises(ConfigError, match=r"noise: got 0.02, .* samples = 0"):
        run(config, out=out, resume=True)
    assert not out.exists()
    with monkeypatch.context() as patch:
        patch.setattr(AlgorithmSpec, "check_effect", lambda *_: None)
        run(config, out=out)
    arguments = ["evolve", "--quiet", "--resume", "--out", str(out)]
    more = [*arguments, "--iterations", "2"]
    assert cli.main(more, task_factory=point_task) == cli.OK


@pytest.mark.parametrize(("share", "size"), [(0.29, 100), (1 / 49, 49), (0.3, 128)])
def test_a_share_of_a_generation_is_rounded_down(share: float, size: int) -> None:
    """Not below a whole number that rounding errors miss."""
    config, exact = SMALL.replace(batch_size=size), Fraction(share).limit_denominator()
    assert parents_in(config, share, 1) == int(exact * size)
    copies = ConditionedOptions(copies=share, between=0.5).numbers(config)[0]
    assert copies == int(exact * size)


@pytest.mark.parametrize(
    ("options", "grid", "message"),
    [
        ({}, (2, 2), "explore_num_cell_sample: got 5; allowed: at most 4: the cells"),
        (
            {"exploit_num_cell_sample": 6},
            (4, 4),
            "exploit_num_cell_sample: got 6; allowed: at most 5: .* last_updated_size",
        ),
    ],
)
def test_parents_of_an_evolution_strategy_are_elites(
    options: dict[str, Any], grid: tuple[int, ...], message: str
) -> None:
    config = SMALL.replace(algorithm="me-es", options=options, grid=grid)
    with pytest.raises(ConfigError, match=message):
        run(config)


@pytest.mark.parametrize("name", ["cma-me", "pga-me", "me-es"])
def test_one_individual_is_too_few(name: str) -> None:
    config = SMALL.replace(algorithm=name, batch_size=1)
    with pytest.raises(ConfigError, match=f"got 1; allowed: at least 2 for '{name}'"):
        run(config)
    newton_qd.compat.uninstall()


@pytest.mark.parametrize("name", ["cma-me", "pga-me", "dcrl-me", "me-es"])
def test_algorithms_of_one_precision(name: str) -> None:
    with (
        jax.enable_x64(True),
        pytest.raises(ConfigError, match=f"'{name}', .* QDax's and mixes precisions"),
    ):
        run(SMALL.replace(algorithm=name))


def test_a_whole_number_is_a_number() -> None:
    config = SMALL.replace(algorithm="cma-me", options={"sigma_g": 1}, iso_sigma=1)
    options = read_options(CMAMEOptions, config)
    assert type(options.sigma_g) is float and options.sigma_g == 1.0
    assert type(config.iso_sigma) is float


@pytest.mark.usefixtures("sigint")
@pytest.mark.slow
def test_a_resume_may_write_a_number_in_another_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SMALL.replace(
        algorithm="cma-me", options={"emitters": 2, "sigma_g": 1}, iterations=2
    )
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        run(config, out=tmp_path)
    again = config.replace(options={"emitters": 2, "sigma_g": 1.0})
    assert not run(again, out=tmp_path, resume=True).interrupted


@pytest.mark.slow
def test_settings_from_toml(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(
        'env_name = "point"\nalgorithm = "cma-me"\nbatch_size = 16\n'
        "hidden = [4]\ngrid = [4, 4]\nepisode_length = 9\niterations = 1\n"
        "[options]\nemitters = 2\n"
    )
    config, facts = read_config(path)
    assert (
        facts == {} and config.hidden == (4,) and config.options == (("emitters", 2),)
    )
    out = tmp_path / "run"
    given = ["evolve", "--quiet", "--config", path, "--option", "sigma_g=0.25"]
    arguments = [str(part) for part in (*given, "--out", out)]
    assert cli.main(arguments, task_factory=point_task) == cli.OK
    settings = json.loads((out / "config.json").read_text())["settings"]
    assert settings["options"] == [["emitters", 2], ["sigma_g", 0.25]]
    assert read_config(out / "config.json")[0].options == (
        ("emitters", 2),
        ("sigma_g", 0.25),
    )
    path.write_text("iterations = 1")
    assert read_config(path, "anttrap")[0].env_name == "anttrap"
    with pytest.raises(ConfigError, match=r"run\.toml: env_name: got None"):
        read_config(path)
    path.write_text("\ufeffiterations = 2", encoding="utf-8")  # as on Windows
    assert read_config(path, "anttrap")[0].iterations == 2
    path.write_text("env_name = ")
    with pytest.raises(ConfigError, match=r"run\.toml is not valid TOML"):
        read_config(path)
    path.write_text('colour = "red"')
    with pytest.raises(ConfigError, match="setting: got 'colour'; allowed"):
        read_config(path)


def test_options_that_cannot_be_parsed(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("discount", "=3", "a=b c"):
        with pytest.raises(SystemExit):
            cli.main(["evolve", "ant_uni", "--option", text])
        assert "like discount=0.95" in capsys.readouterr().err
