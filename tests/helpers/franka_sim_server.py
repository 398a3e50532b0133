"""`python franka_sim_server.py ADDRESS`: franka-sim with all limits of the controller enforced, on one loopback address.

It needs an environment of its own, which `make franka-sim` makes, and FR3_MJCF, the file of the model.
"""

import sys
import threading


def main() -> None:
    from franka_sim.franka_sim_server import FrankaSimServer

    server = FrankaSimServer(host=sys.argv[1], enforce_comm_constraints=True, enforce_motion_limits=True, enable_gripper=False)
    threading.Timer(8.0, lambda: print("ready", flush=True)).start()
    server.start()


if __name__ == "__main__":
    main()
