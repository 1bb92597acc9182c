"""The command line `escape`.

Commands parse options, run a procedure or query, and print; the work itself is in escape_hw.runtime.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from escape_hw.cli.caches import provide_caches
from escape_hw.cli.output import OutputStreams


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``escape``; ends the process with the command's exit code."""
    with OutputStreams(document="--json" in (sys.argv[1:] if arguments is None else arguments)) as output:
        try:
            provide_caches()
            from escape_hw.cli.app import run

            run(arguments)
        except KeyboardInterrupt:
            # Commands handle Ctrl-C themselves once a device may be open.
            sys.stderr.write("stopped before anything was opened\n")
            _exit_without_teardown(130)
        except SystemExit as ended:
            ended.code = output.exit_code(ended.code)
            # In a process of its own, after Ctrl-C.
            if arguments is None and ended.code == 130:
                _exit_without_teardown(130)
            raise


def _exit_without_teardown(code: int) -> None:
    """End the process without unloading all modules, which takes about a second.

    Devices are closed and files written by then; functions registered with :mod:`atexit` are called.
    """
    import atexit
    import logging
    import os

    atexit._run_exitfuncs()  # noqa: SLF001
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
