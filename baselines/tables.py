"""Tables for a terminal of any width: no number is cut, headings fold, and columns without room go to a further table."""

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

HEADING = 16  # longer headings fold unless the cells below are as wide
FRAME = 3  # characters between two columns


def number(text: str, bold: bool = False) -> Text:
    """A cell that stays whole."""
    return Text(text, style="bold" if bold else "", no_wrap=True)


@dataclass(frozen=True)
class Column:
    """A heading and its cells; words may wrap, lines of `number` do not."""

    heading: str
    cells: Sequence[Text]

    def width(self, console: Console, words: int = 0) -> int:
        """As narrow as the cells allow; `words`: as wide as that before they wrap."""
        measured = [(one.no_wrap, Measurement.get(console, console.options, one)) for one in self.cells]
        needed = [
            found.maximum if whole else max(found.minimum, min(found.maximum, words)) for whole, found in measured
        ]
        return max(min(len(self.heading), HEADING), *needed)


def side_by_side(
    console: Console, title: str, names: Sequence[Column], columns: Sequence[Column], ruled: Container[int] = ()
) -> None:
    """Print the columns in as many tables as the width takes, each with the rows' names; rules below the rows `ruled`."""
    left = [one.width(console, HEADING) for one in names]
    room = console.width - sum(width + FRAME for width in left) - 1
    for group in _groups([one.width(console) for one in columns], room):
        table = Table(title=title)
        for one, width in zip(names, left, strict=True):
            table.add_column(one.heading, width=width, overflow="fold")
        chosen = columns[group]
        for one in chosen:
            table.add_column(Text(one.heading), width=one.width(console), justify="right", overflow="fold")
        for i, row in enumerate(zip(*(one.cells for one in (*names, *chosen)), strict=True)):
            table.add_row(*row, end_section=i in ruled)
        console.print(table)


def _groups(widths: Sequence[int], room: int) -> Iterator[slice]:
    """Consecutive columns that fit, at least one at a time."""
    start, used = 0, 0
    for i, width in enumerate(widths):
        if i > start and used + width + FRAME > room:
            yield slice(start, i)
            start, used = i, 0
        used += width + FRAME
    yield slice(start, len(widths))
