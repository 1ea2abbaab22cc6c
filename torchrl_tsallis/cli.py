"""The command line ``tsallis``, see :mod:`torchrl_tsallis.commands`: errors become one line and an exit code.

====  ===========================================================================
code  meaning
====  ===========================================================================
0     done
1     an error, or a command that cannot be understood; one line on stderr says it
2     done, but not usable enough for ``--fail-below``
130   stopped by Ctrl-C; nothing was written
====  ===========================================================================
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

#: What is said of a command that fails; anything else is a fault of this package, and shows where.
_ERRORS = (OSError, KeyError, TypeError, ValueError, ImportError, RuntimeError, ArithmeticError, MemoryError)


def _line(error: BaseException) -> str:
    """An error as one line."""
    first = error.args[0] if isinstance(error, KeyError) and error.args else error
    return " ".join(str(first).split()) or type(error).__name__


@contextmanager
def _logs_on_stderr() -> Iterator[None]:
    """TorchRL's logger writes to stdout, where only answers belong."""
    handlers = [h for h in logging.getLogger("torchrl").handlers if isinstance(h, logging.StreamHandler)]
    before = [handler.setStream(sys.stderr) for handler in handlers]
    try:
        yield
    finally:
        for handler, stream in zip(handlers, before, strict=True):
            if stream is not None:
                handler.setStream(stream)


def main(args: Sequence[str] | None = None) -> None:
    """Runs a command and exits.

    Args:
        args: of the command. Default: those of the process.

    Raises:
        SystemExit: always, with the exit code.
    """
    given = list(sys.argv[1:] if args is None else args)
    try:
        import tyro
    except ImportError:
        sys.stderr.write("tsallis: the command line needs tyro: pip install 'torchrl-tsallis[cli]'\n")
        sys.exit(1)
    from torchrl_tsallis.commands import COMMANDS

    try:
        with _logs_on_stderr():
            call = tyro.extras.subcommand_cli_from_dict(
                COMMANDS, args=given, prog="tsallis", config=(tyro.conf.FlagCreatePairsOff,)
            )
            code = call(given)
    except SystemExit as stop:  # of tyro: 0 after --help, 2 for what it cannot parse, which has another meaning here
        code = 1 if stop.code else 0
    except KeyboardInterrupt:
        sys.stderr.write("tsallis: stopped; nothing was written\n")
        code = 130
    except _ERRORS as error:
        sys.stderr.write(f"tsallis: {_line(error)}\n")
        code = 1
    sys.exit(code)


if __name__ == "__main__":
    main()
