"""The tip meets a part on a conveyor with the part's velocity, stays with it for half a second, and leaves."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
belt = np.array([0.0, 0.15, 0.0])  # m/s
part = arm.fk(arm.home).position + np.array([0.03, -0.15, 0.03])  # m, where the part is at t = 0


def with_the_part(t: float) -> armctl.Setpoint:
    """The joints, and their velocity, with which the tip is on the part at a time."""
    solution = armctl.solve_ik(arm, armctl.Target.read(part + t * belt), arm.home)
    assert solution.ok, solution.reason
    v = np.linalg.solve(arm.jacobian(solution.q)[:3], belt)
    return armctl.Setpoint(solution.q, v, np.zeros(3))


meeting = next(
    t for t in np.arange(0.1, 2.0, 0.05) if armctl.move_j(arm, arm.home, with_the_part(t), straight=False).duration <= t
)
approach = armctl.move_j(arm, arm.home, with_the_part(meeting), straight=False, duration=meeting)
now = approach(meeting)
print(f"the tip meets the part after {meeting:.2f} s, and moves with it at {(arm.jacobian(now.q)[:3] @ now.v)[1]:.3f} m/s")

stream = armctl.Stream(arm, now)  # follows what a sensor measures
worst = 0.0
while stream.t < 0.5:
    stream.push(stream.t, *with_the_part(meeting + stream.t)[:2])
    tip = arm.fk(stream.step(0.02).q).position
    worst = max(worst, float(np.linalg.norm(tip - part - (meeting + stream.t) * belt)))
print(f"for {stream.t:.2f} s it stays within {1e3 * worst:.2f} mm of the part")

away = armctl.move_j(arm, stream.setpoint, arm.home, straight=False, duration=1.0)
print(f"and is home {away.duration:.2f} s later, inside all limits: {away.check_limits().ok}")
