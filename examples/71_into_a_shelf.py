"""Into a shelf and out again: a Panda reaches between two boards, and every motion has a proved clearance."""

import numpy as np

import armctl

scene = armctl.World()
for name, height in (("lower", 0.25), ("middle", 0.6), ("upper", 0.95)):
    scene.add(name, armctl.Box([0.3, 0.8, 0.02]), [0.85, 0.0, height])
scene.add("back", armctl.Box([0.02, 0.8, 0.72]), [1.01, 0.0, 0.6])

arm = armctl.load("panda", scene=scene)
forwards = np.column_stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # the tip's z axis points into the shelf
poses = [armctl.Pose.from_rotation([0.74, y, z], forwards) for y, z in ((-0.2, 0.42), (0.2, 0.77))]

sim = armctl.Simulation(arm)
for pose in poses:
    q = sim.state.q
    straight = armctl.move_j(arm, q, armctl.solve_ik(arm, pose, q).q)
    print("straight:", armctl.check_clearance(arm, straight))
    planned = armctl.move_free(arm, q, pose)
    print("planned: ", armctl.check_clearance(arm, planned), f"in {planned.duration:.2f} s")
    print("moved:   ", sim.move_to(pose), "| touched:", list(sim.log.contacts) or "nothing")
