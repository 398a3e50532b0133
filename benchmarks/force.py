"""20 N on walls: overshoot, settling and steady error of hybrid force control, beside impedance control.

    python benchmarks/force.py [--out benchmarks/results/force.md]

The tip starts 2 mm from a plate. Impedance control is told where the plate is, 1 mm wrong; hybrid force control is not. The
force is the sum of the contact forces that MuJoCo reports for the plate, not the measurement of the controller. The stiffness
of the wall is this force divided by the depth in the wall at the end.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from markdown_table import titled_table

import armctl

FORCE_N = 20.0
GAP_M = 0.002
TICK_S = 0.001
SECONDS = 2.0
HALF_EDGE_M = 0.05
HALF_THICKNESS_M = 0.05
STIFFNESS_N_M = 2000.0
ARMS = ["robot_arm_3dof", "desk_arm", "panda", "panda/panda_nohand", "ur5e", "iiwa14", "xarm7", "gen3"]
FILES = {"desk_arm": Path(__file__).parents[1] / "examples" / "models" / "desk_arm.urdf"}
STARTS = {"desk_arm": armctl.Pose([0.35, 0.0, 0.2], rpy=[0.0, np.pi, 0.0])}  # it is stretched out at home
WITH_PROBE = ("ur5e", "desk_arm")
WITH_FINGERS = ("panda", "xarm7")
# The shape of the UR5e's second wrist link reaches to the flange. Without a probe it presses on the wall too, where no flange
# sensor measures.
SHIELDED = "ur5e/ur5e"
PROBE = """<mujoco model="probe"><worldbody><body name="probe"><geom type="sphere" size="0.01" pos="0 0 0.05" mass="0.05"/>
  <site name="tip" pos="0 0 0.06"/></body></worldbody></mujoco>"""
# By MuJoCo's time constant solref[0], s: a tenth, once and ten times the default stiffness. Springs: by their damping ratio.
WALLS = {"63 ms": 0.0632, "20 ms": 0.02, "6.3 ms": 0.00632}
DEFAULT = "20 ms"
SPRINGS = {"foam": 1.0, "light foam": 0.3}  # of one contact: all arms touch them with a probe, and those with fingers do not
SPRING_STIFFNESS_N_M = 1e3
SPRING_IMPEDANCE = 0.3  # so low that the virtual mass of MuJoCo's contact is less than that of the hand
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

    def __call__(self, t: float) -> armctl.Setpoint:
        return armctl.Setpoint(self.q, 0 * self.q, 0 * self.q)

    def sample(self, times: np.ndarray) -> armctl.Setpoint:
        q = np.tile(self.q, (len(times), 1))
        return armctl.Setpoint(q, 0 * q, 0 * q)


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


class Wall(NamedTuple):
    """An arm at a plate: the plate's geom, the world's axis across the plate, the direction towards it, what touches first."""

    arm: armctl.Arm
    geom: int
    axis: int
    sign: float
    body: str


def at_wall(name: str, wall: str) -> Wall:
    """An arm whose hand is GAP_M from a plate, on that side of its tip where the hand leads the other links by the most."""
    tool = mujoco.MjSpec.from_string(PROBE) if name in WITH_PROBE or wall in SPRINGS else None
    scene = armctl.World().add("wall", armctl.Box([0.1, 0.1, 0.1]), at=[9, 9, 9])
    arm = armctl.load(FILES.get(name, name), tool=tool, scene=scene)
    if name in STARTS:
        arm = dataclasses.replace(arm, home=armctl.solve_ik(arm, STARTS[name]).q)
    model = arm.model
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "wall")
    if wall in WALLS:
        model.geom_solref[geom] = [WALLS[wall], 1.0]
    model.geom_priority[geom] = 1
    best = None
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        hand, body, other = place(arm, geom, axis, sign)
        if best is None or other - hand > best[0]:
            best = (other - hand, axis, sign, body)
    _, axis, sign, body = best
    place(arm, geom, axis, sign)
    if wall in SPRINGS:
        impedance = SPRING_IMPEDANCE
        rate = SPRING_STIFFNESS_N_M * model.body_invweight0[model.body(body).id, 0] * (1 - impedance) / impedance**2
        model.geom_solimp[geom] = [impedance, impedance, 0.001, 0.5, 2]
        model.geom_solref[geom] = [-rate * impedance**2, -2 * SPRINGS[wall] * np.sqrt(rate) * impedance]
    return Wall(arm, geom, axis, sign, body)


def place(arm: armctl.Arm, geom: int, axis: int, sign: float) -> tuple[float, str, float]:
    """Moves the plate to GAP_M from the hand. Returns the hand's distance, m, its closest body, the other links' distance."""
    model = arm.model
    size = np.full(3, HALF_EDGE_M)
    size[axis] = HALF_THICKNESS_M
    model.geom_size[geom] = size
    model.geom_aabb[geom, 3:] = size
    model.geom_rbound[geom] = np.linalg.norm(size)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    arm.joint_map.set_positions(data.qpos, arm.home)
    last = int(model.dof_bodyid[arm.dof_adr[-1]])
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] and model.geom_contype[g]]
    face = sign * arm.fk(arm.home).position[axis] + 0.5
    for _ in range(30):
        position = arm.fk(arm.home).position.copy()
        position[axis] = sign * (face + HALF_THICKNESS_M)
        model.body_pos[model.geom_bodyid[geom]] = position
        mujoco.mj_kinematics(model, data)
        distance = {g: mujoco.mj_geomDistance(model, data, g, geom, 2.0, None) for g in moving}
        hand = [g for g in moving if is_carried_by(model, int(model.geom_bodyid[g]), last)]
        closest = min(hand, key=distance.__getitem__)
        face -= distance[closest] - GAP_M
    other = min((distance[g] for g in moving if g not in hand), default=2.0)
    return distance[closest], model.body(int(model.geom_bodyid[closest])).name, other


def is_carried_by(model: mujoco.MjModel, body: int, link: int) -> bool:
    """Whether a body is a link or a descendant of it; a body has a larger index than its parent."""
    while body > link:
        body = int(model.body_parentid[body])
    return body == link


class Pressed(NamedTuple):
    """What a run showed: overshoot, %, time to within 5 %, s, steady error, N, and the wall's stiffness, N/m; what touched it.

    And the wrench sensor at the end: what it does not see, and the force that it shows, N.
    """

    overshoot: float
    settled: str
    error: float
    stiffness: float
    body: str
    unmeasured: tuple[str, ...]
    shown: float

    def cells(self) -> tuple[str, str, str]:
        return f"{self.overshoot:.1f}", self.settled, f"{self.error:+.3f}"


def press(name: str, wall_name: str, law: str, plant_name: str) -> Pressed:
    arm, wall, axis, sign, body = at_wall(name, wall_name)
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
    log = simulation.run(motion, dwell=SECONDS - min(SECONDS, motion.duration))
    force = np.array(watched.force)
    first = int(np.argmax(force > 0.02 * FORCE_N))
    outside = np.flatnonzero(np.abs(force - FORCE_N) > 0.05 * FORCE_N)[-1]
    settled = f"{(outside + 1 - first) * TICK_S:.3f}" if outside < len(force) - 1 else "never"
    steady = force[-200:].mean()
    data = simulation.data
    depth = max(-data.contact[i].dist for i in range(data.ncon) if wall in data.contact[i].geom)
    return Pressed(
        overshoot=100 * (force.max() / FORCE_N - 1),
        settled=settled,
        error=steady - FORCE_N,
        stiffness=steady / depth,
        body=body,
        unmeasured=log.unmeasured_bodies,
        shown=-sign * float(log.wrench[-200:, axis].mean()),
    )


def row(name: str, wall: str, law: str, plants: Iterable[str]) -> list[str]:
    """Runs with several plants, in cells of as many numbers each."""
    runs = [press(name, wall, law, plant) for plant in plants]
    columns = zip(*(run.cells() for run in runs), strict=True)
    return [name, runs[0].body, wall, *(" / ".join(column) for column in columns), f"{runs[0].stiffness:.1e}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arms", nargs="+", default=ARMS)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "force.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    columns = [
        "arm",
        "touches with",
        "wall",
        "overshoot, % (10)",
        "within 5 % after, s (0.1, foam 0.3)",
        "steady error, N (0.1)",
        "stiffness, N/m",
    ]
    hybrid = [
        row(name, wall, "hybrid-force", PLANTS)
        for name in args.arms
        for wall in ((*SPRINGS, *WALLS) if name not in WITH_FINGERS else WALLS)
    ]
    title = (
        f"20 N on a wall, hybrid force control: {' / '.join(PLANTS)}; overshoot from the first contact on (targets in brackets)"
    )
    text = titled_table(title, columns, hybrid) + "\n\n"
    impedance = [row(name, DEFAULT, "impedance", ["ideal"]) for name in args.arms]
    text += titled_table("Impedance control, ideal plant", columns, impedance) + "\n"
    if "ur5e" in args.arms:
        run = press(SHIELDED, DEFAULT, "hybrid-force", "ideal")
        text += (
            f"\n{SHIELDED} without a probe: {', '.join(run.unmeasured)} touches the wall beside {run.body}, in front of the "
            f"sensor at the flange. The sensor shows {run.shown:.2f} N, the wall bears {FORCE_N + run.error:.2f} N.\n"
        )
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
