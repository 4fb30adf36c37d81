"""The same robot in MuJoCo C, seen through the conventions of newton_qd.

MuJoCo imports the URDF file by itself. Its free joint has the linear velocity of
the root's origin in world axes, as ours, but the angular velocity in body axes, and
quaternions are (w, x, y, z); joints are matched by name. Links without mass get the
least that it takes.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from newton_qd.physics.reference import rotation_matrix
from newton_qd.physics.system import JointKind, System

# MuJoCo must neither drop or merge links nor correct inertias.
_COMPILER = (
    '<mujoco><compiler discardvisual="true" fusestatic="false" '
    'balanceinertia="false" boundmass="0" boundinertia="0"/></mujoco>'
)
_ROOT_JOINT = "newton_qd_root"
# MuJoCo refuses links without mass that move; this passes [kg and kg m^2].
_LEAST = 1e-14


class MujocoReference:
    """Mass matrix, bias and acceleration of a system, computed by MuJoCo C."""

    def __init__(self, path: Path, system: System):
        self.system = system
        text = path.read_text(encoding="utf-8")
        spec = mujoco.MjSpec.from_string(
            text.replace("</robot>", _COMPILER + "</robot>")
        )
        floating = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
        if floating:
            floating[0].name = _ROOT_JOINT  # a joint of the file, of the type floating
        elif system.joint_kind[0] == JointKind.FREE:
            # MuJoCo welds the root link of a URDF file to the world.
            spec.body(system.body_names[0]).add_freejoint(name=_ROOT_JOINT)
        for name in np.array(system.body_names)[system.mass == 0]:
            body = spec.body(str(name))
            body.mass, body.inertia = _LEAST, np.full(3, _LEAST)
            body.ipos, body.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
            body.explicitinertial = True
        spec.option.gravity = [0.0, 0.0, -system.robot.gravity]
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        assert self.model.nq == system.nq and self.model.nv == system.nv
        self._match_joints()

    def _match_joints(self) -> None:
        """Finds where each of our coordinates and dofs is in MuJoCo's."""
        system, model = self.system, self.model
        self.q_index = np.zeros(system.nq, dtype=int)
        self.v_index = np.zeros(system.nv, dtype=int)
        for body, kind in enumerate(system.joint_kind):
            free = kind == JointKind.FREE
            name = _ROOT_JOINT if free else system.joint_names[body]
            joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
            assert joint >= 0, f"MuJoCo has no joint {name!r}"
            q, v = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            order = [0, 1, 2, 4, 5, 6, 3] if free else [0]
            start = system.q_start[body]
            self.q_index[start : start + len(order)] = q + np.array(order)
            dofs = np.arange(6 if free else 1)
            self.v_index[system.v_start[body] + dofs] = v + dofs

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        """Sets coordinates (nq,) and velocities (nv,) in our conventions."""
        self.data.qpos[self.q_index] = q
        # v_mujoco = turn @ v, with turn = diag(1, R^T, 1) on the free joint. Its
        # time derivative times v vanishes, as w x w = 0, so bias and acceleration
        # need no further term.
        self.turn = np.eye(self.system.nv)
        for body in np.flatnonzero(self.system.joint_kind == JointKind.FREE):
            start, dof = self.system.q_start[body], self.system.v_start[body]
            quaternion = q[start + 3 : start + 7]
            rotation = rotation_matrix(quaternion / np.linalg.norm(quaternion))
            self.turn[dof + 3 : dof + 6, dof + 3 : dof + 6] = rotation.T
        self.data.qvel[self.v_index] = self.turn @ v
        mujoco.mj_forward(self.model, self.data)

    def body_positions(self) -> np.ndarray:
        """Returns the world positions (nb, 3) of the links [m]."""
        return np.array([self.data.body(n).xpos for n in self.system.body_names])

    def body_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns linear velocity of the centre of mass and angular, (nb, 3) each."""
        linear, angular = [], []
        for name in self.system.body_names:
            body = self.model.body(name).id
            twist = np.zeros(6)
            mujoco.mj_objectVelocity(
                self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, body, twist, 0
            )
            angular.append(twist[:3])
            linear.append(twist[3:])
        return np.array(linear), np.array(angular)

    def mass_matrix(self) -> np.ndarray:
        """Returns the mass matrix (nv, nv)."""
        full = np.zeros((self.system.nv, self.system.nv))
        for dof, unit in enumerate(np.eye(self.system.nv)):
            mujoco.mj_mulM(self.model, self.data, full[dof], unit)
        full = full[np.ix_(self.v_index, self.v_index)]
        return self.turn.T @ full @ self.turn

    def bias_forces(self) -> np.ndarray:
        """Returns Coriolis, centrifugal and gravity forces (nv,)."""
        return self.turn.T @ self.data.qfrc_bias[self.v_index]

    def damping(self) -> np.ndarray:
        """Returns the joint damping (nv,)."""
        return self.model.dof_damping[self.v_index]

    def acceleration(self, force: np.ndarray) -> np.ndarray:
        """Returns the acceleration (nv,) under generalized forces (nv,).

        Joint damping and gravity act, contacts and joint limits do not.
        """
        self.data.qfrc_applied[self.v_index] = self.turn @ force
        mujoco.mj_forward(self.model, self.data)
        return self.turn.T @ self.data.qacc_smooth[self.v_index]
