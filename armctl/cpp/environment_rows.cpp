#include "environment_rows.hpp"

#include <algorithm>

#include "errors.hpp"

namespace armctl {

// Takes some copies for one thread, and gives them back at the end.
class EnvironmentRows::Use {
public:
    Use(std::deque<Copy>& copies, size_t first, size_t last) : copies_(copies), first_(first), last_(first) {
        while (last_ < last && !copies_[last_].is_in_use.exchange(true)) { ++last_; }
        if (last_ < last) {
            release();
            throw InputError("environment: another thread steps it; give each thread an environment of its own");
        }
    }
    Use(const Use&) = delete;
    Use& operator=(const Use&) = delete;
    ~Use() { release(); }

private:
    void release() {
        for (size_t row = first_; row < last_; ++row) { copies_[row].is_in_use = false; }
    }

    std::deque<Copy>& copies_;
    size_t first_;
    size_t last_;
};

// What a thread needs for its steps.
struct EnvironmentRows::Workspace {
    explicit Workspace(const EnvironmentRows& rows)
        : targets(rows.arm_, rows.options_.limits, rows.options_.action), guard(rows.arm_, rows.options_.limits, rows.options_.action),
          q_seen(rows.joints()), v_seen(rows.joints()), tau(rows.joints()) {}

    ActionTargets targets;
    TorqueGuard guard;
    std::vector<double> q_seen;
    std::vector<double> v_seen;
    std::vector<double> tau;
};

EnvironmentRows::EnvironmentRows(std::shared_ptr<const MujocoApi> api, std::shared_ptr<const ArmModel> arm, const Law& law,
                                 EnvironmentOptions options, const EnvironmentArrays& arrays)
    : api_(std::move(api)), arm_(std::move(arm)), options_(std::move(options)), arrays_(arrays) {
    if (law.joints() != joints() || arm_->n() != joints()) {
        throw InputError("law, arm: they are not for " + std::to_string(joints()) + " joints");
    }
    if (law.needs_wrench()) { throw InputError("law: environments measure no wrench, and this law needs one"); }
    for (size_t row = 0; row < arrays.q.rows; ++row) { copies_.emplace_back(law.clone(), joints(), options_.max_delay); }
}

void EnvironmentRows::set_simulation(size_t row, const MujocoSimulation& simulation) {
    check_addresses(options_.motors, simulation);
    for (const GripperActuator& actuator : options_.gripper) {
        if (actuator.ctrl >= simulation.ctrl.size() || actuator.length >= simulation.actuator_length.size()) {
            throw InputError("gripper: the model has no such actuator");
        }
    }
    if (options_.object && (options_.object->qpos + 7 > simulation.qpos.size() || options_.object->qvel + 6 > simulation.qvel.size())) {
        throw InputError("object: the model has no such joint");
    }
    copies_[row].simulation = simulation;
}

void EnvironmentRows::restart(size_t row, size_t delay) {
    Copy& copy = copies_[row];
    copy.law->reset();
    copy.delay.restart(delay);
    copy.grip_target = 1.0;
}

std::string EnvironmentRows::step(size_t first, size_t last) {
    const Use use(copies_, first, last);
    for (size_t row = first; row < last; ++row) {
        if (copies_[row].simulation.data == nullptr) { throw InputError("row " + std::to_string(row) + ": it has no simulation"); }
    }
    Workspace workspace(*this);
    auto work = [&] {
        for (size_t row = first; row < last; ++row) { step_row(row, workspace); }
    };
    return guarded(*api_, work);
}

void EnvironmentRows::rehearse(Vector action, Result target, Result q_ref, Result v_ref) const {
    ActionTargets(arm_, options_.limits, options_.action).rehearse(action, target, q_ref, v_ref);
}

void EnvironmentRows::step_row(size_t row, Workspace& work) {
    arrays_.touched[row] = 0;
    work.targets.move(arrays_.action.row(row).first(action_size()), arrays_.target.row(row));
    for (size_t k = 0; k < options_.action.ticks; ++k) { tick(row, k, work); }
    observe_scene(row);
    const Pose tip = work.targets.tip(arrays_.q.row(row));
    const Result numbers = arrays_.tip.row(row);
    numbers[0] = tip.translation.x;
    numbers[1] = tip.translation.y;
    numbers[2] = tip.translation.z;
    tip.rotation.to_rows(numbers.subspan(3));
}

// Measure, control, step.
void EnvironmentRows::tick(size_t row, size_t tick, Workspace& work) {
    Copy& copy = copies_[row];
    std::ranges::copy(arrays_.q.row(row), work.q_seen.begin());
    std::ranges::copy(arrays_.v.row(row), work.v_seen.begin());
    MeasurementNoise{arrays_.noise}.add(row * options_.action.ticks + tick, work.q_seen, work.v_seen);
    if (options_.action.mode == ActionMode::torque) {
        work.guard.torque(arrays_.action.row(row), work.q_seen, work.v_seen, work.tau);
    } else {
        const Setpoint setpoint = work.targets.advance(arrays_.target.row(row), arrays_.q_ref.row(row), arrays_.v_ref.row(row));
        copy.law->torque({.q = work.q_seen, .v = work.v_seen, .wrench = {}}, setpoint, work.tau);
    }
    if (!options_.gripper.empty()) { drive_gripper(row); }
    command_motors(options_.motors, copy.delay.delayed(work.tau), copy.simulation);
    api_->step(copy.simulation.model, copy.simulation.data);
    read_joints(options_.motors, copy.simulation, arrays_.q.row(row), arrays_.v.row(row));
    if (options_.obstacle && Contacts(api_->contacts, copy.simulation.data).touch(*options_.obstacle)) { ++arrays_.touched[row]; }
}

// Moves the controls of the gripper towards the last number of the action, at a limited speed.
void EnvironmentRows::drive_gripper(size_t row) {
    Copy& copy = copies_[row];
    const double wanted = 0.5 * (1.0 + unit(arrays_.action.row(row)[action_size()]));
    const double step = options_.grip_step;
    copy.grip_target = std::min(std::max(wanted, copy.grip_target - step), copy.grip_target + step);
    for (const GripperActuator& actuator : options_.gripper) {
        copy.simulation.ctrl[actuator.ctrl] = actuator.closed_ctrl + copy.grip_target * (actuator.open_ctrl - actuator.closed_ctrl);
    }
}

// Reads the gripper's opening and the loose object.
void EnvironmentRows::observe_scene(size_t row) {
    const MujocoSimulation& simulation = copies_[row].simulation;
    if (!options_.gripper.empty()) {
        double share = 0.0;
        for (const GripperActuator& actuator : options_.gripper) {
            const double length = simulation.actuator_length[actuator.length];
            share += (length - actuator.closed_length) / (actuator.open_length - actuator.closed_length);
        }
        arrays_.opening[row] = share / static_cast<double>(options_.gripper.size());
    }
    if (options_.object) {
        const Result object = arrays_.object.row(row);
        std::ranges::copy(simulation.qpos.subspan(options_.object->qpos, 7), object.begin());
        std::ranges::copy(simulation.qvel.subspan(options_.object->qvel, 6), object.begin() + 7);
    }
}

}  // namespace armctl
