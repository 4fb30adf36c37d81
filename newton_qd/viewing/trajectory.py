"""A trajectory: coordinates over time, and what is drawn with them."""

from __future__ import annotations

import dataclasses

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.viewing.drawing import Drawing


@dataclasses.dataclass(frozen=True, eq=False)
class Contacts:
    """Contact impulses of every step.

    Attributes:
        body: (nc,) body of each contact.
        position: (nc, 3) centre of the sphere or capsule in the body frame [m].
        radius: (nc,) its radius [m].
        ground: (nc,) whether the contact is with the ground.
        impulse: (worlds, steps, nc, 3) impulse on the body over the control step, with
            friction, in world axes [N s].
    """

    body: np.ndarray
    position: np.ndarray
    radius: np.ndarray
    ground: np.ndarray
    impulse: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """Coordinates of one or more worlds over time.

    Frame 0 is the state after the reset. Frame k is the state after step k, whose
    reward is ``rewards[:, k - 1]``.

    Attributes:
        drawing: What is drawn.
        q: (worlds, steps + 1, nq) coordinates [m or rad], float32.
        lengths: (worlds,) valid steps of each world: up to the end of its episode.
        dt: Duration of a step [s].
        rewards: (worlds, steps) reward of each step.
        descriptors: (worlds, steps + 1, nd) state descriptors; nd is 0 if there are
            none.
        descriptor_names: Names of their components.
        feet: (worlds, steps + 1, nf) 1 where a foot touches the ground, else 0.
        labels: Name of each world.
        contacts: Contact impulses, ``None`` if they were not recorded.

    Raises:
        ValueError: The shapes of two arrays do not fit together, or a coordinate is not
            finite.
    """

    drawing: Drawing
    q: np.ndarray
    lengths: np.ndarray
    dt: float
    rewards: np.ndarray
    descriptors: np.ndarray
    descriptor_names: tuple[str, ...]
    feet: np.ndarray
    labels: tuple[str, ...]
    contacts: Contacts | None = None

    def __post_init__(self) -> None:
        worlds, frames = self.q.shape[:2]
        allowed = {
            "q": (worlds, frames, self.drawing.nq),
            "lengths": (worlds,),
            "rewards": (worlds, frames - 1),
            "descriptors": (worlds, frames, len(self.descriptor_names)),
            "feet": (worlds, frames, len(self.drawing.feet)),
            "labels": (worlds,),
        }
        for name, shape in allowed.items():
            given = np.shape(getattr(self, name))
            if given != shape:
                raise ValueError(message(name, Fact(f"shape {given}"), f"{shape}"))
        if not np.isfinite(self.q).all():
            given = Fact("coordinates that are not finite")
            raise ValueError(message("q", given, "finite numbers"))

    @property
    def worlds(self) -> int:
        """Number of worlds."""
        return self.q.shape[0]

    @property
    def steps(self) -> int:
        """Number of control steps, also those after the end of an episode."""
        return self.q.shape[1] - 1

    @property
    def returns(self) -> np.ndarray:
        """(worlds,) sum of the rewards of the valid steps."""
        valid = np.arange(self.steps) < self.lengths[:, None]
        return np.where(valid, self.rewards, 0.0).sum(axis=1)

    def world(self, index: int) -> Trajectory:
        """Returns the trajectory of one world.

        Args:
            index: Its number; a negative number counts from the end.

        Raises:
            IndexError: There is no such world.
        """
        return self.select([index])

    def select(self, indices: list[int]) -> Trajectory:
        """Returns the trajectory of some worlds, in this order.

        Args:
            indices: Their numbers.

        Raises:
            IndexError: One of them does not exist.
        """
        contacts = self.contacts
        if contacts is not None:
            impulse = contacts.impulse[indices]
            contacts = dataclasses.replace(contacts, impulse=impulse)
        return dataclasses.replace(
            self,
            **{
                name: getattr(self, name)[indices]
                for name in ("q", "lengths", "rewards", "descriptors", "feet")
            },
            labels=tuple(self.labels[index] for index in indices),
            contacts=contacts,
        )


def joined(trajectories: list[Trajectory]) -> Trajectory:
    """Joins trajectories of the same robot in the same scene to one of all worlds.

    Shorter ones stay in their last state.

    Args:
        trajectories: At least one. Contacts are kept if all have them.

    Raises:
        ValueError: There is none, or the robots, their scenes or the durations of a
            step differ.
    """
    if not trajectories:
        raise ValueError(message("trajectories", Fact("none"), "at least one"))
    first = trajectories[0]
    for other in trajectories[1:]:
        if not first.drawing.shows(other.drawing) or other.dt != first.dt:
            given = Fact(f"{first.drawing.name} and {other.drawing.name}")
            allowed = "one robot in one scene with one duration of a step"
            raise ValueError(message("trajectories", given, allowed))
    steps = max(one.steps for one in trajectories)

    def rows(name: str) -> np.ndarray:
        parts = []
        for one in trajectories:
            array = getattr(one, name)
            missing = [(0, 0), (0, steps - one.steps), *[(0, 0)] * (array.ndim - 2)]
            parts.append(np.pad(array, missing, mode="edge"))
        return np.concatenate(parts)

    contacts = None
    if all(one.contacts is not None for one in trajectories):
        impulses = []
        for one in trajectories:
            assert one.contacts is not None
            missing = [(0, 0), (0, steps - one.steps), (0, 0), (0, 0)]
            impulses.append(np.pad(one.contacts.impulse, missing))
        assert first.contacts is not None
        contacts = dataclasses.replace(first.contacts, impulse=np.concatenate(impulses))
    return dataclasses.replace(
        first,
        q=rows("q"),
        lengths=np.concatenate([one.lengths for one in trajectories]),
        rewards=rows("rewards"),
        descriptors=rows("descriptors"),
        feet=rows("feet"),
        labels=tuple(label for one in trajectories for label in one.labels),
        contacts=contacts,
    )
