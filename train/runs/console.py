"""The console of the commands: no text and no warning can send commands to the terminal."""

import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from train.runs.escaping import visible


class PlainConsole(Console):
    """Rich's console, which shows terminal commands within texts instead of sending them.

    Texts may come from others: labels, paths, joints of a model, configurations of a received
    folder. A printed text is not read as Rich's markup, unless `markup=True`. It stays one line,
    however long it is.
    """

    def __init__(self, **options: Any) -> None:
        # a policy of the user may be called mine:zero
        super().__init__(emoji=False, **options)

    def print(self, *objects: Any, markup: bool = False, **options: Any) -> None:
        """Print texts as they are, without markup, colours or added line breaks."""
        if all(isinstance(part, str | Text) for part in objects):
            options = {"soft_wrap": True, "highlight": False, **options}
        style = {"markup": markup, "highlight": options.get("highlight")}

        def plain(part: Any) -> Any:
            return self.render_str(part, **style) if isinstance(part, str) else part

        super().print(*map(plain, objects), **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Make all texts visible; Rich's own terminal commands stay."""
        for part in super().render(renderable, options):
            yield part if part.control else Segment(visible(part.text), part.style)


def can_redraw(console: Console) -> bool:
    """Return True if lines can be drawn again in place.

    Rich treats a notebook, and a CI that asks for colours, as terminals. Both show each drawing
    below the last one.
    """
    return console.is_terminal and console.file.isatty()


_Row = Sequence[str]


def make_table(title: str, head: _Row, rows: Iterable[_Row], left: int = 1, **style: Any) -> Table:
    """Return a table of plain texts.

    Args:
        title: Above the table.
        head: Names of the columns.
        rows: Cells.
        left: Number of first columns that are aligned to the left; the others are numbers.
        **style: Options of Rich's table.
    """
    table = Table(title=escape(title), **style)
    for number, name in enumerate(head):
        table.add_column(escape(name), justify="left" if number < left else "right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def print_files(folder: Path, files: Iterable[Path], console: Console) -> None:
    """Print the paths of the files that were written."""
    console.print(f"Results in {folder}:")
    for path in files:
        console.print(f"  {path}")


def traceback_text(error: BaseException) -> str:
    """Return the traceback of an error as text for a terminal."""
    return visible("".join(traceback.format_exception(error)))


def warning_text(
    message: Warning | str, category: type[Warning], file: str, line: int, *_: Any
) -> str:
    """Return a warning as a sentence; one of a library with its kind and place."""
    if category is UserWarning:
        return str(message)
    return f"{category.__name__}: {message} ({file}:{line})"


@contextmanager
def warn_once() -> Iterator[None]:
    """Show each warning within the context once, on a line without terminal commands."""
    known = set[str]()
    before = (warnings.showwarning, warnings.formatwarning)

    def show(message: Warning | str, *where: Any) -> None:
        if str(message) not in known:
            known.add(str(message))
            before[0](message, *where)

    warnings.showwarning = show
    warnings.formatwarning = lambda *warning: visible(f"warning: {warning_text(*warning)}\n")
    try:
        yield
    finally:
        warnings.showwarning, warnings.formatwarning = before
