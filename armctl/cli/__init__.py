"""The command line. `program` is the entry point of `armctl`; each command has a module."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import time
from types import FrameType

_AGAIN_AFTER_S = 0.01
_IMPORTING = "<frozen importlib._bootstrap>"
INTERRUPTED = 130  # exit status of a program that Ctrl-C ends, 128 + SIGINT


def program() -> int:
    """Runs the command of this process, from the first import to the last line of output.

    Ctrl-C ends it at any moment with status 130 and without a traceback, also if the parent process ignores SIGINT.
    """
    status = INTERRUPTED
    try:
        try:
            signal.signal(signal.SIGINT, interrupt)
            sys.unraisablehook = unraisable_hook
            from armctl.cli.main import main

            status = main()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to interrupt
    except BaseException as error:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if not _is_interrupt(error):
            raise
        status = INTERRUPTED
    _end_if_busy(status)
    return status


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C caused an error: Python 3.11 wraps what is raised while a class is made in a RuntimeError."""
    return isinstance(error, KeyboardInterrupt) or (error is not None and _is_interrupt(error.__cause__ or error.__context__))


def _end_if_busy(status: int) -> None:
    """Ends the process at once after Ctrl-C, or if a thread of armctl still compiles or plans, which may take many seconds.

    Python would end such a thread anyway. The bindings would report the objects in its hands as leaks, and abort where a thread
    returns from compiled code while Python ends.
    """
    if status == INTERRUPTED or any(thread.name.startswith("armctl") for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def interrupt(signum: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt as soon as no module is being imported: packages do not expect it then, and some abort."""
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTING:
            _interrupt_again()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def unraisable_hook(unraisable: sys.UnraisableHookArgs) -> None:
    """Raises a KeyboardInterrupt again that Python could not raise, for example in a callback of a C library."""
    if unraisable.exc_type is KeyboardInterrupt:  # raised here, it would end in this hook
        _interrupt_again()
    else:
        sys.__unraisablehook__(unraisable)


def _interrupt_again() -> None:
    """Repeats SIGINT a moment later."""
    _thread.start_new_thread(_interrupt_later, ())  # threading.Thread takes locks that the main thread may hold


def _interrupt_later() -> None:
    time.sleep(_AGAIN_AFTER_S)
    main = threading.main_thread().ident
    if main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # it interrupts a call that waits, as `_thread.interrupt_main` does not
