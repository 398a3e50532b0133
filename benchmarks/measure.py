"""Measurements of an arm, beside what is true: frequency responses, resonances and filters; pushes and collisions."""

import argparse
import tempfile
from pathlib import Path

import mujoco
import numpy as np
import scipy.signal
from identification import synthetic
from markdown_table import markdown_table

import armctl

ROBOTS = ("panda", "ur5e")
TICK_S = 0.001
DELAY_TICKS = 2
FRICTION_SHARE = 0.01  # of the torque limits
ENCODER_NOISE = 1e-6  # rad
RESONANCE_HZ = 15.0  # about, of the elastic joint
JUDGED_HZ = np.geomspace(0.5, 200.0, 20_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "measure.md")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:  # plants with springs read the file again
        arms = {name: armctl.load(name) for name in ROBOTS} | {"six joints": six_joints(Path(folder))}
        report(arms, args)


def report(arms: dict[str, armctl.Arm], args: argparse.Namespace) -> None:
    known = args.out.read_text(encoding="utf-8") if args.out.exists() else ""
    sections = {text.partition("\n")[0]: text for text in known.split("## ")[1:]}
    for part in args.parts:
        title, text = PARTS[part](arms, args.seeds)
        sections[title] = f"{title}\n\n{text}\n\n"
        print(text, flush=True)
    args.out.write_text("".join(f"## {text.rstrip()}\n\n" for text in sections.values()).rstrip() + "\n", encoding="utf-8")


def six_joints(folder: Path) -> armctl.Arm:
    """The arm of the other benchmark, with the integrator of the robots."""
    synthetic(folder)
    path = folder / "arm.xml"
    text = path.read_text(encoding="utf-8").replace("<mujoco>", '<mujoco><option integrator="implicitfast"/>')
    path.write_text(text, encoding="utf-8")
    return armctl.load(path)


class TrueArm:
    """The linear arm at rest, by MuJoCo's inertia and forces: M a + D v + K q = torque, in the coordinates of its model."""

    def __init__(self, arm: armctl.Arm, plant: armctl.Plant, q: np.ndarray):
        model = plant.model(arm)
        data = mujoco.MjData(model)
        data.qpos[: len(arm.home_qpos)] = arm.home_qpos
        data.qpos[arm.qpos_adr] = q
        rotors = list(range(arm.model.nv, model.nv))
        data.qpos[arm.model.nq :] = [q[i] for i in np.flatnonzero(plant.elasticity)]
        self.moving = [*arm.dof_adr, *rotors]
        places = [*arm.qpos_adr, *range(arm.model.nq, model.nq)]
        step = 1e-6

        def forces(values, k, change):
            values[k] += change
            mujoco.mj_forward(model, data)
            force = (data.qfrc_passive - data.qfrc_bias)[self.moving]
            values[k] -= change
            return force

        def slopes(values, where):
            return np.array([forces(values, k, step) - forces(values, k, -step) for k in where]).T / (2 * step)

        stiffness = -slopes(data.qpos, places)
        damping = -slopes(data.qvel, self.moving)
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        inertia = inertia[np.ix_(self.moving, self.moving)]
        size = len(self.moving)
        motors = np.arange(arm.n)
        motors[np.flatnonzero(plant.elasticity)] = np.arange(arm.n, size)
        # A step of MuJoCo is implicit in the velocities: (M + dt D) (v' - v) = dt (torque - D v - K q), and q' = q + dt v'.
        change = TICK_S * np.linalg.inv(inertia + TICK_S * damping)
        moved = np.hstack([-change @ stiffness, np.eye(size) - change @ damping])
        self.A = np.vstack([np.eye(size, 2 * size) + TICK_S * moved, moved])
        self.B = np.vstack([TICK_S * change[:, motors], change[:, motors]])
        self.C = np.eye(size, 2 * size)[motors]

    def response(self, w: np.ndarray) -> np.ndarray:
        """(k, n, n) from held torques to the positions of motors."""
        z = np.exp(1j * w * TICK_S)[:, None, None]
        return self.C @ np.linalg.solve(z * np.eye(len(self.A)) - self.A, self.B) * z**-DELAY_TICKS

    def resonance(self) -> float:
        """rad/s, of the least damped vibration above 2 Hz."""
        poles = np.log(np.linalg.eigvals(self.A).astype(complex)) / TICK_S
        poles = poles[poles.imag > 4 * np.pi]
        return float(np.abs(poles[np.argmax(poles.real / np.abs(poles))]))


def true_margins(true: TrueArm, arm: armctl.Arm, controller, q) -> tuple[float, float]:
    """Delay margin, s, and Ms of a law without memory, or of one in a filter, on a fine grid."""
    law = controller.controller if isinstance(controller, armctl.TorqueFilter) else controller
    rest = np.zeros(arm.n)
    hold = armctl.Setpoint(q, rest, rest, rest, rest)

    def torque(dq, dv):
        return law.torque(armctl.State(q + dq, dv, 0.0, TICK_S), hold)

    step = 1e-5 * np.eye(arm.n)
    of_position = np.array([torque(e, rest) - torque(-e, rest) for e in step]).T / 2e-5
    of_speed = np.array([torque(rest, e) - torque(rest, -e) for e in step]).T / 2e-5
    w = 2 * np.pi * JUDGED_HZ
    z = np.exp(1j * w * TICK_S)[:, None, None]
    filtered = np.ones(len(w), dtype=complex)
    if controller is not law:
        filtered = scipy.signal.sosfreqz(controller.sections(TICK_S), worN=w * TICK_S)[1]
    L = -filtered[:, None, None] * (of_position + of_speed * (1 - 1 / z) / TICK_S) @ true.response(w)
    sensitivity = np.linalg.inv(np.eye(arm.n) + L)
    values = np.linalg.eigvals(L)
    values = np.take_along_axis(values, np.abs(values).argsort(axis=1), axis=1)
    crossing = (np.abs(values[1:]) > 1) != (np.abs(values[:-1]) > 1)
    lags = (np.angle(values[1:]) + np.pi) % (2 * np.pi) / w[1:, None]
    return float(lags[crossing].min()), float(np.abs(np.diagonal(sensitivity, axis1=1, axis2=2)).max())


def recorded(arm: armctl.Arm, plant: armctl.Plant, motion: armctl.Excitation) -> tuple[armctl.Log, np.ndarray]:
    """A run and the positions that the controller measured."""
    seen = []

    class Watching(armctl.PDGravity):
        def torque(self, state, setpoint):
            seen.append(state.q.copy())
            return super().torque(state, setpoint)

    log = armctl.simulate(arm, Watching(arm), motion, plant, dwell=0.0)
    return log, np.array(seen)


def frequency(arms: dict[str, armctl.Arm], seeds: int) -> tuple[str, str]:
    rows = []
    inside = []
    for name, arm in arms.items():
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 7])
            q = arm.limits.clamp(arm.home + rng.uniform(-0.2, 0.2, arm.n))
            elastic = int(rng.integers(1, 4))
            rotor = 0.5 * arm.mass_matrix(q)[elastic, elastic] + 0.1
            free = 1 / np.linalg.inv(arm.mass_matrix(q))[elastic, elastic]
            springs = np.zeros(arm.n)
            springs[elastic] = (2 * np.pi * RESONANCE_HZ) ** 2 / (1 / rotor + 1 / free)
            plant = armctl.Plant(
                timestep=TICK_S,
                delay=DELAY_TICKS,
                coulomb_friction=FRICTION_SHARE * arm.limits.tau_max,
                elasticity=springs,
                elastic_damping=0.03,
                rotor_inertia=rotor,
                encoder_noise=ENCODER_NOISE,
                seed=seed,
            )
            motion = armctl.excitation(arm, for_="frequency", seed=seed, start=q)
            log, seen = recorded(arm, plant, motion)
            true = TrueArm(arm, plant, q)
            fits = []
            hits = []
            for joint in range(arm.n):
                found = armctl.FrequencyResponse.from_log(log, motion, joint, positions=seen)
                response = true.response(found.frequency)[:, joint, joint]
                hits.append(np.abs(found.measured - response) <= found.bound)
                fits.append(found.two_mass())
            inside.append(np.array(hits))
            error = 100 * abs(fits[elastic].resonance / true.resonance() - 1)
            known = armctl.TwoMass.plant(arm, fits, q, armctl.Plant(timestep=TICK_S, delay=DELAY_TICKS))
            law = armctl.ComputedTorque(arm)
            proposal = armctl.propose_filter(arm, law, q, known, delay_margin=5e-3)
            before = true_margins(true, arm, law, q)
            after = true_margins(true, arm, proposal.controller, q)
            rows.append(
                [
                    name,
                    str(seed),
                    f"{100 * np.mean(hits):.1f}",
                    f"{true.resonance() / (2 * np.pi):.2f}",
                    f"{error:.2f}",
                    f"{1e3 * before[0]:.2f}, {before[1]:.2f}",
                    ", ".join(map(str, (type(f).__name__ for f in proposal.filters))) or "-",
                    f"{proposal.factor:g}",
                    f"{1e3 * proposal.after.delay_margin:.2f}, {proposal.after.peak_sensitivity:.2f}",
                    f"{1e3 * after[0]:.2f}, {after[1]:.2f}",
                ]
            )
            print(*rows[-1], sep=" | ", flush=True)
    total = np.concatenate([each.ravel() for each in inside])
    head = ["arm", "seed", "points within bounds, %", "resonance, Hz", "error, %", "margins before: ms, Ms", "filter"]
    head += ["bandwidth x", "after, predicted", "after, true"]
    text = (
        f"Each arm with a delay of {DELAY_TICKS} ms, dry friction of {100 * FRICTION_SHARE:g} % of the torque limits, one "
        f"elastic joint and encoder noise of {ENCODER_NOISE:g} rad, by PD with gravity compensation. "
        f"{100 * total.mean():.1f} % of {len(total)} points are within the stated bounds of 95 %.\n\n"
    )
    return "Frequency responses from recordings", text + markdown_table(head, rows)


PARTS = {"frequency": frequency}

if __name__ == "__main__":
    main()
