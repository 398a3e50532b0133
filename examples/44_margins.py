"""The worst delay, gain and phase margin of controllers over the workspace, and a measurement that confirms the prediction."""

import armctl

arm = armctl.load("robot_arm_3dof")
plant = armctl.Plant(timestep=0.001)

for name in ("pd-gravity", "computed-torque", "computed-torque-observer"):
    worst = armctl.margins(arm, name, configurations=10, plants=[plant])
    print(worst)

loop = armctl.linearize(arm, "computed-torque-observer", worst.delay.q, plant, delay=0.002)
print(f"with two ticks of delay: Ms {loop.margins().peak_sensitivity:.2f}")
late = armctl.Plant(timestep=0.001, delay=2)
print(armctl.frequency_response(arm, "computed-torque-observer", worst.delay.q, "shoulder_pitch", late))
