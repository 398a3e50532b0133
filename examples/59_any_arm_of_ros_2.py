"""One program on a simulation, on a simulated robot behind a link, and on an arm that is reached through ROS 2."""

import os
import random
import subprocess
import sys

import armctl

ROBOT = "robot_arm_3dof"


def program(robot: armctl.Simulation | armctl.Robot) -> None:
    for target in ([0.3, 0.2, 0.3], [0.3, -0.1, 0.35], [3.0, 0.0, 0.0]):
        result = robot.move_to(target)
        print(
            f"  {result.ok}: {1e3 * result.position_error:.0f} mm from {target}" if result.ok else f"  refused: {result.reason}"
        )


def main() -> None:
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # the nodes stay on this computer
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))
    # Here a simulation is served; with a robot, its driver runs instead of this process.
    served = subprocess.Popen([sys.executable, "-m", "armctl", "ros2", "serve", ROBOT])
    try:
        arm = armctl.load(ROBOT)
        print("Simulation:")
        program(armctl.Simulation(arm))
        for link in (armctl.links.PlantLink(arm), armctl.links.ROS2(arm)):
            print(f"{link.name}:")
            with armctl.Robot(arm, link) as robot:
                program(robot)
    finally:
        served.terminate()
        served.wait()


if __name__ == "__main__":
    main()
