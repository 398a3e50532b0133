"""All configurations for one pose, the names of their branches, and the branch in which a line is fastest."""

import armctl

arm = armctl.load("ur5e")
target = armctl.Pose([0.3, 0.25, 0.4], quat=arm.fk(arm.home).quat)

found = armctl.solve_ik_all(arm, target)
print(f"{len(found)} solutions, proved to be all: {found.is_complete}")
for q, branch in zip(found.q, found.branch, strict=True):
    print(f"{branch}  {q.round(2)}")

nearest = armctl.solve_ik(arm, target, q0=arm.home, nearest=True)
print(f"the nearest to home is in branch {nearest.branch}")

end = armctl.Pose([-0.3, 0.3, 0.3], quat=target.quat)
motion = armctl.move_l(arm, target, end)  # begins at a pose: the branch is chosen for the whole line
print(f"the line takes {motion.duration:.3f} s from {motion(0.0).q.round(2)}")
