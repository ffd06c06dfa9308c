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
        when the page is missing or its marks are not there once each.
    """
    first, last = marks(module)
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    if not all(text.count(mark) == 1 for mark in (first, last)):
        raise InputError(f"{page}: needs the lines '{first}' and '{last}' once each, to put the results between")
    head, tail = text.split(first)[0], text.split(last)[1]
    with replacing(page, ".md") as temporary:
        temporary.write_text(f"{head}{first}\n\n{body}\n\n{last}{tail}", encoding="utf-8")
