"""Whether the Python loop, which gives the same bits, runs some ticks in less time than it takes to compile the other one."""

from __future__ import annotations

from typing import Any

from armctl.core.python_kernel import compiles_at_once


class PythonTicks:
    """The ticks for which a process does not compile the loop.

    Attributes:
        left: How many there are still. All of them take about two seconds, and the compiler takes five.
    """

    left = 4000

    @classmethod
    def suffice(cls, controller_kernel: Any, ticks: float) -> bool:
        """Takes the ticks of a run if they are few, and if compiled code is missing.

        Args:
            controller_kernel: The kernel of the controller.
            ticks: How long the run is; infinite if it is not known.

        Returns:
            True if the run should use the Python loop.
        """
        from armctl.control.kernel_call import has_code
        from armctl.sim.tick_kernel import run_table

        if ticks > cls.left or compiles_at_once() or (run_table.has_code() and has_code(controller_kernel)):
            return False
        cls.left -= int(ticks)
        return True
