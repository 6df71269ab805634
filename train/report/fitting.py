"""Tables on a terminal that has little room."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from rich.console import Console, ConsoleOptions
from rich.table import Table

_ANY_WIDTH = 10_000

T = TypeVar("T")


def print_fitting(
    console: Console,
    columns: Sequence[T],
    table: Callable[[Sequence[T]], Table],
    title: Callable[[T], str],
    file: str,
    stays: Callable[[T], bool] = lambda _: False,
    narrow: Callable[[Sequence[T]], Table] | None = None,
) -> None:
    """Print a table without the last columns that the terminal has no room for, and name those and who has them.

    Args:
        console: The terminal.
        columns: All columns, in order; one of them is printed whatever the room.
        table: Makes the table of some of them.
        title: What a column is called where it is left out.
        file: File that has all of them.
        stays: Whether a column is only left out when all others are.
        narrow: Makes the table where there is no room for one column either; its words may be broken. Where it is
            given, the cells of `table` may be wrapped between words.
    """
    shown = list(columns)
    fits = _has_all_room if narrow is None else has_room
    while len(shown) > 1 and not fits(console, table(shown)):
        shown.remove(next((column for column in reversed(shown) if not stays(column)), shown[-1]))
    last = table(shown)
    console.print(last if narrow is None or fits(console, last) else narrow(shown))
    if len(shown) < len(columns):
        titles = "; ".join(title(column) for column in columns if column not in shown)
        console.print(f"no room for {titles}; {file} has them", style="dim", markup=False)


def has_room(console: Console, table: Table) -> bool:
    """Whether a terminal has room for a table whose cells are wrapped as far as they can be."""
    return console.measure(table, options=_anything(console)).minimum <= console.width


def _has_all_room(console: Console, table: Table) -> bool:
    """Whether a terminal has room for a table with all of its text."""
    return console.measure(table, options=_anything(console)).maximum <= console.width


def _anything(console: Console) -> ConsoleOptions:
    return console.options.update(max_width=_ANY_WIDTH)
