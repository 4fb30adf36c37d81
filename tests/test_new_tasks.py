"""QD tasks that the original does not have, reckoned in NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np
from control_tasks import agree, bodies, make, metrics_are, point, rolled

from newton_qd import physics
from newton_qd.physics.system import System
from newton_qd.robots import PUSHER, PUSHER_TABLE
from newton_qd.wrappers import XYPositionWrapper


def test_arm_reach() -> None:
    _, after, actions = rolled("arm_reach")
    q, v = after.pipeline_state.q, after.pipeline_state.v
    frame, twist = bodies("arm_reach", after)["body1"]
    tip = point(frame, (0.11, 0, 0))
    velocity = twist[..., :3] + np.cross(twist[..., 3:], tip - frame[..., :3])
    turns = [np.cos(q[..., :2]), np.sin(q[..., :2]), v[..., :2]]
    blocks = [*turns, tip[..., :2], velocity[..., :2]]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    effort = np.sum(actions**2, axis=-1)
    metrics_are(after, {"reward_ctrl": -effort})
    agree(after.reward, -effort)
    assert not after.done.any()
    agree(after.info["xy_position"], tip[..., :2])
    limits = np.float32(-0.21), np.float32(0.21)
    found = after.info["state_descriptor"]
    np.testing.assert_array_equal(found, np.clip(after.info["xy_position"], *limits))
    # a batch inside of the wrapper reads the same points
    wrapper = make("arm_reach")
    assert isinstance(wrapper, XYPositionWrapper)
    read = wrapper._described(after).info["xy_position"]
    np.testing.assert_allclose(read, after.info["xy_position"], atol=1e-7)


def test_pusher_uni() -> None:
    before, after, actions = rolled("pusher_uni")
    q, v = after.pipeline_state.q, after.pipeline_state.v
    (old_hand, old_pushed), (hand, pushed) = (
        [links[name][0][..., :3] for name in ("r_wrist_roll_link", "object")]
        for links in (bodies("pusher_uni", before), bodies("pusher_uni", after))
    )
    blocks = [q[..., :7], v[..., :7], hand, pushed[..., :2]]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    near = np.linalg.norm(old_pushed - old_hand, axis=-1)
    effort = np.sum(actions**2, axis=-1)
    metrics_are(after, {"reward_ctrl": -effort, "reward_near": -near})
    agree(after.reward, -0.1 * effort - 0.5 * near, 5.0)
    assert not after.done.any()
    expected = np.clip(pushed[..., :2], -1, 1)
    agree(after.info["state_descriptor"], expected)
    # where no arm pushes the object, each of ten substeps divides its velocity
    row = make("pusher_uni").system.body_names.index("object")
    alone = ~after.pipeline_state.impulse[..., row, :2].any(axis=-1)
    assert alone.mean() > 0.3
    slower = before.pipeline_state.v[..., 7:] / (1 + 0.005 * 2.0) ** 10
    agree(v[alone][:, 7:], slower[alone])


def test_the_table_is_all_that_differs_from_the_pusher() -> None:
    plain, table = (physics.load_system(robot) for robot in (PUSHER, PUSHER_TABLE))
    other = {"robot", "damping", "scene_links", "scene_frames"}
    for field in dataclasses.fields(System):
        found, expected = (getattr(one, field.name) for one in (table, plain))
        if field.name not in other and isinstance(found, np.ndarray):
            np.testing.assert_array_equal(found, expected, err_msg=field.name)
    assert table.damping.tolist() == [*plain.damping[:7].tolist(), 2.0, 2.0]
