"""20 N on walls: overshoot, settling and steady error of hybrid force control, beside impedance control.

    python benchmarks/force.py [--out benchmarks/results/force.md]

The tip starts 2 mm from a plate. Impedance control is told where the plate is, 1 mm wrong; hybrid force control is not. The
force is the sum of the contact forces that MuJoCo reports for the plate, not the measurement of the controller.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import mujoco
import numpy as np

import armctl
from armctl.core.tables import Table
from armctl.core.trajectory import Setpoint

FORCE_N = 20.0
GAP_M = 0.002
TICK_S = 0.001
SECONDS = 1.3
HALF_EDGE_M = 0.15
STIFFNESS_N_M = 2000.0
ARMS = {"robot_arm_3dof": (2, 1.0), "panda": (2, -1.0), "xarm7": (1, 1.0), "gen3": (0, 1.0)}  # axis and direction of the force
WALLS = {"soft": 0.0632, "default": 0.02, "stiff": 0.00632}  # solref[0], s: a tenth, once and ten times the stiffness
PLANTS = {
    "ideal": armctl.Plant(timestep=TICK_S),
    "delay 4 ms": armctl.Plant(timestep=TICK_S, delay=4),
    "noise": armctl.Plant(timestep=TICK_S, force_noise=0.3, moment_noise=0.01, encoder_noise=1e-5, wrench_delay=4),
}


class Hold:
    """A reference that stands still."""

    duration = SECONDS

    def __init__(self, q: np.ndarray):
        self.q = q

    def __call__(self, t: float) -> Setpoint:
        return Setpoint(self.q, 0 * self.q, 0 * self.q)

    def sample(self, times: np.ndarray) -> Setpoint:
        q = np.tile(self.q, (len(times), 1))
        return Setpoint(q, 0 * q, 0 * q)


class Watched:
    """A controller, and the force on the plate by MuJoCo's contacts at every tick."""

    needs_wrench = True
    name = "watched"

    def __init__(self, controller, wall: int, axis: int):
        self.controller = controller
        self.wall = wall
        self.axis = axis
        self.force: list[float] = []

    def torque(self, state, setpoint):
        total = 0.0
        contact_force = np.zeros(6)
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            if self.wall in contact.geom:
                mujoco.mj_contactForce(self.model, self.data, i, contact_force)
                total += abs((contact.frame.reshape(3, 3).T @ contact_force[:3])[self.axis])
        self.force.append(total)
        return self.controller.torque(state, setpoint)


def at_wall(name: str, time_constant: float) -> tuple[armctl.Arm, int]:
    """An arm whose hand is GAP_M from a plate, and the plate's geom."""
    axis, sign = ARMS[name]
    size = np.full(3, 2 * HALF_EDGE_M)
    size[axis] = 0.04
    arm = armctl.load(name, scene=armctl.Scene().add_box("wall", size, at=[9, 9, 9]))
    model = arm.model
    wall = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "wall")
    model.geom_solref[wall] = [time_constant, 1.0]
    model.geom_priority[wall] = 1
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    arm.joint_map.set_positions(data.qpos, arm.home)
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] and model.geom_contype[g]]
    face = sign * arm.fk(arm.home).position[axis] + 0.5
    for _ in range(30):
        position = arm.fk(arm.home).position.copy()
        position[axis] = sign * (face + 0.02)
        model.body_pos[model.geom_bodyid[wall]] = position
        mujoco.mj_kinematics(model, data)
        face -= min(mujoco.mj_geomDistance(model, data, g, wall, 2.0, None) for g in moving) - GAP_M
    return arm, wall


def row(name: str, wall_name: str, law: str, plant_name: str) -> list[str]:
    axis, sign = ARMS[name]
    arm, wall = at_wall(name, WALLS[wall_name])
    motion = Hold(arm.home)
    if law == "hybrid-force":
        controller = armctl.HybridForce(arm, {"xyz"[axis]: sign * FORCE_N})
    else:
        stiffness = np.full(6, STIFFNESS_N_M)
        stiffness[3:] = 0.0 if arm.n < 6 else 50.0
        controller = armctl.Impedance(arm, stiffness=stiffness)
        goal = arm.fk(arm.home).position.copy()
        goal[axis] += sign * (GAP_M + 0.001 + FORCE_N / STIFFNESS_N_M)
        target = goal if arm.n < 6 else armctl.Pose.from_rotation(goal, arm.fk(arm.home).rotation)
        motion = armctl.move_l(arm, arm.home, target, tip_speed=0.05)
    watched = Watched(controller, wall, axis)
    simulation = armctl.Simulation(arm, watched, PLANTS[plant_name])
    watched.model = simulation.model
    watched.data = simulation.data
    simulation.run(motion, dwell=SECONDS - min(SECONDS, motion.duration))
    force = np.array(watched.force)
    first = int(np.argmax(force > 0.02 * FORCE_N))
    outside = np.flatnonzero(np.abs(force - FORCE_N) > 0.05 * FORCE_N)[-1]
    settled = f"{(outside + 1 - first) * TICK_S:.3f}" if outside < len(force) - 1 else "never"
    steady = force[-200:].mean()
    return [name, wall_name, plant_name, law, f"{100 * (force.max() / FORCE_N - 1):.1f}", settled, f"{steady - FORCE_N:+.3f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "force.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    rows = [row(name, wall, "hybrid-force", plant) for name in ARMS for wall in WALLS for plant in PLANTS]
    rows += [row(name, "default", "impedance", "ideal") for name in ARMS]
    columns = [
        "arm",
        "wall",
        "plant",
        "law",
        "overshoot, % (target 10)",
        "within 5 % after, s (target 0.1)",
        "steady error, N (0.1)",
    ]
    text = (
        f"**20 N on a wall, overshoot from the first contact on (targets in brackets)**\n\n{Table(columns, rows).markdown()}\n"
    )
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
