"""Results on a page of the documentation: what lies between two marks is replaced, the rest is prose."""

from __future__ import annotations

from pathlib import Path

from deepclouds.errors import InputError
from deepclouds.replacing import replacing


def marks(module: str) -> tuple[str, str]:
    """The lines around the results that ``python -m benchmarks.<module> --docs`` writes."""
    return f"<!-- results: written by `python -m benchmarks.{module} --docs` -->", "<!-- end of results -->"


def write_results(page: Path, module: str, body: str) -> None:
    """Replace what lies between the `marks` of `page`, all or nothing.

    Raises
    ------
    InputError
        when the page is missing or its first mark is not there once, or no last one follows.
    """
    first, last = marks(module)
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    head, found, rest = text.partition(first)
    # A page may hold the results of several benchmarks, each with an end of its own.
    _, end, tail = rest.partition(last)
    if not (found and end) or first in rest:
        raise InputError(f"{page}: needs the lines '{first}' and '{last}' once each, to put the results between")
    with replacing(page, ".md") as temporary:
        temporary.write_text(f"{head}{first}\n\n{body}\n\n{last}{tail}", encoding="utf-8")
