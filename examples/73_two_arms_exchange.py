"""Two Pandas at one table exchange places: their motions are planned together, with a proved clearance."""

import mujoco
import mujoco_menagerie
import numpy as np

import armctl

spec = mujoco.MjSpec()
spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # as the Pandas have it
spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.6, 0.8, 0.02], pos=[0.5, 0, -0.03])
for side, y in (("left", 0.3), ("right", -0.3)):
    panda = mujoco_menagerie.get("franka_emika_panda").spec()
    spec.attach(panda, prefix=f"{side}_", frame=spec.worldbody.add_frame(pos=[0, y, 0]))
arm = armctl.load(spec)
left, right = arm.tips
sim = armctl.Simulation(arm)


def down(x: float, y: float) -> armctl.Pose:
    """A hand that points down above the table."""
    return armctl.Pose.from_rotation([x, y, 0.3], np.diag([1.0, -1.0, -1.0]))


for places in ({left: down(0.5, 0.15), right: down(0.5, -0.15)}, {left: down(0.5, -0.15), right: down(0.5, 0.15)}):
    result = sim.move_to(places)
    for tip, pose in sim.tips.items():
        print(f"{tip} at y = {pose.position[1]:+.2f} m")
    print(f"{result}; touched {[*map(str, result.contacts)] or 'nothing'}")
