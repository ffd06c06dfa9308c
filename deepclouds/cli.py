"""The `deepclouds` command: finds a sub-command by its entry point and loads only the one that runs."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points

from deepclouds.errors import InputError

GROUP = "deepclouds.commands"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one sub-command and return its exit code: 0 done, 2 bad input, 130 interrupted.

    A sub-command is an entry point of the group ``deepclouds.commands``: a callable ``main(argv, prog) -> int`` that parses
    its own arguments. ``--debug`` anywhere shows tracebacks and debug messages.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"]
    logging.basicConfig(level=logging.DEBUG if debug else logging.INFO, format="%(message)s", stream=sys.stderr)
    commands = {e.name: e for e in entry_points(group=GROUP)}
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: deepclouds COMMAND [options] [--debug]\n\ncommands: {', '.join(sorted(commands))}")
        print("\n`deepclouds COMMAND --help` explains one.")
        return 0
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("deepclouds"))
        return 0
    name = arguments[0]
    if name not in commands:
        print(f"deepclouds: unknown command '{name}'; there are: {', '.join(sorted(commands))}", file=sys.stderr)
        return 2
    try:
        code = int(commands[name].load()(arguments[1:], f"deepclouds {name}"))
        sys.stdout.flush()
        return code
    except InputError as error:
        if debug:
            raise
        print(f"deepclouds {name}: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if debug:
            raise
        print(f"deepclouds {name}: the Python package '{error.name}' is missing; install the extra that brings it", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough. Nothing more may be written, not even by the interpreter's last flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print(f"deepclouds {name}: interrupted", file=sys.stderr)
        return 130
