"""Imports that Ctrl-C does not interrupt: packages with compiled code cannot be imported again after half an import."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from armctl.core.errors import ArmctlError

# What the bindings of MuJoCo and Pinocchio report when their import was interrupted before.
_HALF_IMPORTED = ("initialization failed", "already registered")


@contextmanager
def uninterrupted_import() -> Iterator[None]:
    """Delays Ctrl-C to the end of the block, which imports packages. Other threads get no signals anyway.

    ArmctlError if an import that was interrupted before has left a package that cannot be imported.
    """
    handler = signal.getsignal(signal.SIGINT)
    is_held = threading.current_thread() is threading.main_thread() and callable(handler)
    pressed: list[int] = []
    blocked: set[int] = set()
    if is_held:
        signal.signal(signal.SIGINT, lambda number, _frame: pressed.append(number))
        if sys.platform != "win32":  # the import of glfw runs a child process, which inherits what is blocked
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    except ImportError as error:
        if any(text in str(error) for text in _HALF_IMPORTED):
            raise ArmctlError(
                f"an import was interrupted before and cannot be repeated ({error!s:.120}); start Python again"
            ) from None
        raise
    finally:
        if is_held:
            if sys.platform != "win32":
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            signal.signal(signal.SIGINT, handler)
            if pressed:
                signal.raise_signal(signal.SIGINT)
