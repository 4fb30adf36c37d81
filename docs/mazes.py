"""Write the URDF files of the mazes from their layouts.

python docs/mazes.py            writes urdf/antmaze_u.urdf and the other mazes

A layout is a picture of cells: ``#`` is wall, ``S`` the start, ``T`` the target, and a
dot is free. Rows follow each other along x, columns along y, and the start is at x = 0,
y = 0. The layouts of the three ant mazes are those of JaxGCRL (Bortkiewicz et al.
2025), its U_MAZE, BIG_MAZE and HARDEST_MAZE, with one target.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

URDF = Path(__file__).resolve().parents[1] / "urdf"
BORDER = 1.0  # thickness of the borders [m]; nothing sees their outer faces

U_MAZE = ("#####", "#S..#", "###.#", "#T..#", "#####")
BIG_MAZE = (
    *("########", "#S.##..#", "#..#...#", "##...###"),
    *("#..#...#", "#.#..#.#", "#...#.T#", "########"),
)
HARDEST_MAZE = (
    *("############", "#S...#.....#", "#.##.#.#.#.#"),
    *("#......#...#", "#.####.###.#", "#..#.#.....#"),
    *("##.#.#.#.###", "#..#...#..T#", "############"),
)


class Maze(NamedTuple):
    """A maze of boxes.

    Attributes:
        about: Name, for the head of the file.
        layout: Rows of cells.
        cell: Edge of a cell [m].
        height: Height of the walls [m].
    """

    about: str
    layout: tuple[str, ...]
    cell: float
    height: float

    def place(self, mark: str) -> tuple[float, float]:
        """Returns x and y of the middle of the only cell with a mark [m]."""
        (row, column), (first, start) = (self._index(m) for m in (mark, "S"))
        return (row - first) * self.cell, (column - start) * self.cell

    def walls(self) -> dict[str, tuple[float, ...]]:
        """Returns lowest x, lowest y, highest x and highest y of each box [m]."""
        rows, columns = len(self.layout) - 2, len(self.layout[0]) - 2
        low_x, low_y, high_x, high_y = self._box((1, 1, rows, columns))
        out_x, out_y = high_x + BORDER, high_y + BORDER
        inner = {
            f"inner wall {index}": self._box(cells)
            for index, cells in enumerate(self._runs(), 1)
        }
        return inner | {
            "border, low x": (low_x - BORDER, low_y - BORDER, low_x, out_y),
            "border, high x": (high_x, low_y - BORDER, out_x, out_y),
            "border, low y": (low_x, low_y - BORDER, high_x, low_y),
            "border, high y": (low_x, high_y, high_x, out_y),
        }

    def _index(self, mark: str) -> tuple[int, int]:
        rows = [row for row, text in enumerate(self.layout) if mark in text]
        return rows[0], self.layout[rows[0]].index(mark)

    def _box(self, cells: tuple[int, int, int, int]) -> tuple[float, ...]:
        first, start = self._index("S")
        low, left, high, right = cells
        edges = (low - first, left - start, high + 1 - first, right + 1 - start)
        return tuple((edge - 0.5) * self.cell for edge in edges)

    def _runs(self) -> list[tuple[int, int, int, int]]:
        """Returns the straight runs of wall cells inside the borders, longest first.

        A run is its lowest row, lowest column, highest row and highest column. Long
        boxes keep the number of contacts low.
        """
        inside = {
            (row, column)
            for row, text in enumerate(self.layout[1:-1], 1)
            for column, mark in enumerate(text[1:-1], 1)
            if mark == "#"
        }
        runs = []
        while inside:
            row, column, row_step, column_step, length = max(
                (
                    (*cell, *step, _length(cell, step, inside))
                    for cell in sorted(inside)
                    for step in ((0, 1), (1, 0))
                ),
                key=lambda run: run[-1],
            )
            last = length - 1
            end = row + last * row_step, column + last * column_step
            runs.append((row, column, *end))
            inside -= {
                (row + k * row_step, column + k * column_step) for k in range(length)
            }
        return runs

    def text(self, name: str) -> str:
        """Returns the URDF file."""
        links = "".join(
            _wall(title, box, self.height) for title, box in self.walls().items()
        )
        x, y = self.place("T")
        free = sum(row.count(mark) for row in self.layout for mark in ".ST")
        about = (
            f"{self.about}: {free} free cells of {self.cell:g} m by {self.cell:g} m,\n"
            f"  walls {self.height:g} m high. The start is at (0, 0), the target at"
            f" ({x:g}, {y:g})."
        )
        return _FILE.format(about=about, name=name, walls=links, x=x, y=y)


def _length(
    cell: tuple[int, int], step: tuple[int, int], inside: set[tuple[int, int]]
) -> int:
    """Returns the number of cells of a run."""
    length = 0
    while (cell[0] + length * step[0], cell[1] + length * step[1]) in inside:
        length += 1
    return length


def _wall(title: str, box: tuple[float, ...], height: float) -> str:
    low_x, low_y, high_x, high_y = box
    middle = f"{(low_x + high_x) / 2} {(low_y + high_y) / 2} {height / 2}"
    size = f"{high_x - low_x} {high_y - low_y} {height}"
    return _WALL.format(title=title, middle=middle, size=size)


_WALL = """\
    <!-- {title} -->
    <visual>
      <origin xyz="{middle}" rpy="0.0 0.0 0.0"/>
      <geometry><box size="{size}"/></geometry>
      <material name="wall"/>
    </visual>
    <collision>
      <origin xyz="{middle}" rpy="0.0 0.0 0.0"/>
      <geometry><box size="{size}"/></geometry>
    </collision>
"""

_FILE = """\
<?xml version="1.0"?>
<!--
  {about}

  Static boxes on the ground, angles in rad, lengths in m. docs/mazes.py writes this
  file from a layout.
-->
<robot name="{name}">
  <material name="wall"><color rgba="0.55 0.58 0.62 1.0"/></material>
  <material name="target"><color rgba="0.20 0.65 0.30 0.6"/></material>

  <link name="world"/>

  <joint name="maze" type="fixed">
    <parent link="world"/>
    <child link="maze"/>
  </joint>

  <link name="maze">
{walls}  </link>

  <joint name="target" type="fixed">
    <parent link="world"/>
    <child link="target"/>
    <origin xyz="{x} {y} 0.5"/>
  </joint>

  <!-- only drawn: nothing collides with it -->
  <link name="target">
    <visual>
      <origin xyz="0.0 0.0 0.0" rpy="0.0 0.0 0.0"/>
      <geometry><sphere radius="0.5"/></geometry>
      <material name="target"/>
    </visual>
  </link>
</robot>
"""

MAZES = {
    "antmaze_u": Maze("U_MAZE of JaxGCRL", U_MAZE, 4.0, 2.0),
    "antmaze_big": Maze("BIG_MAZE of JaxGCRL", BIG_MAZE, 4.0, 2.0),
    "antmaze_hardest": Maze("HARDEST_MAZE of JaxGCRL", HARDEST_MAZE, 4.0, 2.0),
    "humanoid_maze": Maze("U_MAZE of JaxGCRL, smaller", U_MAZE, 2.0, 2.0),
}


def main() -> None:
    """Writes the files."""
    for name, maze in MAZES.items():
        (URDF / f"{name}.urdf").write_text(maze.text(name), encoding="utf-8")


if __name__ == "__main__":
    main()
