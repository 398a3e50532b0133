"""A LinkHost in a process of its own, with a lease: without a request of the planner, the arm brakes on its path."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection, Pipe
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

from armctl.core.errors import ArmctlError, LinkError
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.run.links.host import LinkHost, Played, Progress
from armctl.run.links.link import HandReading, Link, Reading
from armctl.run.links.torque_loop import LinkLaw

_QUESTION_INTERVAL_S = 0.02
_ANSWER_TIMEOUT_S = 30.0  # a hand closes in some seconds
_CLOSE_TIMEOUT_S = 10.0
_PLANNER_ENDED = "the planner ended; the arm braked on its path"
_SWITCH_INTERVAL_S = 1e-4  # Python's 5 ms between two threads lose ticks of 1 ms


def serve(descriptor: int) -> None:
    """The life of the process: opens a link, answers the planner, and brakes and closes when the planner is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    connection = Connection(descriptor)
    link, lease, law = connection.recv()
    host = LinkHost(link, law)
    gc.disable()  # a collection lasts longer than a tick
    calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
    listener = Thread(target=_listen, args=(connection, host, lease, calls), daemon=True)
    listener.start()
    try:
        while True:
            if not listener.is_alive():
                host.stop(_PLANNER_ENDED)  # where it ended while a stream began
            if host.streaming:
                host.advance()
            elif not listener.is_alive():
                return
            else:
                with contextlib.suppress(Empty):
                    calls.get(timeout=_QUESTION_INTERVAL_S)()
    finally:
        host.close()


def _listen(connection: Connection, host: LinkHost, lease: float, calls: SimpleQueue[Callable[[], None]]) -> None:
    """Takes requests of the planner. Those for an open stream are answered here, all others where the link is used."""
    heard = time.monotonic()
    while True:
        try:
            if connection.poll(_QUESTION_INTERVAL_S):
                number, request, arguments = connection.recv()
                heard = time.monotonic()
                if request == "close":
                    break
                if request == "poll" or (host.streaming and request in ("play", "stop", "read")):
                    _answer(connection, host, number, request, arguments)
                else:
                    calls.put(partial(_answer, connection, host, number, request, arguments))
            elif time.monotonic() - heard > lease:
                host.stop(f"the planner sent nothing for {lease:g} s; the arm braked on its path")
        except (EOFError, OSError):
            break
    host.stop(_PLANNER_ENDED)


def _answer(connection: Connection, host: LinkHost, number: int, request: str, arguments: tuple[Any, ...]) -> None:
    try:
        answer = getattr(host, request)(*arguments)
    except ArmctlError as error:
        answer = error
    except Exception as error:  # of a maker's client
        answer = LinkError(f"{type(error).__name__}: {error}")
    with contextlib.suppress(OSError):  # the planner may be gone
        connection.send((number, answer))


class RemoteHost:
    """A LinkHost in a process of its own, with the same methods."""

    def __init__(self, link: Link, lease: float, law: LinkLaw | None = None):
        """Starts the process, which brakes the arm after `lease` s without a request; it computes a law if there is one."""
        self._connection, other = Pipe()
        self._requests = 0
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "armctl.run.links", str(other.fileno())],
            stdin=subprocess.DEVNULL,
            pass_fds=[other.fileno()],
            env=environment,
            start_new_session=True,  # Ctrl-C is for the planner, which brakes the arm
        )
        other.close()
        self._connection.send((link, lease, law))

    def open(self) -> None:
        self._call("open")

    def read(self) -> Reading:
        return self._call("read")

    def tip(self) -> Array | None:
        return self._call("tip")

    def recover(self) -> None:
        self._call("recover")

    def measure_delay(self) -> float:
        return self._call("measure_delay")

    def read_hand(self) -> HandReading:
        return self._call("read_hand")

    def move_hand(self, width: float) -> bool:
        return self._call("move_hand", width)

    def close_hand(self, force: float) -> bool:
        return self._call("close_hand", force)

    def play(self, pieces: Pieces, at: int | None, limits: Limits, delay: int = 0) -> Played:
        return self._call("play", pieces, at, limits, delay)

    def stop(self, reason: str) -> None:
        self._call("stop", reason)

    def poll(self) -> Progress:
        """What the stream did since the last question; the question keeps the lease."""
        return self._call("poll")

    def close(self) -> None:
        """Ends the process, which brakes first."""
        with contextlib.suppress(OSError):
            self._connection.send((0, "close", ()))
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_TIMEOUT_S)
        self._process.kill()
        self._process.wait()
        self._connection.close()

    def _call(self, request: str, *arguments: Any) -> Any:
        try:
            self._requests += 1
            self._connection.send((self._requests, request, arguments))
            number = 0
            answer = None
            while number != self._requests:  # Ctrl-C may have left the answer to the request before
                if not self._connection.poll(_ANSWER_TIMEOUT_S):
                    raise LinkError(f"the process that holds the link does not answer within {_ANSWER_TIMEOUT_S:g} s")
                number, answer = self._connection.recv()
        except (EOFError, OSError):
            raise LinkError("the process that holds the link ended; make a new Robot") from None
        if isinstance(answer, Exception):
            raise answer
        return answer
