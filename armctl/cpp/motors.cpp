#include "motors.hpp"

#include "errors.hpp"

namespace armctl {

void check_addresses(Motors motors, const MujocoSimulation& simulation) {
    for (const Motor& motor : motors) {
        if (motor.qpos >= simulation.qpos.size() || motor.dof >= simulation.qvel.size() || motor.ctrl >= simulation.ctrl.size() ||
            motor.torque >= simulation.qfrc_actuator.size()) {
            throw InputError("motors: the model has no such joint or motor");
        }
    }
}

}  // namespace armctl
