"""The command line in a process of its own that obeys Ctrl-C."""

import sys

# Python leaves SIGINT ignored if its parent ignores it, as for a suite that runs in the background of a shell.
_OBEYING_SIGINT = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from armctl.cli.main import main
sys.exit(main())
"""


def armctl_command(*arguments: str) -> list[str]:
    """The command for `subprocess`."""
    return [sys.executable, "-c", _OBEYING_SIGINT, *arguments]
