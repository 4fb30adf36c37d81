"""Modules that QDax has dropped, after one line."""

from __future__ import annotations

import concurrent.futures
import importlib
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compat_helpers import setup
from line_env import Line

import newton_qd
import newton_qd.compat
import newton_qd.compat.brax_envs
from newton_qd.compat import finder
from newton_qd.compat.contents import BRAX_V1, CONTENTS
from newton_qd.compat.scoring import evaluate
from newton_qd.envs.state import State
from newton_qd.errors import MissingExtra

TESTS = Path(__file__).resolve().parent

pytestmark = pytest.mark.usefixtures("modules_of_qdax")


# --- modules ---------------------------------------------------------------


@pytest.mark.parametrize("name", CONTENTS)
def test_modules_hold_what_they_say(name: str) -> None:
    module = importlib.import_module(name)
    assert sys.modules[name] is module
    for home, names in CONTENTS[name].items():
        for attribute in names:
            expected = getattr(importlib.import_module(home), attribute)
            assert getattr(module, attribute) is expected


@pytest.mark.parametrize("name", BRAX_V1)
def test_brax_v1_is_there_for_scripts_of_qdax(name: str) -> None:
    """New releases of brax have lost it; one that is installed stays."""
    if BRAX_V1.keys() - finder._FINDER.contents.keys():
        pytest.skip("brax v1 is installed")
    module = importlib.import_module(name)
    for home, names in BRAX_V1[name].items():
        for attribute in names:
            expected = getattr(importlib.import_module(home), attribute)
            assert getattr(module, attribute) is expected


def test_environments_are_those_of_brax_v1() -> None:
    old: Any = importlib.import_module("brax.v1.envs")
    assert isinstance(newton_qd.create("pointmaze"), old.Env)
    assert issubclass(newton_qd.wrappers.EpisodeWrapper, old.Wrapper)
    jp: Any = importlib.import_module("brax.v1.jumpy")
    assert jp.random_uniform(jp.random_prngkey(seed=0), (2,), 1.0, 2.0).min() >= 1


def test_notebooks_draw_with_our_pages(tmp_path: Path) -> None:
    html: Any = importlib.import_module("brax.v1.io.html")
    env: Any = newton_qd.create("hopper_uni", brax_views=True)
    qps = [jax.jit(env.reset)(jax.random.key(0)).qp] * 3
    text = html.render(env.sys, qps)
    assert text.startswith("<iframe") and 'height="480"' in text
    html.save_html(tmp_path / "new" / "page.html", env.sys, qps, make_dir=True)
    page = (tmp_path / "new" / "page.html").read_text(encoding="utf-8")
    assert "<title>hopper - newton_qd</title>" in page
    with pytest.raises(TypeError, match=r"sys: got 3; allowed: env.sys of "):
        html.render(3, qps)
    with pytest.raises(ValueError, match=r"qps: got \[\]; allowed: state.qp of at le"):
        html.render(env.sys, [])


def test_voronoi_plots_of_qdax_run_with_numpy_2() -> None:
    plotting: Any = importlib.import_module("qdax.utils.plotting")
    centroids = np.random.default_rng(0).uniform(size=(5, 2))
    regions, _ = plotting.get_voronoi_finite_polygons_2d(centroids)
    assert len(regions) == 5
    mended = plotting.get_voronoi_finite_polygons_2d
    newton_qd.compat.uninstall()
    newton_qd.compat.install()
    assert plotting.get_voronoi_finite_polygons_2d is mended  # not once more


def test_pareto_plots_of_qdax_run_with_new_matplotlib() -> None:
    plotting: Any = importlib.import_module("qdax.utils.plotting")
    assert plotting.cm.get_cmap("viridis", 3).N == 3


def test_submodules_are_attributes_of_their_packages() -> None:
    newton_qd.compat.uninstall()
    newton_qd.compat.install()
    home: Any = importlib.import_module("qdax.tasks.brax.v1")
    assert home.envs.pointmaze.PointMaze is newton_qd.envs.pointmaze.PointMaze
    assert home.wrappers.base_wrappers.QDEnv is newton_qd.envs.base.QDEnv
    old: Any = importlib.import_module("qdax.environments")
    assert old.wrappers.ClipRewardWrapper is newton_qd.wrappers.ClipRewardWrapper


def test_a_search_leaves_the_imports_of_others_alone() -> None:
    newton_qd.compat.uninstall()
    with newton_qd.compat.installed():
        importlib.import_module("qdax.tasks.brax.v1")
        with newton_qd.compat.installed():  # inside, nothing is undone
            pass
        assert finder._FINDER in sys.meta_path
    assert finder._FINDER not in sys.meta_path
    assert not set(CONTENTS) & set(sys.modules)
    with (
        newton_qd.compat.installed(),
        concurrent.futures.ThreadPoolExecutor(4) as pool,
    ):

        def borrow(_: int) -> bool:
            with newton_qd.compat.installed():
                importlib.import_module("qdax.environments")
            return finder._FINDER in sys.meta_path

        assert all(pool.map(borrow, range(20)))  # they wait for nobody
    assert finder._FINDER not in sys.meta_path and finder._FINDER.users == 0
    with newton_qd.compat.installed():
        newton_qd.compat.install()  # of a user, who wants it to stay
    assert finder._FINDER in sys.meta_path


def test_functions_of_jumpy() -> None:
    jp: Any = importlib.import_module("brax.v1.jumpy")
    x = jnp.array([[3.0, 4.0], [0.0, 0.0]])
    assert (
        jp.norm(x) == 5
        and jp.norm(x, 1).tolist() == [5, 0]
        and jp.safe_norm(x, axis=1).tolist() == [5, 0]
    )
    slope = jax.jit(jax.grad(lambda x: jp.safe_norm(x, axis=1).sum()))(x)
    np.testing.assert_allclose(slope, [[0.6, 0.8], [0, 0]], rtol=1e-6)
    assert jp.safe_norm(x[1]) == 0
    assert jp.take({"x": x}, [1, 0])["x"].tolist() == [[0, 0], [3, 4]]
    assert jp.take(x, 5).tolist() == [0, 0]  # as the last: JAX would give NaN
    assert jp.random_uniform(jp.random_prngkey(0), (9,), -1.0, 0.0).max() <= 0
    uniform = jax.jit(lambda low: jp.random_uniform(jp.random_prngkey(0), (9,), low))
    assert 0.5 <= uniform(0.5).min() < uniform(0.5).max() < 1
    for include in ([True, False], (True, False)):
        summed = jp.vmap(lambda a, b: (a * b).sum(), include)(x, x[0])
        assert summed.tolist() == [25, 0]
    assert jp.vmap(jnp.dot)(x, x).tolist() == [25, 0]
    assert jp.index_update(x, (1, 0), 7).tolist() == [[3, 4], [7, 0]]
    assert 2 <= jp.randint(jp.random_prngkey(0), low=2, high=4) < 4
    assert jp.expand_dims(x).shape == (1, 2, 2)
    assert jp.clip(x, a_min=1, a_max=3).tolist() == [[3, 3], [1, 1]]
    assert jp.choice(rng=jp.random_prngkey(0), a=5, shape=(2,)).shape == (2,)
    for name, sign in (("arccos", -1), ("arcsin", 1)):
        safe, plain = getattr(jp, f"safe_{name}"), getattr(jnp, name)
        assert safe(0.5) == plain(0.5) and safe(-1.0) == plain(-1.0)
        slope = jax.grad(safe)(0.5)
        np.testing.assert_allclose(slope, jax.grad(plain)(0.5), rtol=1e-6)
        assert np.isfinite(jax.grad(safe)(1.0)) and sign * jax.grad(safe)(1.0) > 1000


def test_jumpy_has_the_names_of_brax_v1() -> None:
    """All functions and constants of ``brax/v1/jumpy.py``."""
    jp: Any = importlib.import_module("brax.v1.jumpy")
    names = """abs all amax amin any arange arccos arcsin arctan2 arctanh argmax argmin
        array atleast_1d atleast_2d atleast_3d choice clip concatenate cond cos cross
        diag dot exp expand_dims eye float32 floor fori_loop index_update inf int32 inv
        logical_and logical_not logical_or matmul maximum mean meshgrid minimum multiply
        ndarray norm ones ones_like outer pi randint random_prngkey random_split
        random_uniform repeat reshape roll safe_arccos safe_arcsin safe_norm scan
        segment_sum sign sin sqrt square stack sum take tanh tile top_k tree_map var
        vmap where while_loop zeros zeros_like"""
    assert not [name for name in names.split() if not hasattr(jp, name)]


@pytest.mark.parametrize("name", ["ant", "ur5e"])
def test_flax_saves_the_leaves_of_a_state(name: str) -> None:
    from flax import serialization

    env = newton_qd.compat.brax_envs.create(name, episode_length=5)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    state, pattern = reset(jax.random.key(0)), reset(jax.random.key(1))
    with pytest.raises(TypeError, match="State"):  # as the page for QDax says
        serialization.to_bytes(state)
    content = serialization.to_bytes(jax.tree.leaves(state))
    leaves: Any = serialization.from_bytes(jax.tree.leaves(pattern), content)
    read = jax.tree.unflatten(jax.tree.structure(pattern), leaves)
    for found, known in zip(leaves, jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(found, known)
        assert found.dtype == known.dtype
    action = jnp.zeros(env.action_size)
    np.testing.assert_array_equal(step(read, action).obs, step(state, action).obs)


def test_installing_is_silent() -> None:
    newton_qd.compat.uninstall()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        newton_qd.compat.install()
    assert finder._FINDER in sys.meta_path


def test_installing_twice_is_installing_once() -> None:
    newton_qd.compat.install()
    assert sum(found is finder._FINDER for found in sys.meta_path) == 1
    first: Any = importlib.import_module("qdax.tasks.brax.v1")
    env = first.create("pointmaze", legacy_spring=True)
    assert isinstance(env, first.QDEnv) or isinstance(env.unwrapped, first.QDEnv)
    assert first.create_fn("pointmaze", episode_length=7)().episode_length == 7
    with pytest.raises(ValueError, match="legacy_spring: got False; allowed: True"):
        first.create("ant_uni", legacy_spring=False)
    with pytest.raises(NotImplementedError, match="does not exist"):
        first.create("no_such_env")
    newton_qd.compat.uninstall()
    newton_qd.compat.uninstall()
    assert finder._FINDER not in sys.meta_path
    assert not set(CONTENTS) & set(sys.modules)
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("qdax.environments")


def test_what_cannot_work_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    newton_qd.compat.uninstall()
    with monkeypatch.context() as patch:
        patch.setattr(finder, "find_spec", lambda name: None)
        with pytest.raises(MissingExtra, match=r"pip install 'newton_qd\[qd\]'"):
            newton_qd.compat.install()
    with monkeypatch.context() as patch:
        patch.setattr("importlib.metadata.version", lambda name: "0.4.1")
        with pytest.raises(ImportError, match=r"qdax 0\.4\.1 is installed.*0\.5\.0"):
            newton_qd.compat.install()
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "qdax.tasks.brax.v1", finder)
        with pytest.raises(ImportError, match=r"qdax\.tasks\.brax\.v1 is imported alr"):
            newton_qd.compat.install()
    assert finder._FINDER not in sys.meta_path


@pytest.mark.slow
def test_every_module_of_qdax_can_be_imported() -> None:
    code = (
        "import importlib, pkgutil\n"
        "import newton_qd.compat\n"
        "newton_qd.compat.install()\n"
        "import qdax\n"
        "for module in pkgutil.walk_packages(qdax.__path__, 'qdax.'):\n"
        "    importlib.import_module(module.name)\n"
        "import qdax.baselines.dads_smerl\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=TESTS,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr


# --- scoring functions -----------------------------------------------------


@pytest.mark.slow
def test_a_policy_scores_the_same_in_every_batch() -> None:
    task = setup("pointmaze")
    fitnesses, descriptors, extra = task.score(task.params, jax.random.key(2))
    assert extra["transitions"].obs.shape == (16, 24, 2)
    for count in (1, 5):
        few = jax.tree.map(lambda x, n=count: x[:n], task.params)
        again = task.score(few, jax.random.key(9))
        np.testing.assert_array_equal(again[0], fitnesses[:count])
        np.testing.assert_array_equal(again[1], descriptors[:count])


class Steps(NamedTuple):
    rewards: jax.Array
    dones: jax.Array
    obs: jax.Array


def test_no_fault_pays_in_a_scoring_function() -> None:
    """An action of 1e4 ended the episode with the return 0; the others are below."""
    env = newton_qd.create("pointmaze", episode_length=5)

    def play(state: Any, actions: jax.Array) -> tuple:
        after = env.step(state, actions)
        names = {"rewards": after.reward, "dones": after.done, "obs": state.obs}
        return after, actions, Steps(**names)

    class Steps(NamedTuple):
        rewards: jax.Array
        dones: jax.Array
        obs: jax.Array

    @jax.jit
    def scores(keys: jax.Array, actions: jax.Array) -> Any:
        states = jax.vmap(env.reset)(keys)
        described: Any = lambda data, _: data[2][:, 0]  # noqa: E731
        return evaluate(play, (states, actions), (0, 0), 5, described)

    actions = np.array([[0.1, 0.1], [np.nan, 0.0]], np.float32)
    found = scores(jax.random.split(jax.random.key(0), 2), actions)
    assert np.isfinite(found[0][0]) and found[0][1] == -np.inf


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        (
            "pointmaze",
            {"batch_size": 3},
            r"env: got a batch of shape \(3,\) for each individual; allowed: one world",
        ),
        (
            "inverted_pendulum",
            {},
            "env: got an environment with no state descriptor; allowed: QD tasks",
        ),
    ],
)
def test_environments_that_cannot_be_scored(
    name: str, options: dict[str, Any], text: str
) -> None:
    module: Any = importlib.import_module("newton_qd.compat.env_creators")
    env = newton_qd.create(name, episode_length=2, **options)
    policy = SimpleNamespace(apply=lambda _, obs: obs[..., : env.action_size])
    described: Any = lambda data, _: data.obs[:, 0]  # noqa: E731
    score = module.create_brax_scoring_fn(
        env, policy, described, jax.random.key(0), episode_length=2
    )
    with pytest.raises(ValueError, match=text):
        score(jnp.zeros((2, 1)), jax.random.key(1))


def test_policies_have_random_numbers_of_their_own() -> None:
    def play(state: Any, policy: jax.Array, key: jax.Array) -> tuple:
        key, own = jax.random.split(key)
        steps = Steps(jax.random.uniform(own), jnp.zeros(()), state.obs)
        return state, policy, key, steps

    module: Any = importlib.import_module("newton_qd.compat.env_creators")
    described: Any = lambda data, _: data.obs[:, 0]  # noqa: E731
    fitnesses = jax.jit(
        lambda policies, key: module.scoring_function_brax_envs(
            policies, key, 2, Line().reset, play, described
        )[0]
    )(np.zeros((3, 1), np.float32), jax.random.key(0))
    assert len(set(fitnesses.tolist())) == 3


def test_only_one_start_for_all_takes_a_key() -> None:
    module: Any = importlib.import_module("newton_qd.compat.brax_envs")
    described: Any = lambda data, _: data.state_desc[:, 0]  # noqa: E731
    key = jax.random.key(0)
    for one_start in (True, False):
        left = module.create_brax_scoring_fn(
            Line(), None, described, key, deterministic=one_start
        )[1]
        assert bool(jnp.all(left == key)) != one_start


def test_what_comes_after_the_end_costs_nothing() -> None:
    """Neither a fault nor a reward that is no number."""
    zero = jnp.zeros(())
    start = State(jnp.zeros((), jnp.int32), zero[None], zero, zero, {}, {})
    start = start.replace(info={"fault": jnp.zeros((), jnp.int32)})

    def play(state: Any, faults: jax.Array) -> tuple:
        step = state.pipeline_state
        after = state.replace(pipeline_state=step + 1, info={"fault": faults[step]})
        done = (step == 2).astype(jnp.float32)
        reward = jnp.where(step > 2, jnp.nan, jnp.float32(1))
        return after, faults, Steps(reward, done, state.obs)

    faults = jnp.array([[0, 0, 0, 1], [0, 1, 0, 0]])
    described: Any = lambda data, _: data.obs[:, 0]  # noqa: E731
    found = jax.jit(
        lambda start, faults: evaluate(play, (start, faults), (None, 0), 4, described)
    )(start, faults)
    assert found[0].tolist() == [3.0, -np.inf]


def test_mask_begins_after_the_end() -> None:
    scoring: Any = importlib.import_module("newton_qd.compat.scoring")

    class Data(NamedTuple):
        dones: jax.Array

    dones = jnp.array([[0, 0, 0, 0], [0, 1, 0, 0], [1, 0, 1, 0]], jnp.float32)
    expected = [[0, 0, 0, 0], [0, 0, 1, 1], [0, 1, 1, 1]]
    np.testing.assert_array_equal(
        scoring.get_mask_from_transitions(Data(dones)), expected
    )


@pytest.mark.slow
def test_functions_of_older_scripts_have_the_signatures_of_their_time() -> None:
    environments: Any = importlib.import_module("qdax.environments")
    tasks: Any = importlib.import_module("qdax.tasks.brax_envs")
    key = jax.random.PRNGKey(0)
    env, policy, score, key = tasks.create_default_brax_task_components(
        "pointmaze", key, episode_length=24, mlp_policy_hidden_layer_sizes=(8,)
    )
    params = setup("pointmaze").params
    fitnesses, descriptors, extra, _ = score(params, key)
    states = jax.vmap(env.reset, in_axes=None, axis_size=16)(key)
    play_step = tasks.make_policy_network_play_step_fn_brax(env, policy)
    common = {
        "episode_length": 24,
        "behavior_descriptor_extractor": environments.behavior_descriptor_extractor[
            "pointmaze"
        ],
    }
    again = tasks.scoring_function_brax_envs(
        params, key, init_states=states, play_step_fn=play_step, **common
    )
    assert [x.shape for x in again[:2]] == [fitnesses.shape, descriptors.shape]

    def play_step_dc(state: Any, desc: Any, params: Any, key: Any) -> Any:
        state, params, key, transition = play_step(state, params, key)
        return state, desc, params, key, transition

    told = tasks.scoring_actor_dc_function_brax_envs(
        params, descriptors, key, states, play_step_actor_dc_fn=play_step_dc, **common
    )
    np.testing.assert_array_equal(told[0], again[0])
    reset = tasks.reset_based_scoring_actor_dc_function_brax_envs(
        params,
        descriptors,
        key,
        play_reset_fn=env.reset,
        play_step_actor_dc_fn=play_step_dc,
        **common,
    )
    assert reset[0].shape == fitnesses.shape
    observe = tasks.get_aurora_scoring_fn(score, lambda data: data.obs[:, -1])
    _, none, extra, _ = observe(params, key)
    assert none is None and extra["last_valid_observations"].shape == (16, 2)
