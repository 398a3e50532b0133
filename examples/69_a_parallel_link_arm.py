"""A parallel link arm: three motors move nine joints in closed loops, the tool stays level, and the loops stay closed."""

from pathlib import Path

import mujoco
import numpy as np

import armctl

arm = armctl.load(Path(__file__).parent / "models/parallel_link_arm.xml")
print(arm)
print(next(note for note in arm.notes if note.startswith("closed loops")))

place = armctl.solve_ik(arm, [0.5, -0.6, 0.3])
print(place)
elbow, level = (arm.qpos(place.q)[arm.model.joint(name).qposadr[0]] for name in ("elbow", "level"))
print(f"passive joints there: elbow {elbow:.3f} rad, level {level:.3f} rad")

sim = armctl.Simulation(arm)
data = mujoco.MjData(arm.model)
for point in ([0.85, 0.3, 0.3], [0.85, 0.3, 0.9], [0.5, -0.6, 0.3]):
    result = sim.move_to(np.array(point))
    tilt = np.degrees(np.arccos(np.clip(-sim.tip.rotation[2, 2], -1.0, 1.0)))
    gaps = []
    for q in result.log.q_ref:
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_fwdPosition(arm.model, data)
        gaps.append(np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max())
    print(f"{result}; the tool is {tilt:.2f} deg off level, loops open by at most {max(gaps):.1g} m at {len(gaps)} setpoints")

try:
    armctl.move_j(arm, arm.home, [0.0, 1.2, -1.2])
except armctl.LimitError as error:
    print(error)
