"""CFunctionLaw: a compiled C function as the law of a controller."""

from __future__ import annotations

from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.interface import MAX_JOINTS
from armctl.core.validation import array, flag, integer

MAX_MEMORY = 1_000_000
_MAX_ADDRESS = 2.0**63


class CFunctionLaw(_core.CFunctionLaw):
    """A compiled C function as a law, for `CompiledController.make_law`.

    The function has seven pointers to numbers and a count, and returns nothing: `parameters`, q (n,), v (n,), the reference
    (5, n) with the rows q, v, a, v_tick and a_tick of a `Setpoint`, the wrench (6,), `memory`, tau (n,), and n. It writes tau.
    How many of `parameters` and `memory` it uses cannot be checked: it must not read or write behind them.
    """

    def __init__(
        self, address: int, *, n: int, parameters: ArrayLike, memory_size: int = 0, needs_wrench: bool = False
    ) -> None:
        """A law from the address of its function, which has to exist as long as the law.

        Args:
            address: That of the function, such as `numba.cfunc(...)(f).address`.
            n: The number of joints.
            parameters: (k,) what the function gets as `parameters`.
            memory_size: How many numbers it keeps from tick to tick; they are 0 at the first tick of a run.
            needs_wrench: Whether it reads the wrench.

        Raises:
            InputError: The address is 0, or an argument is of another kind or outside its bounds.
        """
        super().__init__(
            integer("address", address, 1, _MAX_ADDRESS),
            n=integer("n", n, 1, MAX_JOINTS),
            parameters=array("parameters", parameters, 1, finite=False),
            memory_size=integer("memory_size", memory_size, 0, MAX_MEMORY),
            needs_wrench=flag("needs_wrench", needs_wrench),
        )
