"""Measurements of an arm, beside what is true: frequency responses, resonances and filters; pushes and collisions."""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import scipy.signal
from identification import synthetic
from markdown_table import markdown_table

import armctl

ROBOTS = ("panda", "ur5e")
TICK_S = 0.002
DELAY_TICKS = 1
FRICTION_SHARE = 0.01  # of the torque limits
ENCODER_NOISE = 1e-6  # rad
RESONANCE_HZ = 15.0  # about, of the elastic joint
FEELING_TICK_S = 0.002
FEELING_NOISE = 1e-5  # rad
PUSH_NS = 5.0
PUSH_S = 0.1
PUSHES = 30
CHANGES = ((1.05, 0.0), (0.95, 0.005))  # factor on masses, dry friction as a share of the torque limits
MOTION_POINTS = 4
OPTIONS = '<mujoco><compiler angle="radian"/><option integrator="implicitfast"/>'
JUDGED_HZ = np.geomspace(0.5, 200.0, 20_000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=10.0, help="of motions without contact, for each row")
    parser.add_argument("--arms", nargs="+", help="by default all")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "measure.md")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:  # plants with springs read the file again
        arms = {name: armctl.load(name) for name in ROBOTS} | {"six joints": six_joints(Path(folder))}
        report({name: arm for name, arm in arms.items() if args.arms is None or name in args.arms}, args)


def report(arms: dict[str, armctl.Arm], args: argparse.Namespace) -> None:
    known = args.out.read_text(encoding="utf-8") if args.out.exists() else ""
    sections = {text.partition("\n")[0]: text for text in known.split("# ")[1:]}
    for part in args.parts:
        title, text = PARTS[part](arms, args)
        sections[title] = f"{title}\n\n{text}\n\n"
        print(text, flush=True)
    args.out.write_text("".join(f"# {text.rstrip()}\n\n" for text in sections.values()).rstrip() + "\n", encoding="utf-8")


def six_joints(folder: Path) -> armctl.Arm:
    """The arm of the other benchmark, with the integrator of the robots."""
    synthetic(folder)
    path = folder / "arm.xml"
    text = path.read_text(encoding="utf-8").replace("<mujoco>", OPTIONS)
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
        # On its left side D has the sparsity of M, so that the damping between a rotor and its link is partly explicit.
        change = TICK_S * np.linalg.inv(inertia + TICK_S * damping * (inertia != 0.0))
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


def frequency(arms: dict[str, armctl.Arm], args: argparse.Namespace) -> tuple[str, str]:
    rows = []
    inside = []
    for name, arm in arms.items():
        for seed in range(args.seeds):
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
            # The arm sags on its spring: what is true holds where it is.
            true = TrueArm(arm, plant, np.mean([log.q[round(t / TICK_S)] for t in motion.multisine.starts + 1.0], axis=0))
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
        f"Each arm with a delay of {1e3 * DELAY_TICKS * TICK_S:g} ms, one elastic joint, dry friction of "
        f"{100 * FRICTION_SHARE:g} % of the torque limits and encoder noise of {ENCODER_NOISE:g} rad, by PD with gravity "
        f"compensation. {100 * total.mean():.1f} % of {len(total)} points are within the stated bounds of 95 %.\n\n"
    )
    return "Frequency responses from recordings", text + markdown_table(head, rows)


def feeling(arms: dict[str, armctl.Arm], args: argparse.Namespace) -> tuple[str, str]:
    rows = []
    for name, arm in arms.items():
        for mass_scale, friction in CHANGES:
            plant = armctl.Plant(
                timestep=FEELING_TICK_S,
                mass_scale=mass_scale,
                coulomb_friction=friction * arm.limits.tau_max,
            )
            free = recordings(arm, plant, 30.0, 100)
            observer = armctl.ExternalForce(arm).calibrated(*measured(arm, free[0], 100), FEELING_TICK_S)
            alarms = 0
            simulated = 0.0
            for k, log in enumerate(recordings(arm, plant, 60.0 * args.minutes, 200)):
                alarms += felt(observer, *measured(arm, log, 200 + k)) is not None
                simulated += len(log) * log.dt
            delays = []
            for k in range(PUSHES):
                rng = np.random.default_rng([300, k])
                direction = rng.normal(size=3)
                start = float(rng.uniform(0.3, 0.6))
                push = armctl.Push(start, PUSH_S, force=PUSH_NS / PUSH_S * direction / np.linalg.norm(direction))
                log = recordings(arm, replace(plant, pushes=push), 1.0, 1000 + k)[0]
                at = felt(observer, *measured(arm, log, 300 + k))
                delays.append(np.inf if at is None else at - start)
            delays = np.array(delays)
            found = (delays >= 0.0) & (delays <= 0.02)
            missed = delays > PUSH_S
            rows.append(
                [
                    name,
                    f"{100 * (mass_scale - 1):+.0f} %",
                    f"{100 * friction:g} %",
                    f"{alarms} in {simulated / 60:.1f} min",
                    f"{100 * found.mean():.0f}",
                    f"{1e3 * np.median(delays):.0f}",
                    f"{100 * missed.mean():.0f}",
                    worst_reaction(arm, plant, observer),
                ]
            )
            print(*rows[-1], sep=" | ", flush=True)
    head = ["arm", "masses", "friction", "false alarms", "found within 20 ms, %", "median, ms", "missed, %"]
    head.append("of the limits")
    text = (
        "Random motions by computed torque with an observer; the model does not know masses and dry friction (a share of the "
        f"torque limits). Encoder noise {FEELING_NOISE:g} rad, ticks of {1e3 * FEELING_TICK_S:g} ms, thresholds calibrated in "
        f"other motions of 30 s. {PUSHES} pushes of {PUSH_NS:g} N s ({PUSH_NS / PUSH_S:g} N) on the tip in random directions. "
        "The last column is the largest share of a limit on speed or acceleration that references reach in the three reactions."
        "\n\n"
    )
    return "Pushes and collisions", text + markdown_table(head, rows)


def recordings(arm: armctl.Arm, plant: armctl.Plant, seconds: float, seed: int) -> list[armctl.Log]:
    """Logs of random motions without contact, for so many seconds."""
    logs = []
    rng = np.random.default_rng(seed)
    total = 0.0
    while total < seconds:
        low, high = np.maximum(arm.limits.q_min, arm.home - 0.8), np.minimum(arm.limits.q_max, arm.home + 0.8)
        points = np.vstack([arm.limits.clamp(arm.home), rng.uniform(low, high, (MOTION_POINTS, arm.n))])
        motion = armctl.move_through(arm, points, speed=0.6)
        if not (armctl.check_clearance(arm, motion, 0.005) and armctl.check_torque(arm, motion).ratio < 0.8):
            continue
        logs.append(armctl.simulate(arm, "computed-torque-observer", motion, plant, dwell=0.2))
        total += motion.duration
    return logs


def measured(arm: armctl.Arm, log: armctl.Log, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noisy positions, their differences, and torques."""
    q = log.q + FEELING_NOISE * np.random.default_rng(seed).normal(size=log.q.shape)
    return q, np.diff(q, axis=0, prepend=q[:1]) / log.dt, log.tau


def felt(observer: armctl.ExternalForce, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> float | None:
    """s, of the first alarm; None without one."""
    observer.reset()
    for k in range(1, len(q)):
        observer.update(q[k], v[k], tau[k - 1], FEELING_TICK_S)
        if observer.alarm:
            return k * FEELING_TICK_S
    return None


def worst_reaction(arm: armctl.Arm, plant: armctl.Plant, observer: armctl.ExternalForce) -> str:
    """The largest share of a limit that references reach in reactions to a push, by differences of positions."""
    worst = 0.0
    for reaction in ("stop", "retreat", "float"):
        push = armctl.Push(0.35, PUSH_S, force=[0.0, PUSH_NS / PUSH_S, 0.0])
        sim = armctl.Simulation(arm, "computed-torque-observer", replace(plant, pushes=push))
        sim.reaction = armctl.ContactReaction(arm, observer, reaction)
        goal = arm.limits.clamp(arm.home + 0.3 * np.resize([1.0, -1.0], arm.n))
        sim.move_j(goal, avoid=False)
        q = sim.log.q_ref[np.isfinite(sim.log.q_ref).all(axis=1)]
        v = np.diff(q, axis=0) / FEELING_TICK_S
        a = np.diff(v, axis=0) / FEELING_TICK_S
        worst = max(worst, float((np.abs(v) / arm.limits.v_max).max()), float((np.abs(a) / arm.limits.a_max).max()))
    return f"{worst:.4f}"


PARTS = {"frequency": frequency, "feeling": feeling}

if __name__ == "__main__":
    main()
