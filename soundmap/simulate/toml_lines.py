"""Line numbers of a TOML file: which line a person has to mend.

The standard library's parser gives values without places. This one gives places without values.
"""

from __future__ import annotations

import re

Path = tuple[str | int, ...]

_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\]]+?)\s*\]\]?")
_KEY = re.compile(r"^\s*((?:[\w-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[\w-]+|\"[^\"]*\"))*)\s*=")
_STRING_OR_COMMENT = re.compile(r"\"(?:\\.|[^\"\\])*\"|'[^']*'|#.*$")


def toml_lines(text: str) -> dict[Path, int]:
    r"""Line, counted from 1, of every table header and key of a TOML text.

    Parameters
    ----------
    text : str
        Valid TOML. Keys of inline tables are not listed: their line is that of the table's key.

    Returns
    -------
    dict
        From the path of a table or key (entries of arrays of tables by index) to its line.

    Examples
    --------
    >>> lines = toml_lines("seed = 1\n[[sources]]\nid = 'S1'\n[[sources]]\nid = 'S2'")
    >>> lines[("sources", 1, "id")]
    5
    """
    lines: dict[Path, int] = {}
    table: Path = ()
    entries: dict[Path, int] = {}
    depth = 0
    for number, line in enumerate(text.splitlines(), start=1):
        if depth == 0:
            if header := _HEADER.match(line):
                table = _table(header[1] == "[[", _parts(header[2]), entries)
                lines.setdefault(table, number)
                continue
            if key := _KEY.match(line):
                lines[table + tuple(_parts(key[1]))] = number
        bare = _STRING_OR_COMMENT.sub("", line)
        depth += sum(bare.count(c) for c in "[{") - sum(bare.count(c) for c in "]}")
    return lines


def line_of(lines: dict[Path, int], path: Path) -> int | None:
    """Line of a path, or of the nearest table or key that holds it."""
    for length in range(len(path), 0, -1):
        if path[:length] in lines:
            return lines[path[:length]]
    return None


def _parts(dotted: str) -> list[str]:
    return [part.strip().strip("\"'") for part in dotted.split(".")]


def _table(is_entry: bool, parts: list[str], entries: dict[Path, int]) -> Path:
    """Path of a header, with the index of the latest entry wherever it passes an array."""
    path: Path = ()
    for position, part in enumerate(parts):
        path = (*path, part)
        if is_entry and position == len(parts) - 1:
            entries[path] = entries.get(path, -1) + 1
        if path in entries:
            path = (*path, entries[path])
    return path
