"""The terminal: whatever a text or a warning holds, nothing of it is a command."""

import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from train.runs.escaping import visible


class PlainConsole(Console):
    """Rich's console that shows the commands of a terminal within texts, in place of obeying them.

    Texts may come from elsewhere: labels, paths, joints of a model, configurations of a folder that
    was received. A text that is printed is no markup of Rich's either, unless `markup=True` asks
    for it, and is one line however long it is.
    """

    def __init__(self, **options: Any) -> None:
        # a policy of the user may be called mine:zero
        super().__init__(emoji=False, **options)

    def print(self, *objects: Any, markup: bool = False, **options: Any) -> None:
        """Print texts as they are: without markup, colours or line breaks of our own."""
        if all(isinstance(part, str | Text) for part in objects):
            options = {"soft_wrap": True, "highlight": False, **options}
        style = {"markup": markup, "highlight": options.get("highlight")}

        def plain(part: Any) -> Any:
            return self.render_str(part, **style) if isinstance(part, str) else part

        super().print(*map(plain, objects), **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Render with visible texts, and what Rich itself asks of the terminal stays."""
        for one in super().render(renderable, options):
            yield one if one.control else Segment(visible(one.text), one.style)


def can_redraw(console: Console) -> bool:
    """True where lines can be drawn again.

    A notebook or a CI that asks for colours is a terminal for Rich, and shows each drawing below
    the last one.
    """
    return console.is_terminal and console.file.isatty()


_Row = Sequence[str]


def make_table(title: str, head: _Row, rows: Iterable[_Row], left: int = 1, **style: Any) -> Table:
    """A table of plain texts.

    Args:
        title: Above the table.
        head: Names of the columns.
        rows: Cells.
        left: How many of the first columns are aligned to the left; the others are numbers.
        **style: Of Rich's table.
    """
    table = Table(title=escape(title), **style)
    for number, name in enumerate(head):
        table.add_column(escape(name), justify="left" if number < left else "right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def print_files(folder: Path, files: Iterable[Path], console: Console) -> None:
    """Say what was written."""
    console.print(f"Results in {folder}:")
    for path in files:
        console.print(f"  {path}")


def traceback_of(error: BaseException) -> str:
    """The traceback of an error as text for a terminal."""
    return visible("".join(traceback.format_exception(error)))


@contextmanager
def visible_warnings() -> Iterator[None]:
    """Warnings within are shown without commands of a terminal."""
    before = warnings.formatwarning
    warnings.formatwarning = lambda *given: visible(before(*given))
    try:
        yield
    finally:
        warnings.formatwarning = before


_SAID: ContextVar[set[str] | None] = ContextVar("said", default=None)


def shown_warnings() -> frozenset[str]:
    """Texts that were shown within `warn_once`, for processes that shall not show them again."""
    return frozenset(_SAID.get() or ())


@contextmanager
def warn_once(said: Iterable[str] = ()) -> Iterator[None]:
    """Show each warning within once.

    Args:
        said: Texts that were shown before, such as in the process that started this one.
    """
    outer = _SAID.get()
    known = {*said} if outer is None else outer
    known.update(said)
    token = _SAID.set(known)
    before = warnings.showwarning

    def show(message: Warning | str, *where: Any) -> None:
        if str(message) not in known:
            known.add(str(message))
            before(message, *where)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before
        _SAID.reset(token)
