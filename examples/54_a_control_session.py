"""A control engineer's session: tune, Bode plot, step response, margins, a figure for a paper, numbers, and a comparison."""

import tempfile
from pathlib import Path

import numpy as np

import armctl

folder = Path(tempfile.gettempdir())
arm = armctl.load("robot_arm_3dof")
plant = armctl.Plant(delay=2, encoder_noise=1e-5)
law = armctl.tune(arm, "pd-gravity", delay_margin=8e-3, configurations=5, plants=[plant]).controller

loop = armctl.linearize(arm, law, arm.home, plant)
step = loop.step_response()
print(f"overshoot {(100 * step.overshoot).round().tolist()} %, settles in {(1e3 * step.settling_time).round().tolist()} ms")
for each in loop.gain_crossovers():
    phase = np.degrees(each.phase_margin)
    print(f"crossover {each.frequency:.0f} rad/s: phase margin {phase:.0f} deg, delay margin {1e3 * each.delay_margin:.1f} ms")
print(loop.disk_margins())
print(armctl.margins(arm, law, plants=[plant]))

print(f"drawn: {loop.bode().plot(folder / 'bode.pdf', size=(3.4, 3.0))}")
table = loop.bode().to_dict()  # pandas.DataFrame(table)
np.savetxt(folder / "bode.csv", np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
print(f"{len(table)} columns of {len(table['w'])} frequencies")


class Mine:
    name = "mine"

    def torque(self, state, setpoint):
        return arm.gravity(state.q) + 60.0 * (setpoint.q - state.q) - 6.0 * state.v


print(armctl.linearize(arm, Mine(), arm.home, plant).disk_margins())
motion = armctl.move_j(arm, arm.home, arm.home + 0.4)
for report in armctl.compare(arm, [law, Mine()], motion, [plant], configurations=5):
    print(f"{report.controller}: RMS {report.joint_rms_rad:.1e} rad, torque noise {report.chatter_nm:.2f} N m")
