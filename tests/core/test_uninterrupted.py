"""Ctrl-C during an import takes effect after it, so that the packages of the import can be used."""

import signal
import subprocess
import sys
import textwrap
import threading

import pytest

from armctl import ArmctlError
from armctl.core.uninterrupted import uninterrupted_import


@pytest.fixture
def ctrl_c():
    """Ctrl-C raises KeyboardInterrupt, also in a job in the background, which begins with a shell that ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_an_interrupt_is_delivered_after_the_block():
    before = signal.getsignal(signal.SIGINT)
    reached = []

    def import_something():
        with uninterrupted_import():
            signal.raise_signal(signal.SIGINT)
            reached.append("the end")

    with pytest.raises(KeyboardInterrupt):
        import_something()
    assert reached
    assert signal.getsignal(signal.SIGINT) is before


def test_an_import_in_another_thread_changes_no_handler():
    handlers = []

    def look():
        with uninterrupted_import():
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


@pytest.mark.parametrize("text", ['generic_type: type "MjSpec" is already registered!', "initialization failed"])
def test_a_half_import_is_one_sentence(text: str):
    with pytest.raises(ArmctlError, match=r"cannot be repeated .*; start Python again$"), uninterrupted_import():
        raise ImportError(text)


def test_another_failed_import_stays_what_it_is():
    with pytest.raises(ModuleNotFoundError, match="No module named 'absent'"), uninterrupted_import():
        raise ModuleNotFoundError("No module named 'absent'")


@pytest.mark.parametrize("module", ["mujoco._structs", "mujoco._specs", "coal", "pinocchio.pinocchio_pywrap_default"])
def test_an_interrupted_first_call_can_be_repeated(module: str):
    code = f"""
        import signal, sys
        signal.signal(signal.SIGINT, signal.default_int_handler)
        import armctl

        class Interrupt:
            def find_spec(name, path, target=None):
                if name == {module!r}:
                    signal.raise_signal(signal.SIGINT)

        sys.meta_path.insert(0, Interrupt)
        try:
            armctl.load
        except KeyboardInterrupt:
            print("interrupted")
        assert {module!r} in sys.modules
        print(armctl.load("robot_arm_3dof").n)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["interrupted", "3"], done.stderr
