"""Descriptors of robots, and AURORA's with a model of our own and one of Flax."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
import newton_qd.gradients
from newton_qd import physics
from newton_qd.compat.env_creators import create_brax_scoring_fn
from newton_qd.extractors import (
    AuroraExtraInfo,
    AuroraExtraInfoNormalization,
    check_extractor,
    folded_sum,
    get_aurora_encoding,
    get_feet_contact_proportion,
    get_final_xy_position,
    get_mean_state_descriptor,
    reads_last,
)
from newton_qd.physics import row_calls
from newton_qd.physics.episodes import _episode_reduction


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Transitions:
    state_desc: jax.Array


class Linear:
    """Encodes (n, t, no) as a projection of the mean over time."""

    def encode(self, observations: jax.Array) -> jax.Array:
        raise AssertionError("called through apply")

    def apply(self, variables: Any, *args: Any, method: Any) -> jax.Array:
        assert method == self.encode
        return (args[0].mean(axis=1) @ variables["params"])[:, None, :]


class Written:
    """An environment that writes a state descriptor."""

    def __init__(self, name: str) -> None:
        self.state_descriptor_name = name


def test_extractors_know_what_they_need() -> None:
    """The last contact of two feet, [1, 1], was taken for a position."""
    position, contact = get_final_xy_position, get_feet_contact_proportion
    text = "descriptor_extractor: got get_final_xy_position, which reads xy_position, "
    text += "and the environment writes feet_contact; allowed: get_feet_contact_propor"
    with pytest.raises(ValueError, match=text):
        check_extractor(Written("feet_contact"), position)
    with pytest.raises(ValueError, match="allowed: get_final_xy_position, get_mean_st"):
        check_extractor(Written("xy_position"), contact)
    check_extractor(Written("feet_contact"), contact)
    for extractor in (position, contact, get_mean_state_descriptor, None, [].append):
        check_extractor(Written("ArmAngles"), extractor)
        check_extractor(object(), extractor)
    check_extractor(Written("feet_contact"), get_mean_state_descriptor)


def test_an_episode_checks_its_extractor() -> None:
    env = newton_qd.create("walker2d_uni")
    extractor = newton_qd.tables.descriptor_extractor["ant_omni"]
    with pytest.raises(ValueError, match="the environment writes feet_contact"):
        newton_qd.gradients.Episode(env, None, extractor, episode_length=2)
    with pytest.raises(ValueError, match="the environment writes feet_contact"):
        create_brax_scoring_fn(env, None, extractor, jax.random.key(0))  # pyright: ignore


# NumPy draws: every process that collects tests would compile JAX's programs for it
OBSERVATIONS = jnp.asarray(np.random.default_rng(0).normal(size=(5, 7, 3)), np.float32)
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(3, 2)), np.float32)


def extra_info() -> AuroraExtraInfoNormalization:
    mean = jnp.array([1.0, 2.0, 3.0], np.float32)
    return AuroraExtraInfoNormalization.create(WEIGHTS, mean, 2.0 * mean)


def expected() -> np.ndarray:
    mean = np.array([1.0, 2.0, 3.0])
    normalized = (np.asarray(OBSERVATIONS) - mean) / (2 * mean)
    return normalized.mean(axis=1) @ np.asarray(WEIGHTS)


def test_encoding_of_normalized_observations() -> None:
    model = Linear()
    found = get_aurora_encoding(OBSERVATIONS, extra_info(), model)
    np.testing.assert_allclose(found, expected(), rtol=1e-5, atol=1e-6)
    jitted = jax.jit(get_aurora_encoding, static_argnames="model")
    again = jitted(OBSERVATIONS, extra_info(), model=model)
    np.testing.assert_allclose(again, found, rtol=1e-6)


def test_encoding_by_a_module_of_flax() -> None:
    nn = pytest.importorskip("flax.linen")

    class Encoder(nn.Module):
        @nn.compact
        def encode(self, x: jax.Array) -> jax.Array:
            return nn.Dense(2, use_bias=False)(x.mean(axis=1))

    info = extra_info().replace(model_params={"Dense_0": {"kernel": WEIGHTS}})
    found = get_aurora_encoding(OBSERVATIONS, info, Encoder())
    np.testing.assert_allclose(found, expected(), rtol=1e-5, atol=1e-6)


def test_a_component_that_never_changes() -> None:
    # the original divides 0 by 0
    constant = OBSERVATIONS.at[..., 1].set(2.0)
    info = extra_info().replace(std_observations=jnp.array([1.0, 0.0, 1.0], np.float32))
    found = get_aurora_encoding(constant, info, Linear())
    assert np.all(np.isfinite(found))
    without = get_aurora_encoding(
        constant, info.replace(model_params=WEIGHTS.at[1].set(100.0)), Linear()
    )
    assert np.array_equal(found, without)


def test_extra_info_is_a_pytree() -> None:
    plain = AuroraExtraInfo(model_params={"w": WEIGHTS})
    doubled = jax.tree.map(lambda x: 2 * x, plain)
    assert isinstance(doubled, AuroraExtraInfo)
    assert np.array_equal(doubled.model_params["w"], 2 * WEIGHTS)
    info = extra_info()
    assert isinstance(info, AuroraExtraInfo)
    assert len(jax.tree.leaves(info)) == 3
    again = jax.jit(lambda x: x)(info)
    assert isinstance(again, AuroraExtraInfoNormalization)
    other = info.replace(mean_observations=jnp.zeros(3))
    assert other.mean_observations.tolist() == [0.0] * 3
    assert info.mean_observations.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(TypeError, match="colour"):
        info.replace(colour=1)


def test_structures_of_qdax_are_taken() -> None:
    types = pytest.importorskip("qdax.custom_types")
    ours = extra_info()
    theirs = types.AuroraExtraInfoNormalization.create(
        ours.model_params, ours.mean_observations, ours.std_observations
    )
    found = get_aurora_encoding(OBSERVATIONS, theirs, Linear())
    np.testing.assert_allclose(found, expected(), rtol=1e-5, atol=1e-6)


def test_extractors_under_jit() -> None:
    data, mask = episodes()
    several = jax.tree.map(lambda x: np.asarray(x)[None], (data, mask))
    for extract in (get_final_xy_position, get_feet_contact_proportion):
        expected = extract(data, mask)
        assert np.array_equal(jax.jit(extract)(data, mask), expected)
        swapped = jax.jit(jax.vmap(extract))(*several)
        assert np.array_equal(np.asarray(swapped)[0], expected)


def test_final_position_has_a_gradient() -> None:
    mask = jnp.array([[0, 0, 1]], np.float32)

    def first(descriptors: jax.Array) -> jax.Array:
        return get_final_xy_position(Transitions(descriptors), mask)[0, 0]

    found = jax.jit(jax.grad(first))(np.zeros((1, 3, 2), np.float32))
    assert np.asarray(found)[0].tolist() == [[0, 0], [1, 0], [0, 0]]


def division_error(device: Any) -> float:
    """Relative error of XLA's division in float32: correctly rounded on CPUs alone."""
    return 0.0 if device.platform == "cpu" else 3e-7


def test_a_foot_that_always_touches_has_proportion_one(device: Any) -> None:
    steps = 128
    mask = jnp.asarray(np.arange(steps) > np.arange(steps)[:, None], np.float32)

    def proportion(described: jax.Array) -> jax.Array:
        return get_feet_contact_proportion(Transitions(described), mask)

    touching = np.ones((steps, steps, 3), np.float32)
    found = jax.jit(proportion)(touching)
    np.testing.assert_allclose(found, 1.0, rtol=division_error(device), atol=0)


@pytest.mark.optimized
@pytest.mark.parametrize("steps", [1, 2, 7, 1000])
@pytest.mark.parametrize(
    ("extractor", "kernel"),
    [
        (get_feet_contact_proportion, physics.episode_proportion),
        (get_final_xy_position, physics.episode_final),
    ],
)
def test_kernels_reduce_as_the_extractors_do(
    extractor: Any, kernel: Any, steps: int, device: Any
) -> None:
    """Bitwise on CPUs, with their gradients; one episode in a batch and by itself."""
    rng = np.random.default_rng(steps)
    described = jnp.asarray(rng.uniform(size=(5, steps, 3)), np.float32)
    ends = rng.integers(1, steps + 1, 5)
    mask = jnp.asarray(np.arange(steps) >= ends[:, None], np.float32)
    weights = jnp.asarray(rng.normal(size=(5, 3)), np.float32)
    reduce = jax.jit(jax.vmap(kernel))

    def extract(described: jax.Array) -> jax.Array:
        return extractor(Transitions(described), mask)

    found = reduce(described, mask)
    expected = jax.jit(extract)(described)
    np.testing.assert_allclose(found, expected, rtol=division_error(device), atol=0)
    np.testing.assert_array_equal(found[3], kernel(described[3], mask[3]))
    gradients = (
        jax.jit(jax.grad(lambda x, f=function: (weights * f(x)).sum()))(described)
        for function in (extract, lambda x: reduce(x, mask))
    )
    np.testing.assert_allclose(*gradients, rtol=1e-6)


def test_kernels_refuse_what_is_no_episode() -> None:
    described = jnp.zeros((4, 2), np.float32)
    with pytest.raises(ValueError, match=r"got .*\(4, 2\), \(3,\); allowed: \(t, nd\)"):
        physics.episode_final(described, jnp.zeros(3, np.float32))
    with pytest.raises(TypeError, match=r"got .*int32; allowed: float32, float64"):
        physics.episode_proportion(jnp.zeros((4, 2), np.int32), jnp.zeros(4, np.int32))


def episodes() -> tuple[Transitions, jax.Array]:
    """Three episodes of 5 steps: whole, ended after 2 steps, ended after 1."""
    descriptors = np.arange(30, dtype=np.float32).reshape(3, 5, 2)
    mask = np.array([[0] * 5, [0, 0, 1, 1, 1], [0, 1, 1, 1, 1]], np.float32)
    return Transitions(jnp.asarray(descriptors)), jnp.asarray(mask)


def test_final_position_is_of_the_last_valid_step() -> None:
    assert get_final_xy_position(*episodes()).tolist() == [[8, 9], [12, 13], [20, 21]]


def test_feet_proportion_is_over_valid_steps() -> None:
    assert get_feet_contact_proportion(*episodes()).tolist() == [
        [4.0, 5.0],
        [11.0, 12.0],
        [20.0, 21.0],
    ]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_state_descriptors_after_the_end_do_not_count(value: float) -> None:
    """Nothing says that they are finite there: only the physics freezes a world."""
    whole, mask = episodes()
    rows = np.asarray(whole.state_desc)
    after = jnp.asarray(np.where(np.asarray(mask)[..., None] > 0, value, rows))
    for extractor in (get_feet_contact_proportion, get_final_xy_position):
        found = extractor(Transitions(after), mask)
        assert found.tolist() == extractor(whole, mask).tolist()
    reduced = jax.jit(jax.vmap(physics.episode_proportion))(after, mask)
    assert reduced.tolist() == get_feet_contact_proportion(whole, mask).tolist()
    # before the end, they do
    broken = rows.copy()
    broken[0, 4, 1] = value
    found = get_feet_contact_proportion(Transitions(jnp.asarray(broken)), mask)
    found = np.asarray(found)
    assert not np.isfinite(found[0, 1]) and np.isfinite(found[0, 0])


@pytest.mark.parametrize("steps", [1, 2, 7, 250])
def test_descriptors_do_not_depend_on_the_batch(steps: int) -> None:
    data = np.random.default_rng(0).uniform(size=(64, steps, 4)).astype(np.float32)
    mask = np.zeros((64, steps), np.float32)
    extract = jax.jit(
        lambda data, mask: get_feet_contact_proportion(Transitions(data), mask)
    )
    batch = np.asarray(extract(data, mask))
    for world in range(0, 64, 9):
        one = slice(world, world + 1)
        assert (
            np.asarray(extract(data[one], mask[one])).tobytes() == batch[one].tobytes()
        )
    np.testing.assert_allclose(batch, np.mean(data, axis=1), rtol=1e-5)


def test_the_sum_of_nothing_is_zero() -> None:
    assert folded_sum(jnp.zeros((0, 3)), 0).tolist() == [0.0] * 3


def test_descriptors_keep_float32_under_x64(x64: None) -> None:
    data, mask = episodes()
    for extractor, given in (
        (get_final_xy_position, mask),
        (get_feet_contact_proportion, mask > 0),
    ):
        assert jax.eval_shape(extractor, data, given).dtype == np.float32


@pytest.mark.parametrize("reduce", [get_final_xy_position, get_feet_contact_proportion])
def test_a_mask_has_a_number_for_each_step(reduce: Any) -> None:
    for shape in ((2, 3), (1, 4), (2,)):
        with pytest.raises(ValueError, match=r"^mask: got shape .*; allowed: \(2, 4\)"):
            reduce(Transitions(np.ones((2, 4, 2))), np.zeros(shape))  # pyright: ignore[reportArgumentType]


def test_kernels_take_what_jax_makes_of_numpy() -> None:
    rows: Any = np.arange(8.0).reshape(4, 2)  # JAX has no float64 here
    ones: Any = np.ones((4, 2))
    mask: Any = np.zeros(4)
    assert physics.episode_final(rows, mask).tolist() == [6.0, 7.0]
    assert physics.episode_proportion(ones, mask).tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match="state_desc, mask: got shapes"):
        physics.episode_proportion(ones[:, :0], mask)


def test_a_kernel_refuses_rows_of_another_precision() -> None:
    if not row_calls.native(row_calls.default_device()):
        pytest.skip("on a GPU, Warp itself checks the type")
    run = _episode_reduction("final", "float64", 4, 2, 2)
    with pytest.raises(TypeError, match=r"^row of a kernel: got .*float32; .* 8 bytes"):
        run(jnp.zeros(12, np.float32))


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int8, np.int32])
def test_proportions_of_flags(kind: type) -> None:
    """Their number does not fit into a byte."""
    flags = np.tile([1, 0, 0], 100).astype(kind)[None, :, None]
    data = Transitions(jnp.asarray(flags))
    for proportion in (get_feet_contact_proportion, get_mean_state_descriptor):
        found = jax.jit(proportion)(data, np.zeros((1, 300), np.float32))
        assert found.dtype == np.float32 and found == pytest.approx(1 / 3)


def test_which_extractors_read_the_end_alone() -> None:
    """An own one too: it tells actors what to follow."""

    @jax.jit
    def final(rows: jax.Array, mask: jax.Array) -> jax.Array:
        return get_final_xy_position(Transitions(rows), mask)

    def last(data: Any, mask: Any) -> jax.Array:
        return final(data.state_desc, mask)

    def highest(data: Any, mask: Any) -> jax.Array:
        return jnp.max(jnp.where(mask[..., None] == 0, data.state_desc, 0), axis=1)

    def sides(data: Any, mask: Any) -> jax.Array:
        return jnp.sign(jnp.sum(data.state_desc, axis=1))

    def way(data: Any, mask: Any) -> jax.Array:
        return last(data, mask) - data.state_desc[:, 0]

    def windows(data: Any, mask: Any) -> jax.Array:
        return data.state_desc.reshape(len(mask), -1, 10, 2).mean(axis=(1, 2))

    def two_sides(data: Any, mask: Any) -> jax.Array:
        return jax.nn.softmax(last(data, mask))

    assert reads_last(get_final_xy_position, 20, 2) and reads_last(last, 20, 3)
    assert reads_last(two_sides, 20, 2)
    for extractor in (
        get_feet_contact_proportion,
        get_mean_state_descriptor,
        highest,
        sides,
        way,
        windows,
    ):
        assert not reads_last(extractor, 20, 2)
