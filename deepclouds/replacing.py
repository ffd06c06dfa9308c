"""A file appears under its name only when it is complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deepclouds.errors import InputError


def check_writable(path: str | os.PathLike[str], suffix: str | None = None) -> None:
    """Refuse, by InputError, a name under which nothing can be written; what `replacing` itself checks."""
    target = Path(path)
    if suffix is not None and target.suffix.lower() != suffix:
        raise InputError(f"{target}: the name must end in {suffix}")
    if not target.parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist; create it first")
    if target.is_dir():
        raise InputError(f"{target} is a folder; name a file")
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"{target}: cannot write into {target.parent}; choose another folder or change its permissions")


@contextmanager
def replacing(path: str | os.PathLike[str], suffix: str | None = None) -> Iterator[Path]:
    """Yield a temporary name beside `path`; rename it to `path` on success, remove it on failure.

    Parameters
    ----------
    path
        the file to write.
    suffix
        what its name must end in, such as ``".exr"``; None allows any.

    Raises
    ------
    InputError
        when the name ends otherwise, the folder does not exist or cannot be written, or `path` is itself a folder.
    """
    check_writable(path, suffix)
    target = Path(path)
    # The ending stays, since some writers choose the format by it.
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.tmp{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
