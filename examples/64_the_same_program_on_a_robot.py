"""The same program on a simulation, on a simulated robot behind a link, and on a Franka at an address."""

import sys
from pathlib import Path

import armctl

arm = armctl.load("fr3", tool=Path(__file__).with_name("franka_hand.xml"))
robots: list[armctl.Robot | armctl.Simulation] = [armctl.Simulation(arm), armctl.Robot(arm, armctl.links.PlantLink(arm))]
addresses = [word for word in sys.argv[1:] if word.count(".") == 3]
robots += [armctl.Robot(arm, armctl.links.Franka(address, real_time=False)) for address in addresses]
for robot in robots:
    print(robot.move_j([-0.3, 0.1, 0.3, -1.6, 0.1, 1.8, 0.7]))
    print(robot.move_to([0.45, 0.2, 0.4]))
    print(robot.move_l(armctl.Pose([0.45, 0.2, 0.5], robot.tip.quat)))
    print(robot.move_l([1.5, 0, 0.2]))
    print(f"{robot.log.plant}: {len(robot.log)} ticks of {1e3 * robot.dt:g} ms in the last move")
    if isinstance(robot, armctl.Robot):
        robot.close()
