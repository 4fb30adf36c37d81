"""Simulate four ants in a Newton loop, with joint forces as controls.

python examples/newton_loop.py
"""

import newton
import numpy as np

from newton_qd.assets import find_urdf
from newton_qd.physics import load_system
from newton_qd.physics.model import newton_builder
from newton_qd.physics.solver import NewtonQDSolver
from newton_qd.robots import ANT

WORLDS = 4
ant = newton_builder(str(find_urdf(ANT.urdf)), floating=True, gravity=ANT.gravity)
system = load_system(ANT)
ant.joint_q[:] = system.rest_q.tolist()
scene = newton.ModelBuilder()
scene.replicate(ant, WORLDS)
model = scene.finalize()
solver = NewtonQDSolver(model, ANT)
state, control = model.state(), model.control()
assert state.joint_q is not None and control.joint_f is not None
force = np.zeros((WORLDS, model.joint_dof_count // WORLDS), np.float32)
for step in range(500):
    force[:, 6:] = 60.0 * np.sin(0.1 * step + np.arange(WORLDS))[:, None]
    control.joint_f.assign(force.ravel())
    solver.step(state, state, control, None, dt=system.h)
print("torsos after 5 s [m]:", state.joint_q.numpy().reshape(WORLDS, -1)[:, :3])
