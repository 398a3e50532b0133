"""An unknown payload: its effect on the error, the error with an observer, and the identified payload."""

import armctl
from armctl.lab.comparison import out_and_back
from armctl.report.report import table

arm = armctl.load("robot_arm_3dof")
plant = armctl.Plant(payload=1.5, encoder_noise=1e-5, timestep=0.001)  # the controllers' model has none of these
motion = out_and_back(arm)

log = armctl.simulate(arm, "computed-torque-observer", armctl.excitation(arm), plant)
found = armctl.identify_payload(arm, log)
print(f"identified: {found}")

controllers = {
    "payload unknown": armctl.ComputedTorque(arm),
    "disturbance observer": armctl.ComputedTorqueObserver(arm),
    "payload identified": armctl.ComputedTorque(found.applied_to(arm)),
}
for name, controller in controllers.items():
    controller.name = name
print(table(armctl.compare(arm, list(controllers.values()), motion, [plant])))
