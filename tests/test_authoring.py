"""Environments of one's own: the page that shows how, and what the methods may do."""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
import newton_qd.authoring as nq
from newton_qd import tasks
from newton_qd.physics.system import PhysicsState
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.scoring.task import make_task

PAGE = Path(__file__).resolve().parents[1] / "docs" / "own_environment.md"


def blocks(language: str) -> list[str]:
    """Code blocks of the page in one language."""
    text = PAGE.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.M | re.S)


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[dict[str, Any]]:
    """What the page's two files define, in an empty folder."""
    monkeypatch.setattr(tasks, "ENVIRONMENTS", dict(tasks.ENVIRONMENTS))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "crawler.urdf").write_text(blocks("xml")[0], encoding="utf-8")
    names: dict[str, Any] = {"__name__": "crawler"}
    exec(compile(blocks("python")[0], "crawler.py", "exec"), names)
    yield names


def test_the_page_keeps_its_promise() -> None:
    """Twenty lines of Python beside two imports."""
    source = blocks("python")[0]
    lines = [line for line in source.splitlines() if line.strip()]
    imports = [line for line in lines if line.startswith(("import ", "from "))]
    assert len(imports) == 2 and len(lines) - len(imports) <= 20
    used = {
        node.attr
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "nq"
    }
    assert used <= set(nq.__all__)


def test_the_page_runs(page: dict[str, Any]) -> None:
    env = page["env"]
    assert env.observation_layout == (
        ("arm angles [rad]", 2),
        ("velocities [m/s, rad/s]", 8),
    )
    start = jax.jit(env.reset)(jax.random.key(0))

    def body(state: Any, action: jax.Array) -> tuple[Any, Any]:
        following = env.step(state, action)
        return following, (state.pipeline_state.q, following)

    def rollout(actions: jax.Array) -> tuple[jax.Array, Any]:
        last, seen = jax.lax.scan(body, start, actions)
        return last.reward, seen

    actions = jax.random.uniform(jax.random.key(1), (6, 2), minval=-1.0)
    run = jax.jit(jax.value_and_grad(rollout, has_aux=True))
    (reward, (before, after)), gradient = run(actions)
    newton_qd.check(jax.tree.map(lambda leaf: leaf[-1], after))
    velocity = (after.pipeline_state.q[:, 0] - before[:, 0]) / env.dt
    np.testing.assert_allclose(after.metrics["velocity [m/s]"], velocity, rtol=1e-5)
    cost = 0.1 * np.sum(np.square(actions), axis=1)
    np.testing.assert_allclose(after.reward, velocity - cost, rtol=1e-5, atol=1e-6)
    assert reward == after.reward[-1] and after.done.dtype == np.float32
    angles = after.pipeline_state.q[:, 7:]
    assert np.array_equal(after.info["state_descriptor"], angles)
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0


def test_the_name_is_in_the_tables(page: dict[str, Any]) -> None:
    env = page["env"]
    low, high = env.state_descriptor_limits
    assert low.tolist() == [-0.5, -0.5] and high.tolist() == [1.0, 1.0]
    assert env.state_descriptor_name == "ArmAngles"
    extract = newton_qd.tables.descriptor_extractor["crawler"]
    assert extract is nq.get_mean_state_descriptor
    assert newton_qd.tables.reward_offset["crawler"] == 2.0
    assert newton_qd.tables.COG_NAMES["crawler"] == "body"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_page_evolves(page: dict[str, Any], tmp_path: Path) -> None:
    del page  # the name is registered
    pytest.importorskip("qdax")
    exec(compile(blocks("python")[1], "evolve.py", "exec"), {})
    assert (tmp_path / "results" / "crawler" / "archive.npz").is_file()


def test_joints_of_a_robot(page: dict[str, Any]) -> None:
    env = page["Crawler"](page["ROBOT"])
    assert env.joint("left") == (slice(7, 8), slice(6, 7))
    assert env.joint("right") == (slice(8, 9), slice(7, 8))
    with pytest.raises(
        ValueError, match=r"name: got 'up', .* no joint of crawler; .*left"
    ):
        env.joint("up")
    seen = jax.jit(lambda: env.kinematics(env.fixed_state().pipeline_state))()
    assert seen.position.shape == (3, 3)


class Still(nq.PhysicsEnv):
    """The least that an environment says."""

    def outcome(self, before: Any, after: PhysicsState, action: Any) -> Any:
        return 1, after.q[2] > 1.0, {"height": after.q[2]}


def test_defaults_of_the_methods(page: dict[str, Any]) -> None:
    env = Still(page["ROBOT"])
    assert env.observation_size == 9 + 8
    state = jax.jit(env.reset)(jax.random.key(0))
    physics = state.pipeline_state
    assert np.array_equal(state.obs, np.concatenate([physics.q, physics.v]))
    after = jax.jit(env.step)(state, jnp.zeros(2))
    assert after.reward.dtype == after.done.dtype == np.float32 and after.reward == 1


def test_numbers_of_numpy_are_numbers(page: dict[str, Any]) -> None:
    found = np.float32(2.0), np.bool_(False), {"height": np.int32(3)}
    plain = type("Plain", (Still,), {"outcome": lambda self, *given: found})
    env = plain(page["ROBOT"])
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, jnp.zeros(env.action_size))
    assert (after.reward, after.done, after.metrics["height"]) == (2.0, 0.0, 3.0)


def test_a_control_of_another_type_is_converted(page: dict[str, Any]) -> None:
    """As what ``observe`` and ``outcome`` return."""

    class Switched(Still):
        def control(self, state: PhysicsState, action: jax.Array) -> jax.Array:
            return jnp.where(action > 0, 1, -1)

    class Plain(Still):
        def control(self, state: PhysicsState, action: jax.Array) -> jax.Array:
            return jnp.where(action > 0, 1.0, -1.0)

    found, expected = (
        kind(page["ROBOT"]).rollout(
            kind(page["ROBOT"]).reset(jax.random.key(0)), jnp.ones((2, 2))
        )
        for kind in (Switched, Plain)
    )
    np.testing.assert_array_equal(found.obs, expected.obs)


def test_kinematics_need_a_state_of_the_physics(page: dict[str, Any]) -> None:
    env = Still(page["ROBOT"])
    state: Any = env.reset(jax.random.key(0))
    with pytest.raises(TypeError, match=r"state: got .*such as state.pipeline_state"):
        env.kinematics(state)


def test_a_pose_of_ones_own(page: dict[str, Any]) -> None:
    class Turned(Still):
        def reset_pose(self, rng: jax.Array, q: jax.Array) -> jax.Array:
            return q.at[0].set(jax.random.uniform(rng, (), q.dtype, 5.0, 6.0))

    q = Turned(page["ROBOT"]).reset(jax.random.key(0)).pipeline_state.q
    assert 5.0 <= q[0] <= 6.0 and q[1] == 0.0


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ("reward", "^reward not finite: world 1; no fault, so not frozen$"),
        ("obs", "^obs not finite: world 1; no fault, so not frozen$"),
        ("state_descriptor", "^state descriptor not finite: world 1; no fault"),
    ],
)
def test_check_names_what_is_not_finite(part: str, words: str) -> None:
    fields = {"obs": jnp.zeros((3, 2)), "reward": jnp.zeros(3)}
    info = {"fault": jnp.zeros(3, int), "state_descriptor": jnp.zeros((3, 2))}
    held = info if part in info else fields
    held[part] = held[part].at[1].set(jnp.nan)
    state = nq.State(
        pipeline_state=None, done=jnp.zeros(3), metrics={}, info=info, **fields
    )
    with pytest.raises(newton_qd.FaultError, match=words):
        nq.check(state)
    info["fault"] = jnp.array([1, 1, 0])
    with pytest.raises(
        newton_qd.FaultError, match=r"^at fault: world 0, world 1; f"
    ) as e:
        nq.check(state)
    assert "no fault" not in str(e.value)


@pytest.mark.parametrize(
    ("method", "returned", "error", "message"),
    [
        (
            "observe",
            {},
            TypeError,
            r"Bad.observe: got \{\}; allowed: a dictionary",
        ),
        (
            "observe",
            {"x": jnp.zeros(())},
            ValueError,
            r"'x': got shape \(\); allowed: shape \(n",
        ),
        (
            "outcome",
            jnp.zeros(()),
            TypeError,
            r"Bad.outcome: got .*; allowed: rew",
        ),
        (
            "outcome",
            (jnp.zeros(1), False, {}),
            ValueError,
            r"Bad.outcome: 'reward': got shape \(1,\); allowed: shape \(\)",
        ),
        (
            "outcome",
            (0.0, False, {"lean": jnp.zeros(2)}),
            ValueError,
            r"Bad.outcome: 'lean': got shape \(2,\); allowed: shape \(\)",
        ),
        (
            "outcome",
            (None, False, {}),
            TypeError,
            "Bad.outcome: 'reward': got None; allowed: real numbers",
        ),
        (
            "outcome",
            (0.0, False, {"lean": jnp.zeros((), complex)}),
            TypeError,
            "Bad.outcome: 'lean': got complex numbers; allowed: real numbers",
        ),
        (
            "outcome",
            (0.0, False, {"lean": 0.0, 1: 0.0}),
            TypeError,
            "Bad.outcome: the name of a metric: got 1; allowed: text",
        ),
        (
            "outcome",
            (jnp.zeros(3), False, {"reward": 0.0}),
            ValueError,
            r"Bad.outcome: 'reward': got shape \(3,\); allowed: shape \(\)",
        ),
        (
            "observe",
            {"x": jnp.zeros(2, complex)},
            TypeError,
            "Bad.observe: 'x': got complex numbers; allowed: real numbers",
        ),
    ],
)
def test_what_methods_may_return(
    method: str,
    returned: Any,
    error: type[Exception],
    message: str,
    page: dict[str, Any],
) -> None:
    bad = type("Bad", (Still,), {method: lambda self, *given: returned})
    with pytest.raises(error, match=message):
        bad(page["ROBOT"])


@pytest.mark.parametrize(
    ("method", "returned", "error", "message"),
    [
        ("control", [0.0, 0.0], TypeError, r"^Bad\.control: got a list; allowed: the"),
        ("control", jnp.zeros(3), ValueError, r"^Bad\.control: got shape \(3,\); al"),
        ("reset_pose", None, TypeError, r"^Bad\.reset_pose: got a NoneType; allowed"),
        ("reset_pose", jnp.zeros(2), ValueError, r"^Bad\.reset_pose: .*shape \(9,\)"),
        ("describe", jnp.zeros(3), ValueError, r"^Bad\.describe: .*allowed: shape \(2"),
        ("observe", {"x": [1.0]}, TypeError, r"^Bad\.observe: 'x': got a list; all"),
    ],
)
def test_create_checks_the_methods(
    method: str,
    returned: Any,
    error: type[Exception],
    message: str,
    page: dict[str, Any],
) -> None:
    own = {"base": Still, "descriptor": page["ArmAngles"]}
    part = "descriptor" if method == "describe" else "base"
    own[part] = type("Bad", (own[part],), {method: lambda self, *given: returned})
    nq.register("mine", robot=page["ROBOT"], **own)
    with pytest.raises(error, match=message):
        nq.create("mine")


def test_what_register_and_evolve_need(page: dict[str, Any]) -> None:
    robot = page["ROBOT"]
    nq.register("any_robot", Still)
    with pytest.raises(TypeError, match="robot: got None, and Still needs a robot; a"):
        nq.create("any_robot")
    assert nq.create("any_robot", robot=robot).unwrapped.name == robot.name
    nq.register("mine", Still, robot=robot, descriptor=nq.XYPositionWrapper)
    with pytest.raises(ConfigError, match="so pass reward_offset to newton_qd"):
        make_task(EvolveConfig(env_name="mine"))
    wide = {"descriptor": nq.XYPositionWrapper, "reward_offset": 1.0}
    nq.register("wide", Still, robot=robot, **wide)
    with pytest.raises(ConfigError, match=r"limits of 'wide': .*minval and maxval"):
        make_task(EvolveConfig(env_name="wide"))
    nq.register("footless", Still, robot=robot, descriptor=nq.FeetContactWrapper)
    with pytest.raises(NotImplementedError, match=r"feet, so set RobotSpec\.feet$"):
        nq.create("footless")


@pytest.mark.parametrize("feet", [0, 6])
def test_long_descriptors_are_told_early(feet: int, page: dict[str, Any]) -> None:
    """Before the robot's file is read: here it does not exist."""

    class Six(page["ArmAngles"]):
        limits = (0.0,) * 6, (1.0,) * 6

    names = tuple(f"foot_{leg}" for leg in range(feet))
    robot = dataclasses.replace(page["ROBOT"], urdf="./absent.urdf", feet=names)
    descriptor = nq.FeetContactWrapper if feet else Six
    own = {"robot": robot, "descriptor": descriptor, "reward_offset": 1.0}
    nq.register("six", Still, **own)
    config = EvolveConfig(env_name="six")
    message = "grid: got None, and a descriptor of 6 components .*, such as 1024"
    with pytest.raises(ConfigError, match=message):
        make_task(config)
    with pytest.raises(FileNotFoundError):
        make_task(config.replace(centroids=1024))


def test_descriptors_have_the_length_of_their_limits(page: dict[str, Any]) -> None:
    class Wide(nq.DescriptorWrapper):
        limits = (0.0,), (1.0,)

        def describe(self, state: nq.State) -> jax.Array:
            return state.pipeline_state.q

    env = Wide(page["Crawler"](page["ROBOT"]), "crawler")
    with pytest.raises(
        ValueError, match=r"Wide.describe: .*\(9,\),.*; allowed: shape \(1,\)"
    ):
        env.reset(jax.random.key(0))


@pytest.mark.parametrize(
    "limits", [None, 3, (0.0, 1.0), ((0, 0), (1,)), (("0",), ("1",))]
)
def test_limits_of_descriptors(limits: Any, page: dict[str, Any]) -> None:
    kind = type("Bad", (page["ArmAngles"],), {"limits": limits})
    with pytest.raises(ValueError, match=r"^Bad\.limits: got .*; allowed: lowest"):
        kind(page["Crawler"](page["ROBOT"]), "crawler")


def in_windows(data: Any, mask: Any) -> jax.Array:
    """Needs a number of steps that 10 divides."""
    rows, _, length = data.state_desc.shape
    return data.state_desc.reshape(rows, -1, 10, length).mean(axis=(1, 2))


def test_an_extractor_of_another_length(page: dict[str, Any]) -> None:
    """And names of components, which pictures show."""
    first = staticmethod(lambda data, mask: data.state_desc[:, 0, :1])
    own = {"descriptor_extractor": first}
    wrong = type("Wrong", (page["ArmAngles"],), own)
    length = len(wrong.limits[0])
    robot = {"robot": page["ROBOT"], "reward_offset": 1.0}
    nq.register("wrong", page["Crawler"], descriptor=wrong, **robot)
    allowed = rf"shape for one episode: got \(1, 1\); allowed: \(1, {length}\), as"
    with pytest.raises(ConfigError, match=allowed):
        make_task(EvolveConfig(env_name="wrong"))
    own = {"descriptor_extractor": staticmethod(in_windows)}
    windows = type("Windows", (page["ArmAngles"],), own)
    nq.register("windows", page["Crawler"], descriptor=windows, **robot)
    make_task(EvolveConfig(env_name="windows", episode_length=20))
    named = type("Named", (page["ArmAngles"],), {"descriptor_labels": ("a", "b")})
    nq.register("named", page["Crawler"], descriptor=named, **robot)
    assert make_task(EvolveConfig(env_name="named")).labels == ("a", "b")
    odd = type("Odd", (page["ArmAngles"],), {"descriptor_labels": ("a",) * 7})
    with pytest.raises(ValueError, match=r"Odd.descriptor_labels: got .*; allowed: "):
        odd(page["Crawler"](page["ROBOT"]), "crawler")


def test_descriptors_around_a_batch(page: dict[str, Any]) -> None:
    inside = nq.create("crawler", batch_size=3)
    env = page["ArmAngles"](inside, "crawler")
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.info["state_descriptor"].shape == (3, 2)


def test_old_names_of_the_methods() -> None:
    with pytest.warns(
        DeprecationWarning, match="^Old._outcome is now outcome$"
    ) as seen:

        class Old(nq.Locomotion):
            def _outcome(self, before: Any, after: Any, action: Any) -> Any:
                reward, done, metrics = super()._outcome(  # pyright: ignore
                    before, after, action
                )
                return 2 * reward, done, metrics

    assert seen[0].filename == __file__
    assert Old.outcome is vars(Old)["_outcome"]
    assert vars(nq.Locomotion)["_outcome"] is nq.Locomotion.outcome


def test_everything_is_in_one_module() -> None:
    assert newton_qd.authoring is nq
    for name in nq.__all__:
        assert getattr(nq, name) is not None
