"""The kernel of a controller with limited torque rates: it calls the kernel of another controller."""

# Intrinsics are called without their first argument.
# pyright: reportCallIssue=false

from __future__ import annotations

from armctl.control.kernel_call import call_kernel
from armctl.core.addresses import as_integer, vector
from armctl.core.jit import njit, njit_borrowing

# The parameters begin with integers in the place of floats; then follow the largest changes of the torques (n,).
KERNEL = 0  # addresses and sizes, of the controller that is called
NEEDS_WRENCH = 1
PARAMETERS = 2
PARAMETERS_SIZE = 3
MEMORY = 4
MEMORY_SIZE = 5
HEADER = 6

# The memory begins with the wrench; then follow a flag whether there is a last torque, and that torque (n,).
WRENCH_SIZE = 6
MEMORY_HEADER = 7


@njit_borrowing
def rate_limited(params, q, v, reference, memory, tau):
    """The law of `TorqueRateLimit`."""
    parameters = vector(as_integer(params[PARAMETERS]), as_integer(params[PARAMETERS_SIZE]))
    called_memory = vector(as_integer(params[MEMORY]), as_integer(params[MEMORY_SIZE]))
    if as_integer(params[NEEDS_WRENCH]) != 0:
        for k in range(WRENCH_SIZE):
            called_memory[k] = memory[k]
    if call_kernel(as_integer(params[KERNEL]), parameters, q, v, reference, called_memory, tau):
        raise RuntimeError("the kernel of the limited controller raised an exception")
    limit_rate(params[HEADER:], memory[MEMORY_HEADER - 1 :], tau)


@njit
def limit_rate(change, memory, tau):
    """Limits the change (n,) of a torque since the last one; memory is whether there is one, and that one (n,)."""
    for i in range(tau.shape[0]):
        if memory[0] != 0.0:
            if tau[i] > memory[1 + i] + change[i]:
                tau[i] = memory[1 + i] + change[i]
            elif tau[i] < memory[1 + i] - change[i]:
                tau[i] = memory[1 + i] - change[i]
        memory[1 + i] = tau[i]
    memory[0] = 1.0
