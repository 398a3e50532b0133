"""Follow a target that moves through an obstacle: the tip moves around the obstacle and returns to the target."""

import tempfile
from pathlib import Path

import mujoco
import numpy as np

import armctl
from armctl.model.loading.catalog import locate

spec = mujoco.MjSpec.from_file(str(locate("robot_arm_3dof").path))
spec.worldbody.add_geom(name="post", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.03, 0.15, 0.0], pos=[0.42, 0.0, 0.15])
path = Path(tempfile.mkdtemp()) / "post.xml"
path.write_text(spec.to_xml())
arm = armctl.load(path)

dt, post = 0.01, np.array([0.42, 0.0])
q = armctl.solve_ik(arm, [0.42, -0.3, 0.25]).q
ik = armctl.DifferentialIk(arm, avoid=True)
nearest, farthest = np.inf, 0.0
for t in np.arange(0.0, 6.0, dt):
    target = [0.42, -0.3 + 0.6 * min(t / 4.0, 1.0), 0.25]
    q = q + dt * ik.step(q, target, dt)
    tip = arm.fk(q).position
    nearest = min(nearest, float(np.linalg.norm(tip[:2] - post)))
    farthest = max(farthest, float(np.linalg.norm(tip - target)))

print(f"the tip passed {1e3 * nearest:.0f} mm from the middle of the post, up to {1e3 * farthest:.0f} mm off the target")
print(f"at the end it is {1e3 * np.linalg.norm(arm.fk(q).position - target):.3f} mm off: {ik.status}")
