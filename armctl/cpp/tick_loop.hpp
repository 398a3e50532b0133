// The tick loop of a simulation: measure, control, step, record.
#pragma once
#include <mutex>

#include "dynamics.hpp"
#include "law.hpp"
#include "motors.hpp"
#include "wrench_sensor.hpp"

namespace armctl {

// The geoms that touch from a row on: pairs of int32 as bytes.
struct ContactChange {
    size_t row = 0;
    std::string geoms;
};

enum class TickStatus : std::uint8_t { complete, diverged, not_finite, repaired };

struct TickEnd {
    TickStatus status = TickStatus::complete;
    size_t row = 0;          // the last one that was begun
    size_t count = 0;        // complete rows
    std::string error = {};  // MuJoCo's message, if it could not make a step
    Numbers q_seen = {};     // measured in the last row that was begun
    Numbers v_seen = {};
    std::vector<ContactChange> contacts = {};
};

// The ticks [first, last) of a trajectory, and what they are recorded in. What is not given is empty.
struct Ticks {
    size_t first = 0;
    size_t last = 0;
    // The trajectory, (ticks, n) each.
    Matrix q;
    Matrix v;
    Matrix a;
    Matrix v_tick;
    Matrix a_tick;
    // The records.
    MatrixResult qpos_rows;      // (ticks, nq) of the whole model
    MatrixResult v_rows;         // (ticks, n) rad/s
    MatrixResult command_rows;   // (ticks, n) N m
    MatrixResult torque_rows;    // (ticks, n) N m, what the motors did
    MatrixResult wrench_rows{};  // (ticks, 6) the true wrench, if it is measured
    // What disturbs the signals. The first row is that of the first tick.
    Vector noise{};          // (last - first, 2, n) on measured positions and velocities
    Matrix pushes{};         // (last - first, 6) N and N m on the tip
    Result push{};           // (6,) the wrench of the last tick, which the loop writes
    Result last_position{};  // (n,) of the last tick, NaN at the first one, if measured velocities are differences of positions
    // For the sensor.
    Vector times{};         // (last - first,) s
    Matrix wrench_noise{};  // (last - first, 6)

    // How many they are; InputError if they are not in the trajectory.
    size_t count() const {
        if (first > last || last > v_rows.rows) { throw InputError("first, last: they are not rows of the reference"); }
        return last - first;
    }

    Setpoint setpoint(size_t row) const {
        return {q.row(row), v.row(row), a.row(row), v_tick.row(row), a_tick.row(row), q.from(row), v_tick.from(row), a_tick.from(row)};
    }
};

struct TickLoopOptions {
    Motors motors;
    size_t substeps = 1;          // steps of MuJoCo in a tick
    double dt = 0.0;              // s, the tick
    double diverged_speed = 0.0;  // rad/s, the norm of the velocities from which a simulation counts as diverged
};

// The loop of one simulation. It is used by one thread at a time: a call while another runs throws InputError.
class TickLoop {
public:
    // `pushed_arm` is the arm on whose tip pushes act; its joints are the first ones.
    TickLoop(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, const Model& pushed_arm, TickLoopOptions options)
        : api_(std::move(api)), simulation_(simulation), options_(std::move(options)), pushed_(pushed_arm) {
        check_addresses(options_.motors, simulation_);
        if (pushed_arm->n() > joints()) { throw InputError("pushed_arm: it has more joints than the simulation has motors"); }
    }

    size_t joints() const { return options_.motors.size(); }
    const MujocoSimulation& simulation() const { return simulation_; }

    // Throws InputError if the ticks cannot run with a law, a delay and a sensor, each of which may be null.
    void check(const Ticks& ticks, const Law& law, const Delay* delay, const WrenchSensor* sensor) const {
        const auto require_joints = [this](size_t given, const char* name) {
            if (given == joints()) { return; }
            throw InputError(std::string(name) + ": it is one for " + std::to_string(given) + " joints, and the simulation has " +
                             std::to_string(joints()));
        };
        require_joints(law.joints(), "law");
        if (delay != nullptr) { require_joints(delay->joints(), "delay"); }
        if (sensor != nullptr) { require_joints(sensor->joints(), "sensor"); }
        if (ticks.pushes.rows > 0 && (delay == nullptr || ticks.push.empty())) {
            throw InputError("pushes: they need a delay, and `push`, where the last one is noted");
        }
        const bool is_sensed = sensor != nullptr && !ticks.times.empty() && ticks.wrench_rows.rows > 0;
        if (ticks.count() > 0 && (law.needs_wrench() || sensor != nullptr) && !is_sensed) {
            throw InputError("sensor: a law that needs the wrench needs a sensor, the times of the ticks, and wrench_rows");
        }
    }

    // Runs the ticks with the law. Without a delay, the motors receive the command itself, and nothing pushes. The sensor measures
    // the wrench for a law that needs it. `touching` are the geoms that touch in the row before.
    [[nodiscard]] TickEnd run(const Ticks& ticks, Law& law, Delay* delay, WrenchSensor* sensor, std::string touching) {
        const std::unique_lock lock(in_use_, std::try_to_lock);
        if (!lock.owns_lock()) { throw InputError("simulation: another thread runs it; give each thread a simulation of its own"); }
        // What owns memory belongs to this call, which errors of MuJoCo do not leave.
        TickEnd end{.row = ticks.first, .count = ticks.first};
        auto work = [&] { run_ticks(ticks, law, delay, sensor, touching, end); };
        end.error = guarded(*api_, work);
        end.q_seen = q_seen_;
        end.v_seen = v_seen_;
        return end;
    }

private:
    void run_ticks(const Ticks& ticks, Law& law, Delay* delay, WrenchSensor* sensor, std::string& touching, TickEnd& end) {
        for (size_t row = ticks.first; row < ticks.last; ++row) {
            end.row = row;
            copy(simulation_.qpos, ticks.qpos_rows.row(row));
            const double speed = read_joints(options_.motors, simulation_, q_, ticks.v_rows.row(row));
            copy(q_, q_seen_);
            copy(ticks.v_rows.row(row), v_seen_);
            measure_velocity(ticks.last_position);
            add_noise(ticks.noise, row - ticks.first, q_seen_, v_seen_);
            if (!(speed < options_.diverged_speed)) {
                end.status = TickStatus::diverged;
                return;
            }
            const Vector wrench = sensor == nullptr ? Vector() : measured_wrench(ticks, *sensor, row);
            law.torque({.q = q_seen_, .v = v_seen_, .wrench = wrench}, ticks.setpoint(row), tau_);
            copy(tau_, ticks.command_rows.row(row));
            if (!std::ranges::all_of(tau_, [](double torque) { return std::isfinite(torque); })) {
                end.status = TickStatus::not_finite;
                return;
            }
            drive(ticks, delay, row);
            for (size_t k = 0; k < options_.substeps; ++k) { api_->step(simulation_.model, simulation_.data); }
            if (has_repaired(api_->repairs, simulation_.data)) {
                end.status = TickStatus::repaired;
                return;
            }
            read_torques(options_.motors, simulation_, ticks.torque_rows.row(row));
            end.count = row + 1;
            note_contacts(row, touching, end);
        }
    }

    // Replaces the true velocity by the difference of positions over the last tick.
    void measure_velocity(Result last_position) {
        for (size_t i = 0; i < last_position.size(); ++i) {
            if (!std::isnan(last_position[i])) { v_seen_[i] = (q_[i] - last_position[i]) / options_.dt; }
            last_position[i] = q_[i];
        }
    }

    // The wrench for the law, (6,), and the true one for its row.
    Vector measured_wrench(const Ticks& ticks, WrenchSensor& sensor, size_t row) {
        const size_t tick = row - ticks.first;
        read_torques(options_.motors, simulation_, tau_);
        const WrenchSignals signals{
            .t = ticks.times[tick],
            .q = q_seen_,
            .v = v_seen_,
            .tau = tau_,
            .noise = ticks.wrench_noise.rows > 0 ? ticks.wrench_noise.row(tick) : Vector(),
            .push = ticks.push,
        };
        Wrench truth;
        wrench_ = sensor.measure(signals, truth);
        copy(truth, ticks.wrench_rows.row(row));
        return wrench_;
    }

    // Sets the controls of the motors from the commanded torque, and the forces of pushes.
    void drive(const Ticks& ticks, Delay* delay, size_t row) {
        command_motors(options_.motors, delay == nullptr ? Vector(tau_) : delay->delayed(tau_), simulation_);
        if (delay == nullptr || ticks.pushes.rows == 0) { return; }
        const Vector push = ticks.pushes.row(row - ticks.first);
        const Result torque = Result(tau_).first(pushed_.model().n());  // the command is recorded already
        pushed_.tip_force(Vector(q_).first(torque.size()), push, torque);
        for (size_t i = 0; i < torque.size(); ++i) { simulation_.qfrc_applied[options_.motors[i].dof] = torque[i]; }
        copy(push, ticks.push);
    }

    // Notes the geoms that touch, if they changed.
    void note_contacts(size_t row, std::string& touching, TickEnd& end) const {
        const Contacts contacts(api_->contacts, simulation_.data);
        std::string geoms;
        for (size_t k = 0; k < contacts.count(); ++k) {
            if (!contacts.touches(k)) { continue; }
            const std::array<std::int32_t, 2> pair = contacts.geoms(k);
            geoms.append(reinterpret_cast<const char*>(pair.data()), sizeof(pair));
        }
        if (geoms == touching) { return; }
        touching = std::move(geoms);
        end.contacts.push_back({row, touching});
    }

    Numbers zeros() const { return Numbers(joints()); }

    std::shared_ptr<const MujocoApi> api_;
    MujocoSimulation simulation_;
    TickLoopOptions options_;
    Dynamics pushed_;
    std::mutex in_use_;
    Numbers q_ = zeros(), q_seen_ = zeros(), v_seen_ = zeros(), tau_ = zeros();
    Wrench wrench_{};
};

}  // namespace armctl
