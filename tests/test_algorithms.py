"""The algorithms of ``evolve``: what they find, and that a stop changes nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from point_runs import SMALL, evolve_module, interrupt_after, point_task, run
from test_steady import compiled

import newton_qd.compat
from newton_qd import cli
from newton_qd.qd.algorithms import ALGORITHMS
from newton_qd.qd.algorithms.cma_me import CMAMEOptions
from newton_qd.qd.algorithms.options import read_options
from newton_qd.qd.config import ConfigError, EvolveConfig, read_config
from newton_qd.qd.emitters import GradientLineEmitter
from newton_qd.qd.run.checkpoint import (
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.task import make_task

__all__ = ["compiled"]  # a fixture

CRITIC = {
    "critic_hidden_layer_size": (8,),
    "num_critic_training_steps": 2,
    "num_pg_training_steps": 2,
    "batch_size": 16,
    "replay_buffer_size": 1024,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "me": {},
    "cma-me": {"emitters": 2},
    "pga-me": CRITIC,
    "dcrl-me": CRITIC,
    "me-es": {"num_optimizer_steps": 2, "sample_sigma": 0.1, "learning_rate": 0.1},
    "me-gradient": {},
    "me-ascent": {"climbers": 4, "climb_steps": 3},
    "me-actor-critic": {
        **{"actors": 2, "branches": 1, "copies": 4, "updates": 1, "lifetime": 3},
        **{"worlds": 2, "window": 4, "batches": 2, "critic": (8,)},
        "episodes_after": 2,
    },
    "ascii-me": {"epochs": 2},
    "ascii-me-exact": {"epochs": 2, "branches": 4, "window": 4},
    "me-conditioned": {"worlds": 2, "window": 4, "batches": 2, "critic": (8,)},
    "omg-mega": {},
    "cma-mega": {"points": 2},
    "cma-maega": {"points": 2, "adam": 0.05},
    "cma-maega-actor-critic": {
        **{"points": 2, "probes": 3, "walks": 1, "worlds": 2, "window": 4},
        **{"batches": 2, "critic": (8,)},
    },
}


def count_after_generations(
    patch: pytest.MonkeyPatch, compiled: list[str]
) -> list[int]:
    """List of the number of compiled programs after each generation to come."""
    counts: list[int] = []
    advance = Search.advance

    def advance_and_count(self: Search, state: Any) -> Any:
        state = advance(self, state)
        counts.append(len(compiled))
        return state

    patch.setattr(Search, "advance", advance_and_count)
    return counts


def test_every_algorithm_is_tested() -> None:
    assert set(OPTIONS) == {spec.name for spec in ALGORITHMS}


@pytest.mark.slow
@pytest.mark.parametrize(
    "env_name", list(dict.fromkeys(name for spec in ALGORITHMS for name in spec.tuned))
)
def test_defaults_of_an_environment_are_accepted(env_name: str) -> None:
    task = make_task(EvolveConfig(env_name=env_name))
    names = [spec.name for spec in ALGORITHMS if spec.gradients is not None]
    assert len(names) == 9
    for name in names:
        config = EvolveConfig(
            env_name=env_name,
            algorithm=name,
            batch_size=64,
            episode_length=8,
            hidden=(4,),
            grid=(4,) * task.descriptor_length,
        )
        assert Search(config, task).empty().metrics.shape[0] == 0, name


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("name", OPTIONS)
def test_a_stop_changes_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: list[str]
) -> None:
    config = EvolveConfig(
        env_name="pointmaze",
        iterations=6,
        batch_size=16,
        episode_length=20,
        hidden=(4,),
        grid=(8, 8),
        algorithm=name,
        reevaluations=0,
        options=OPTIONS[name],  # pyright: ignore[reportArgumentType]
    )
    common: dict[str, Any] = {"progress": False, "checkpoint_seconds": 1e9}
    monkeypatch.setattr(evolve_module, "archive_png", lambda *arguments: b"picture")
    try:
        # one search for both, which is traced once; the third run makes its own
        search = Search(config, make_task(config))
        with monkeypatch.context() as patch:
            patch.setattr(evolve_module, "Search", lambda *_: search)
            with patch.context() as first:
                counts = count_after_generations(first, compiled)
                whole = evolve(config, out=tmp_path / "whole", **common)
            interrupt_after(patch, 3)
            assert evolve(config, out=tmp_path / "parts", **common).interrupted
        evolve(config, out=tmp_path / "parts", resume=True, **common)
    finally:
        newton_qd.compat.uninstall()
    for file in ("checkpoint.bin", "archive.npz", "metrics.csv"):
        left, right = (tmp_path / run / file for run in ("whole", "parts"))
        assert left.read_bytes() == right.read_bytes(), file
    # Nothing is compiled after the first generation.
    assert counts[0] < counts[1] and counts[1:] == counts[1:2] * config.iterations
    metrics = whole.metrics
    for column in ("qd_score", "coverage", "max_fitness"):
        assert metrics[column][-1] > metrics[column][0], column
    # What is differentiated counts, too: two parents, four climbers, two solution
    # points, the episodes of two actors in two worlds each.
    more = {"me-gradient": 2, "me-actor-critic": 4, "cma-mega": 2, "cma-maega": 2}
    more |= {"me-ascent": 4}
    # two parents, each once for its actions and once for the gradient
    more |= {"ascii-me-exact": 4, "me-conditioned": 1}
    # two solution points, and the 64 control steps of their actors
    more |= {"cma-maega-actor-critic": 2 + 4}
    each = 16 + {"me-es": 1, **more}.get(name, 0)
    np.testing.assert_array_equal(np.diff(metrics["evaluations"]), each)
    assert not metrics["rejected"].any()


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
            "share: got .* holds a parent with branches = 9",
        ),
        (
            "me-gradient",
            {"shortest": 3.0},
            "shortest, longest: got .* 0 < shortest <= long",
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
            "share: got .* holds a parent with branches = 9",
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
    ],
)
def test_options_out_of_range_are_refused(
    name: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        run(SMALL.replace(algorithm=name, options=options))


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
def test_initial_weights_are_scaled() -> None:
    def norm(options: dict[str, Any]) -> float:
        config = SMALL.replace(algorithm="me-gradient", iterations=0, options=options)
        archive = run(config.replace(grid=(1, 2))).archive
        return float(np.linalg.norm(archive.genotypes[archive.filled], axis=1).max())

    assert norm({"initial_scale": 0.01}) < 0.1 < norm({})


@pytest.mark.parametrize(
    "name", ["me-gradient", pytest.param("cma-mega", marks=pytest.mark.slow)]
)
def test_faulty_individuals_are_counted(name: str) -> None:
    """``PointEnv`` is faulty far right; gradients do not lead out of the archive."""
    config = SMALL.replace(
        algorithm=name,
        iterations=6,
        options={"longest": 9.0}
        if name == "me-gradient"
        else {"points": 2, "sigma_g": 2.0},
    )
    result = run(config)
    assert result.metrics["rejected"].sum() > 0
    archive = result.archive
    assert np.isfinite(archive.genotypes).all()
    assert np.isfinite(archive.fitnesses[archive.filled]).all()


def test_lost_gradients_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    emit = GradientLineEmitter.emit

    def lossy(self: Any, *given: Any) -> Any:
        offspring, told = emit(self, *given)
        return offspring, {"overflowed": ~told["overflowed"]}

    monkeypatch.setattr(GradientLineEmitter, "emit", lossy)
    metrics = run(SMALL.replace(algorithm="me-gradient", iterations=2)).metrics
    # of two parents, in every generation but the first
    np.testing.assert_array_equal(metrics["rejected"], [0, 2, 2])


@pytest.mark.usefixtures("sigint")
@pytest.mark.slow
def test_a_checkpoint_of_another_emitter_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SMALL.replace(algorithm="cma-me", options={"emitters": 2}, iterations=2)
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        run(config, out=out)
    path = out / "checkpoint.bin"
    whole = load_checkpoint(path)
    assert whole.emitter
    longer = (np.append(whole.emitter[0], 0), *whole.emitter[1:])
    for emitter, message in (
        ((), "holds 0 arrays of the algorithm 'cma-me'"),
        (longer, r"array 0 of the algorithm 'cma-me' has shape \(\d+,\)"),
    ):
        save_checkpoint(path, type(whole)(**{**vars(whole), "emitter": emitter}))
        with pytest.raises(CheckpointError, match=message):
            run(config, out=out, resume=True)


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
