"""`python franka_sim_judge.py STREAMS.npz`: what franka-sim's controller says of streams of positions, one line each.

The checks of its server, one row after the other, without network and clock: no row is late. It needs an environment of its
own, which `make franka-sim` makes.
"""

import sys

import numpy as np


def verdict(rows: np.ndarray) -> str:
    from franka_sim.control_modes import ControlMode
    from franka_sim.motion_limits import MotionLimitChecker

    checker = MotionLimitChecker(enforce=True)
    start = {"q": rows[0].tolist(), "q_d": rows[0].tolist(), "dq_d": [0.0] * 7, "ddq_d": [0.0] * 7}
    checker.start_motion(ControlMode.POSITION, start)
    for tick, row in enumerate(rows.tolist(), start=1):
        checker.note_published(tick)
        found = checker.absorb_command({"message_id": tick, "q_c": row}, row, fresh=True, enforce=True)
        if found.violation is not None:
            return found.violation.describe()
    return "passed"


if __name__ == "__main__":
    streams = np.load(sys.argv[1])
    for name in streams:
        print(verdict(streams[name]))
