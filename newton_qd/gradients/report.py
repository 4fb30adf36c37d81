"""The report of the gradient doctor: a table, words, files and a picture."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from newton_qd.errors import require_extra
from newton_qd.files import write_atomically

if TYPE_CHECKING:
    from newton_qd.figure import NotebookFigure

AGREEMENT = 0.999
"""Smallest cosine with central differences of a correct gradient [-]."""
LENGTH_ERROR = 0.05
"""Largest relative error of the length of a correct gradient [-]."""


@dataclasses.dataclass(frozen=True)
class HorizonRow:
    """Quality of the gradient of the return for one horizon.

    Attributes:
        steps: Control steps of the return.
        seconds: The same in simulated time [s].
        alive: Share of the worlds whose episode reaches the last step [-].
        norm: Norm of the gradient, median over the worlds.
        largest_norm: Norm of the gradient, maximum over the worlds.
        cosine: Cosine with central differences along random directions, median [-].
        worst_cosine: The same cosine, minimum over the worlds [-].
        first_deviation: Standard deviation of a first-order sample, over the whole
            genotype, median; infinite if a sample was not finite.
        zeroth_deviation: Standard deviation of a zeroth-order sample, in the same way.
        bias: Share of the first-order slope along the gradient without noise that the
            zeroth order does not confirm, mean over the worlds [-].
        bias_error: Standard error of ``bias`` [-].
        order: Alpha, the weight of the first order by inverse variances, median [-].
        length: Length of the gradient along these directions divided by that of the
            central differences [-], of the world where it is farthest from 1.
    """

    steps: int
    seconds: float
    alive: float
    norm: float
    largest_norm: float
    cosine: float
    worst_cosine: float
    first_deviation: float
    zeroth_deviation: float
    bias: float
    bias_error: float
    order: float
    length: float


@dataclasses.dataclass(frozen=True)
class ContactRow:
    """A body whose contact changed before the gradient broke for a finite change.

    Attributes:
        body: Link, or ``no contact`` if no contact changed.
        share: Share of the pairs of world and direction with this body [-].
        first_step: Earliest control step at which the gradient broke, from 1.
        median_step: Median of these steps.
    """

    body: str
    share: float
    first_step: int
    median_step: float


@dataclasses.dataclass(frozen=True)
class GradientReport:
    """The result of :func:`~newton_qd.diagnose_gradients`; ``print`` shows it.

    Attributes:
        name: Environment.
        dt: Duration of a control step [s].
        open_loop: Whether the genotypes were actions, not policies.
        sigma: Standard deviation of the noise of the estimates.
        horizons: One row for each horizon, ascending.
        contacts: Contacts at which the gradient broke, most frequent first.
    """

    name: str
    dt: float
    open_loop: bool
    sigma: float
    horizons: tuple[HorizonRow, ...]
    contacts: tuple[ContactRow, ...]

    @property
    def growth(self) -> float:
        """Growth factor of the norm per step, over the later half of the horizons.

        It is NaN for a single horizon, or if a norm is 0.
        """
        last = self.horizons[-1]
        middle = min(self.horizons, key=lambda row: abs(row.steps - last.steps / 2))
        if middle is last or not (middle.norm > 0 and last.norm > 0):
            return math.nan
        return (last.norm / middle.norm) ** (1 / (last.steps - middle.steps))

    @property
    def exact_horizon(self) -> int:
        """Longest horizon at which the gradient agrees with differences, or 0."""
        return self._last(
            lambda row: (
                row.worst_cosine >= AGREEMENT and abs(row.length - 1) <= LENGTH_ERROR
            )
        )

    @property
    def useful_horizon(self) -> int:
        """Longest horizon at which first orders vary less than zeroth orders, or 0.

        A gradient of 0 does not count: it does not vary, and says nothing.
        """
        return self._last(lambda row: row.order > 0.5 and row.norm > 0)

    def _last(self, good: Callable[[HorizonRow], bool]) -> int:
        last = 0
        for row in self.horizons:
            if not good(row):
                break
            last = row.steps
        return last

    @property
    def verdict(self) -> str:
        """The useful horizon, in words."""
        exact, useful = self.exact_horizon, self.useful_horizon
        longest = self.horizons[-1].steps
        usable = min(exact, useful)
        if exact == longest and all(row.largest_norm == 0 for row in self.horizons):
            return (
                f"The gradient is 0 up to {self._time(longest)}, and so are the "
                "differences: small changes do not change the return. Use zeroth-order "
                "gradients."
            )
        agrees = (
            f"The gradient agrees with differences up to {self._time(exact)}"
            if exact
            else "The gradient agrees with differences over none of these horizons"
        )
        guides = (
            f"a first-order sample varies less than a zeroth-order one up to "
            f"{self._time(useful)}"
            if useful
            else "a zeroth-order sample varies less than a first-order one throughout"
        )
        if usable == longest:
            advice = "Use it over all of them."
        elif usable:
            advice = (
                f"Use it up to {usable} control steps; beyond, cut it into windows of "
                f"that length (window={usable}), clip it, or mix in the zeroth order."
            )
        else:
            advice = "Use zeroth-order gradients, or soften the contacts."
        fallen = next((row for row in self.horizons if row.alive < 0.5), None)
        note = ""
        if fallen is not None:
            note = (
                f" Most episodes end before step {fallen.steps}: rows from there on "
                "repeat shorter ones."
            )
        return f"{agrees}; {guides}. {advice}{note}"

    def _time(self, steps: int) -> str:
        unit = "step" if steps == 1 else "steps"
        return f"{steps} control {unit} ({steps * self.dt:g} s)"

    def __str__(self) -> str:
        kind = "open-loop actions" if self.open_loop else "a policy"
        lines = [f"{self.name}: gradient of the return to {kind}", ""]
        lines += _table(
            (
                "steps",
                "time [s]",
                "alive",
                "norm",
                "largest",
                "cosine",
                "worst",
                "length",
            ),
            [
                (
                    str(row.steps),
                    f"{row.seconds:g}",
                    f"{row.alive:.2f}",
                    f"{row.norm:.3g}",
                    f"{row.largest_norm:.3g}",
                    f"{row.cosine:.6f}",
                    f"{row.worst_cosine:.6f}",
                    f"{row.length:.3g}",
                )
                for row in self.horizons
            ],
        )
        lines += ["", "Samples of a first-order and of a zeroth-order gradient:", ""]
        lines += _table(
            ("steps", "1st order sd", "0th order sd", "bias", "alpha"),
            [
                (
                    str(row.steps),
                    f"{row.first_deviation:.3g}",
                    f"{row.zeroth_deviation:.3g}",
                    f"{row.bias:.2f} +- {row.bias_error:.2f}",
                    f"{row.order:.3f}",
                )
                for row in self.horizons
            ],
        )
        if math.isfinite(self.growth):
            lines += ["", f"The norm grows by a factor of {self.growth:.3f} a step."]
        if self.contacts:
            lines += ["", "Where a finite change leaves the gradient:", ""]
            lines += _table(
                ("body that touched or not", "share", "first step", "median step"),
                [
                    (
                        row.body,
                        f"{row.share:.2f}",
                        str(row.first_step),
                        f"{row.median_step:g}",
                    )
                    for row in self.contacts
                ],
            )
        return "\n".join([*lines, "", self.verdict])

    def write(self, folder: Path | str) -> None:
        """Writes ``horizons.csv``, ``contacts.csv``, ``report.txt``, ``gradients.png``.

        A file is either written completely or not changed.

        Args:
            folder: Folder for the files. It is created if it does not exist.

        Raises:
            MissingExtra: matplotlib is not installed. The other files are written.
            OSError: The folder cannot be created or is not writable.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in (
            ("horizons.csv", _csv_text(HorizonRow, self.horizons)),
            ("contacts.csv", _csv_text(ContactRow, self.contacts)),
            ("report.txt", f"{self}\n"),
        ):
            write_atomically(folder / name, text.encode())
        picture = io.BytesIO()
        self.plot().savefig(picture, dpi=120, format="png")
        write_atomically(folder / "gradients.png", picture.getvalue())

    def plot(self) -> NotebookFigure:
        """Draws norm, agreement and deviation over the horizon.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        require_extra("matplotlib", "viz")
        from newton_qd.figure import NotebookFigure

        figure = NotebookFigure(figsize=(11, 4), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        steps = [row.steps for row in self.horizons]
        left.plot(steps, [row.norm for row in self.horizons], "o-", label="median")
        left.plot(
            steps, [row.largest_norm for row in self.horizons], "^:", label="largest"
        )
        left.set_ylabel("norm of the gradient of the return")
        middle.plot(
            steps, [_error(row.cosine) for row in self.horizons], "o-", label="median"
        )
        middle.plot(
            steps,
            [_error(row.worst_cosine) for row in self.horizons],
            "^:",
            label="worst",
        )
        middle.axhline(1 - AGREEMENT, color="0.6", lw=1, label="usable below")
        middle.set_ylabel("1 - cosine with central differences")
        right.plot(
            steps,
            [row.first_deviation for row in self.horizons],
            "o-",
            label="1st order",
        )
        right.plot(
            steps,
            [row.zeroth_deviation for row in self.horizons],
            "s--",
            label="0th order",
        )
        right.set_ylabel(f"deviation of a sample, noise {self.sigma:g}")
        for axes in (left, middle, right):
            axes.set_xscale("log", base=2)
            if any(y > 0 for line in axes.lines for y in line.get_ydata()):
                axes.set_yscale("log")
            axes.set_xticks(steps, [str(s) for s in steps])
            axes.set_xlabel("control steps of the return")
            axes.grid(True, color="0.9")
            axes.legend()
        figure.suptitle(f"{self.name}: what the gradient is worth")
        return figure


def _error(cosine: float) -> float:
    """Returns the distance of a cosine from 1, with the lower limit of the picture."""
    return max(1 - cosine, 1e-16)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns lines of a table; the first column is aligned left, all others right."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    return [
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (head, *rows)
    ]


def _csv_text(kind: type, rows: Sequence[HorizonRow | ContactRow]) -> str:
    names = [field.name for field in dataclasses.fields(kind)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([getattr(row, name) for name in names] for row in rows)
    return text.getvalue()
