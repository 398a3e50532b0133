#include "tick_loop.hpp"

#include <algorithm>
#include <cmath>

#include "errors.hpp"

namespace armctl {

namespace {

bool is_finite(Vector values) {
    return std::ranges::all_of(values, [](double value) { return std::isfinite(value); });
}

bool are_same(const Contacts& contacts, const std::vector<GeomPair>& geoms) {
    if (contacts.count() != geoms.size()) { return false; }
    for (size_t k = 0; k < geoms.size(); ++k) {
        if (contacts.geoms(k) != geoms[k]) { return false; }
    }
    return true;
}

}  // namespace

TickLoop::TickLoop(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, std::vector<Motor> motors,
                   std::shared_ptr<const ArmModel> pushed_arm, const TickOptions& options)
    : api_(std::move(api)), simulation_(simulation), motors_(std::move(motors)), pushed_(std::move(pushed_arm)), options_(options),
      q_(motors_.size()), q_seen_(motors_.size()), v_seen_(motors_.size()), tau_(motors_.size()) {
    check_addresses(motors_, simulation_);
    if (pushed_.joints() > motors_.size()) { throw InputError("pushed_arm: it has more joints than the simulation has motors"); }
}

TickEnd TickLoop::run(Law& law, const TickReference& reference, const TickRows& rows, size_t first, size_t last,
                      const Disturbances& disturbances, const TickSensor& sensor, std::vector<GeomPair> touching) {
    const std::unique_lock lock(in_use_, std::try_to_lock);
    if (!lock.owns_lock()) { throw InputError("simulation: another thread runs it; give each thread a simulation of its own"); }
    Run run{
        .law = law,
        .reference = reference,
        .rows = rows,
        .first = first,
        .last = last,
        .disturbances = disturbances,
        .sensor = sensor,
        .touching = std::move(touching),
        .end = {},
    };
    run.end.row = first;
    run.end.count = first;
    auto work = [this, &run] { run_ticks(run); };
    run.end.error = guarded(*api_, work);
    run.end.q_seen = q_seen_;
    run.end.v_seen = v_seen_;
    return std::move(run.end);
}

void TickLoop::run_ticks(Run& run) {
    const TickRows& rows = run.rows;
    for (size_t row = run.first; row < run.last; ++row) {
        run.end.row = row;
        std::ranges::copy(simulation_.qpos, rows.qpos.row(row).begin());
        const double speed = read_joints(motors_, simulation_, q_, rows.v.row(row));
        std::ranges::copy(q_, q_seen_.begin());
        std::ranges::copy(rows.v.row(row), v_seen_.begin());
        measure_velocity(run.disturbances.last_position);
        run.disturbances.noise.add(row - run.first, q_seen_, v_seen_);
        if (!(speed < options_.diverged_speed)) {
            run.end.status = TickStatus::diverged;
            return;
        }
        const State state{.q = q_seen_, .v = v_seen_, .wrench = measured_wrench(run, row)};
        run.law.torque(state, run.reference.setpoint(row), tau_);
        std::ranges::copy(tau_, rows.command.row(row).begin());
        if (!is_finite(tau_)) {
            run.end.status = TickStatus::not_finite;
            return;
        }
        drive(run, row);
        for (size_t k = 0; k < options_.substeps; ++k) { api_->step(simulation_.model, simulation_.data); }
        read_torques(motors_, simulation_, rows.torque.row(row));
        run.end.count = row + 1;
        note_contacts(run, row);
    }
}

// Replaces the true velocity by the difference of positions over the last tick.
void TickLoop::measure_velocity(Result last_position) {
    for (size_t i = 0; i < last_position.size(); ++i) {
        if (!std::isnan(last_position[i])) {
            v_seen_[i] = (q_[i] - last_position[i]) / options_.dt;
        }
        last_position[i] = q_[i];
    }
}

// The wrench for the law, (6,), and the true one for its row; empty without a sensor.
Vector TickLoop::measured_wrench(Run& run, size_t row) {
    if (run.sensor.sensor == nullptr) { return {}; }
    const size_t tick = row - run.first;
    read_torques(motors_, simulation_, tau_);
    const WrenchSignals signals{
        .t = run.sensor.times[tick],
        .q = q_seen_,
        .v = v_seen_,
        .tau = tau_,
        .noise = run.sensor.noise.rows > 0 ? run.sensor.noise.row(tick) : Vector(),
        .push = run.disturbances.push,
    };
    Wrench truth;
    run.sensor.sensor->measure(signals, truth).store(wrench_);
    truth.store(run.rows.wrench.row(row));
    return wrench_;
}

// Sets the controls of the motors from the commanded torque, and the forces of pushes.
void TickLoop::drive(const Run& run, size_t row) {
    const Disturbances& disturbances = run.disturbances;
    if (disturbances.delay == nullptr) {
        command_motors(motors_, tau_, simulation_);
        return;
    }
    command_motors(motors_, disturbances.delay->delayed(tau_), simulation_);
    if (disturbances.pushes.rows > 0) {
        const Vector push = disturbances.pushes.row(row - run.first);
        const Result torque = Result(tau_).first(pushed_.joints());  // the command is recorded already
        pushed_.torque(Vector(q_).first(pushed_.joints()), push, torque);
        for (size_t i = 0; i < torque.size(); ++i) { simulation_.qfrc_applied[motors_[i].dof] = torque[i]; }
        std::ranges::copy(push, disturbances.push.begin());
    }
}

// Notes the geoms that touch, if they changed.
void TickLoop::note_contacts(Run& run, size_t row) const {
    const Contacts contacts(api_->contacts, simulation_.data);
    if (are_same(contacts, run.touching)) { return; }
    run.touching.resize(contacts.count());
    for (size_t k = 0; k < contacts.count(); ++k) { run.touching[k] = contacts.geoms(k); }
    run.end.contacts.push_back({row, run.touching});
}

}  // namespace armctl
