"""The command line `escape`.

Commands parse options, run a procedure or query, and print; the work itself is in escape_hw.runtime.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from escape_hw.cli.output import Output


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``escape``; ends the process with the command's exit code."""
    with Output(document="--json" in (sys.argv[1:] if arguments is None else arguments)) as output:
        try:
            from escape_hw.cli.app import run

            run(arguments)
        except KeyboardInterrupt:
            # Before a command has taken Ctrl-C over nothing is open.
            sys.stderr.write("stopped before anything was opened\n")
            _exit_without_teardown(130)
        except SystemExit as ended:
            ended.code = output.verdict(ended.code)
            # Only where the process is ours alone, and somebody has pressed Ctrl-C and waits.
            if arguments is None and ended.code == 130:
                _exit_without_teardown(130)
            raise


def _exit_without_teardown(code: int) -> None:
    """End the process without taking the interpreter apart, which takes a second with all loaded.

    The devices are closed and the files written; what was registered to happen at exit happens.
    """
    import atexit
    import logging
    import os

    atexit._run_exitfuncs()
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
