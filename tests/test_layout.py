"""The table of what rows hold: it names all that the public classes have, in order."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import warp as wp

import newton_qd
from newton_qd import physics
from newton_qd.physics import buffers, layout
from newton_qd.physics.kernels import rows
from newton_qd.physics.layout import Layout
from newton_qd.physics.system import System
from newton_qd.robots import ANT

TABLES = (
    layout.parameters,
    layout.coordinates,
    layout.inputs,
    layout.bodies,
    layout.outputs,
    layout.dynamics,
    layout.gaps,
    layout.impulses,
    layout.scratch_parameters,
)


def names(kind: type) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


@pytest.fixture(params=["ant_uni", "acrobot", "antmaze"])
def system(request: pytest.FixtureRequest) -> System:
    env: Any = newton_qd.create(request.param)
    return env.system


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_fields_have_no_gaps(table: Any, system: System) -> None:
    fields = table(system)
    end = 0
    for field in fields:
        assert field.offset == end
        assert field.size == int(np.prod(field.shape))
        end += field.size
    assert fields.size == end


def test_fields_are_found_by_name() -> None:
    fields = Layout({"a": (2, 3), "b": (), "c": (0,), "d": (4,)})
    assert fields.offsets == {"a": 0, "b": 6, "c": 7, "d": 7}
    assert fields.shapes == {"a": (2, 3), "b": (), "c": (0,), "d": (4,)}
    assert fields["b"].size == 1 and fields.size == 11


def test_rows_hold_what_the_classes_do(system: System) -> None:
    assert list(layout.parameters(system).shapes) == names(physics.PhysicsParams)
    assert list(layout.bodies(system).shapes) == names(physics.Kinematics)
    reported = dataclasses.replace(system, reports_bodies=True)
    silent = dataclasses.replace(system, reports_bodies=False)
    state = [name for name in names(physics.PhysicsState) if name != "bodies"]
    found = [name for name in layout.outputs(silent).shapes if name != "fault"]
    assert found == state
    bodies = list(layout.outputs(reported).shapes)[len(state) + 1 :]
    assert bodies == names(physics.Kinematics)


def test_parameters_follow_the_other_inputs() -> None:
    system = physics.load_system(ANT)
    plain, own = layout.inputs(system), layout.inputs(system, parametric=True)
    assert list(own.shapes) == [*plain.shapes, *layout.parameters(system).shapes]
    assert own.size == plain.size + layout.parameters(system).size
    assert own["gravity"].offset == plain.size


def test_kernels_have_a_place_for_every_field() -> None:
    """The structs of the kernels are the tables: nothing missing, nothing more."""
    system = dataclasses.replace(physics.load_system(ANT), reports_bodies=True)
    written, seen = layout.outputs(system).offsets, layout.bodies(system).offsets
    expected = {
        rows.Coordinates: layout.coordinates(system).offsets,
        rows.Inputs: layout.inputs(system, parametric=True).offsets,
        rows.Outputs: [name for name in written if name not in seen],
        rows.Bodies: seen,
        rows.Dynamics: layout.dynamics(system).offsets,
        rows.Parameters: layout.scratch_parameters(system).offsets,
    }
    for struct, fields in expected.items():
        assert list(struct.vars) == ["size", *fields], struct


def test_a_model_holds_the_offsets() -> None:
    system = dataclasses.replace(physics.load_system(ANT), reports_bodies=True)
    model = buffers.build_model(system, wp.get_device("cpu"), parametric=True)
    read = layout.inputs(system, parametric=True)
    assert model.inputs.size == read.size
    assert model.inputs.gear_scale == read["gear_scale"].offset
    written = layout.outputs(system)
    assert model.outputs.torso_xy == written["torso_xy"].offset
    assert model.reported.com == written["com"].offset
    assert model.bodies.com == layout.bodies(system)["com"].offset
