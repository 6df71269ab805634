"""Tables of a user: what is read, and what is refused in a sentence, in bounded time."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from elastic_env.core.csv_table import LARGEST_BYTES, read_table
from elastic_env.core.errors import ConfigurationError


def read(file: Path) -> Any:
    """The table of a file of at most 1000 rows."""
    return read_table(file, what="log", row="pose", most_rows=1000, example="a and b")


@pytest.mark.parametrize(
    "text",
    [
        "a,b\n1,2\n3,4\n",
        "\ufeffa,b\r\n1,2\r\n3,4",
        "a , b\n\n 1 ,2\n,\n3,4.0e0\n\n",
        '"a","b"\n"1","2"\n3,4\n',
    ],
)
def test_tables_are_read_however_they_were_saved(tmp_path: Path, text: str) -> None:
    """Catches byte order marks, line ends, empty lines, quotation marks and spaces that change a
    table."""
    file = tmp_path / "t.csv"
    file.write_bytes(text.encode())
    table = read(file)
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.values, [[1.0, 2.0], [3.0, 4.0]])


WRONG: dict[str, tuple[bytes, str]] = {
    "semicolons": (b"a;b\n1;2\n", "separated by semicolons; use commas, and points in numbers"),
    "decimal commas": (
        b"a;b\n1,5;2,5\n",
        "separated by semicolons; use commas, and points in numbers",
    ),
    "tabs": (b"a\tb\n1\t2\n", "separated by tabs; use commas, and points in numbers"),
    "bars": (b"a|b\n1|2\n", "separated by bars; use commas"),
    "rows of another kind": (
        b"a,b\n1;2\n",
        "pose 1: its values are separated by semicolons; use commas",
    ),
    "commas in numbers": (
        b"a,b\n1,5,2,5\n",
        "2 values are needed.*got 4; were its numbers.*decimal commas",
    ),
    "quoted commas": (
        b'a,b\n"1,5",2\n',
        "column a: a finite number is needed, got '1,5'; write .* a point",
    ),
    "text": (b"a,b\n1,2\nx,4\n", "rows of numbers: pose 2, column a: .*got 'x'; give a number"),
    "infinite": (
        b"a,b\n1,inf\n",
        "pose 1, column b: a finite number is needed, got 'inf'; measure it again",
    ),
    "huge": (b"a,b\n1,1e999\n", "a finite number is needed, got '1e999'"),
    "underscore": (b"a,b\n1_0,2\n", "a finite number is needed, got '1_0'"),
    "ragged": (b"a,b\n1,2,3\n", "pose 1: 2 values are needed, one a column, got 3"),
    "twice": (b"a,a\n1,2\n", "has the column a twice"),
    "no name": (b"a,\n1,2\n", "column 2 of .* has no name"),
    "UTF-16": ("a,b\n1,2\n".encode("utf-16"), "no text in UTF-8.*save it as CSV in UTF-8"),
    "Latin-1": ("a,é\n1,2\n".encode("latin-1"), "no text in UTF-8"),
    "NUL": (b"a,b\n1,\0\n", "number is needed|NUL"),
    "empty": (b"\n\n", "is empty"),
    "header alone": (b"a,b\n", "1 to 1000 poses, a line each, it has 0"),
    "many rows": (
        b"a,b\n" + b"1,2\n" * 100_000,
        "1 to 1000 poses, a line each, it has more than 1000",
    ),
    "many columns": (
        b",".join(b"c%d" % i for i in range(1001)) + b"\n",
        "at most 1000 columns, it has 1001",
    ),
    "long line": (b"a," * 1_000_000, "lines of at most 200000 characters"),
    "open quotation mark": (b'a,b\n"1,2\n' + b"3,4\n" * 100_000, "is no CSV file"),
    "large": (b"a" * (LARGEST_BYTES + 1), "at most 20000000 bytes"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_table_is_one_sentence(tmp_path: Path, case: str) -> None:
    """Catches tracebacks, a wrong separator that is told as a wrong measurement, and files
    without bounds."""
    content, message = WRONG[case]
    file = tmp_path / "t.csv"
    file.write_bytes(content)
    begun = time.perf_counter()
    with pytest.raises(ConfigurationError, match=message) as caught:
        read(file)
    assert time.perf_counter() - begun < 2.0
    assert len(str(caught.value).replace(str(file), "")) < 400


def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    """Catches a pipe that waits for ever, a folder, and a device without an end."""
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(ConfigurationError, match="must be a plain file"):
            read(file)
    for file in (tmp_path / "none.csv", tmp_path / ("x" * 5000), Path("a\0b")):
        with pytest.raises(ConfigurationError, match="no log at"):
            read(file)
