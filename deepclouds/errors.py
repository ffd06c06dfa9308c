"""The errors every command turns into exit code 2."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input: the message names the file or value at fault and the remedy.

    Libraries raise it; the command line prints it without a traceback and exits with code 2.
    """


class EmptyGridError(InputError):
    """A grid without an active voxel, and so without a box."""
