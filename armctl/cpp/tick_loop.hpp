// The tick loop of a simulation: measure, control, step, record.
#pragma once
#include <mutex>

#include "dynamics.hpp"
#include "law.hpp"
#include "sensors.hpp"
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
    size_t measured = 0;     // rows in which the state was measured
    size_t driven = 0;       // rows in which the motors got a command
    std::string error = {};  // MuJoCo's message, if it could not make a step
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
    MatrixResult wrench_rows{};  // (ticks, 6 for each wrench sensor) the true wrenches, if they are measured
    // What disturbs the signals. From here on, the first row is that of the first tick.
    Vector noise{};         // (last - first, 2, n) on measured positions and velocities
    Integers ages{};        // (last - first, n) ticks, of what is read
    Integers jitter{};      // (last - first,) ticks by which a command is late, besides the delay
    Matrix pushes{};        // (last - first, 6) N and N m on the tip
    Result push{};          // (6,) the wrench of the last tick, which the loop writes
    Vector times{};         // (last - first,) s, for wrench sensors
    Matrix wrench_noise{};  // (last - first, 6 for each wrench sensor)
    // What is measured, for a law that does not get it as an argument.
    MatrixResult q_seen_rows{};           // (last - first, n)
    MatrixResult v_seen_rows{};           // (last - first, n)
    MatrixResult wrench_seen_rows{};      // (last - first, 6 for each wrench sensor)
    MatrixResult deflection_seen_rows{};  // (last - first, 2 n)

    // How many they are; InputError if they are not in the trajectory.
    size_t count() const {
        if (first > last || last > v_rows.rows) { throw InputError("first, last: they are not rows of the reference"); }
        return last - first;
    }

    Setpoint setpoint(size_t row) const {
        return {q.row(row), v.row(row), a.row(row), v_tick.row(row), a_tick.row(row), q.from(row), v_tick.from(row), a_tick.from(row)};
    }
};

// What is between a law and an arm; each part may be missing.
struct Signals {
    Sensors* sensors = nullptr;                   // else the law gets the true state
    Delay* delay = nullptr;                       // else the motors get the command itself
    Law* joint_torque = nullptr;                  // further torques on the links, of the true state
    std::vector<WrenchSensor*> wrench_sensors{};  // on the tips of the arms, whose joints follow one another
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

    // Throws InputError if the ticks cannot run with a law and these signals.
    void check(const Ticks& ticks, const Law& law, const Signals& signals) const {
        require_joints(law.joints(), "law");
        if (signals.sensors != nullptr) { require_joints(signals.sensors->joints(), "sensors"); }
        if (signals.delay != nullptr) { require_joints(signals.delay->joints(), "delay"); }
        if (signals.joint_torque != nullptr) { require_joints(signals.joint_torque->joints(), "joint_torque"); }
        if (ticks.pushes.rows > 0 && ticks.push.empty()) { throw InputError("pushes: they need `push`, where the last one is noted"); }
        const std::vector<WrenchSensor*>& tips = signals.wrench_sensors;
        size_t sensed = 0;
        for (const WrenchSensor* sensor : tips) { sensed += sensor->joints(); }
        if (!tips.empty()) { require_joints(sensed, "wrench_sensors"); }
        const bool is_sensed = !tips.empty() && !ticks.times.empty() && ticks.wrench_rows.columns == 6 * tips.size();
        if (ticks.count() > 0 && (law.needs_wrench() || !tips.empty()) && !is_sensed) {
            throw InputError("wrench_sensors: a law that needs the wrench needs a sensor, the times of the ticks, and wrench_rows");
        }
        if (law.needs_wrench() && tips.size() > 1) { throw InputError("wrench_sensors: a law gets one wrench"); }
    }

    // Runs the ticks with the law. `touching` are the geoms that touch in the row before.
    [[nodiscard]] TickEnd run(const Ticks& ticks, Law& law, const Signals& signals, std::string touching) {
        const std::unique_lock lock(in_use_, std::try_to_lock);
        if (!lock.owns_lock()) { throw InputError("simulation: another thread runs it; give each thread a simulation of its own"); }
        wrench_.resize(6 * signals.wrench_sensors.size());
        // What owns memory belongs to this call, which errors of MuJoCo do not leave.
        TickEnd end{.row = ticks.first, .count = ticks.first};
        auto work = [&] { run_ticks(ticks, law, signals, touching, end); };
        end.error = guarded(*api_, work);
        if (!end.error.empty() && signals.sensors != nullptr) { signals.sensors->end_tick(); }
        return end;
    }

private:
    void require_joints(size_t given, const char* name) const {
        if (given == joints()) { return; }
        throw InputError(std::string(name) + ": it is one for " + std::to_string(given) + " joints, and the simulation has " +
                         std::to_string(joints()));
    }

    void run_ticks(const Ticks& ticks, Law& law, const Signals& signals, std::string& touching, TickEnd& end) {
        for (size_t row = ticks.first; row < ticks.last; ++row) {
            end.row = row;
            copy(simulation_.qpos, ticks.qpos_rows.row(row));
            const double speed = read_joints(options_.motors, simulation_, q_, ticks.v_rows.row(row));
            if (!(speed < options_.diverged_speed)) {
                end.status = TickStatus::diverged;
                return;
            }
            const State state = measured(ticks, signals, row);
            ++end.measured;
            law.torque(state, ticks.setpoint(row), tau_);
            copy(tau_, ticks.command_rows.row(row));
            if (!is_finite(tau_) || !push(ticks, signals, row)) {
                end.status = TickStatus::not_finite;
                return;
            }
            ++end.driven;
            if (signals.sensors != nullptr) { signals.sensors->end_tick(); }
            move_arm(*api_, options_.motors, delayed(ticks, signals, row), options_.substeps, simulation_);
            if (has_repaired(api_->repairs, simulation_.data)) {
                end.status = TickStatus::repaired;
                return;
            }
            read_torques(options_.motors, simulation_, ticks.torque_rows.row(row));
            end.count = row + 1;
            note_contacts(row, touching, end);
        }
    }

    static bool is_finite(Vector numbers) {
        return std::ranges::all_of(numbers, [](double number) { return std::isfinite(number); });
    }

    // What the law gets at a tick.
    State measured(const Ticks& ticks, const Signals& signals, size_t row) {
        const size_t tick = row - ticks.first;
        const size_t n = joints();
        State state{.q = q_, .v = ticks.v_rows.row(row), .wrench = {}};
        if (signals.sensors != nullptr) {
            const Vector noise = ticks.noise.empty() ? Vector() : ticks.noise.subspan(2 * n * tick, 2 * n);
            const Integers ages = ticks.ages.empty() ? Integers() : ticks.ages.subspan(n * tick, n);
            signals.sensors->measure(simulation_, noise, ages);
            state.q = signals.sensors->q();
            state.v = signals.sensors->v();
        }
        if (!signals.wrench_sensors.empty()) {
            measure_wrenches(ticks, signals, row, state);
            state.wrench = wrench_;
        }
        if (ticks.q_seen_rows.rows > 0) {
            copy(state.q, ticks.q_seen_rows.row(tick));
            copy(state.v, ticks.v_seen_rows.row(tick));
        }
        if (ticks.wrench_seen_rows.rows > 0) { copy(state.wrench, ticks.wrench_seen_rows.row(tick)); }
        if (ticks.deflection_seen_rows.rows > 0 && signals.sensors != nullptr) {
            copy(signals.sensors->deflection(), ticks.deflection_seen_rows.row(tick));
        }
        return state;
    }

    // The wrenches for the law, (6,) each, and the true ones for their row.
    void measure_wrenches(const Ticks& ticks, const Signals& signals, size_t row, const State& state) {
        const size_t tick = row - ticks.first;
        read_torques(options_.motors, simulation_, tau_);
        size_t first = 0;
        for (size_t k = 0; k < signals.wrench_sensors.size(); ++k) {
            WrenchSensor& sensor = *signals.wrench_sensors[k];
            const size_t n = sensor.joints();
            const WrenchSignals at_tip{
                .t = ticks.times[tick],
                .q = state.q.subspan(first, n),
                .v = state.v.subspan(first, n),
                .tau = Vector(tau_).subspan(first, n),
                .noise = ticks.wrench_noise.rows > 0 ? ticks.wrench_noise.row(tick).subspan(6 * k, 6) : Vector(),
                .push = k == 0 ? Vector(ticks.push) : Vector(),
            };
            Wrench truth;
            copy(sensor.measure(at_tip, truth), Result(wrench_).subspan(6 * k, 6));
            copy(truth, ticks.wrench_rows.row(row).subspan(6 * k, 6));
            first += n;
        }
    }

    // Applies the forces on the links. False if the plant gave none.
    bool push(const Ticks& ticks, const Signals& signals, size_t row) {
        if (ticks.pushes.rows == 0 && signals.joint_torque == nullptr) { return true; }
        std::ranges::fill(pushing_, 0.0);
        if (ticks.pushes.rows > 0) {
            const size_t n = pushed_.model().n();
            copy(ticks.pushes.row(row - ticks.first), ticks.push);
            pushed_.tip_force(Vector(q_).first(n), ticks.push, Result(pushing_).first(n));
        }
        if (signals.joint_torque != nullptr) {
            signals.joint_torque->torque({.q = q_, .v = ticks.v_rows.row(row), .wrench = {}}, ticks.setpoint(row), joint_torque_);
            if (!is_finite(joint_torque_)) { return false; }
            for (size_t i = 0; i < pushing_.size(); ++i) { pushing_[i] += joint_torque_[i]; }
        }
        push_links(options_.motors, pushing_, simulation_);
        return true;
    }

    // The torque that the motors get at a tick.
    Vector delayed(const Ticks& ticks, const Signals& signals, size_t row) {
        if (signals.delay == nullptr) { return tau_; }
        return signals.delay->delayed(tau_, ticks.jitter.empty() ? 0 : static_cast<size_t>(ticks.jitter[row - ticks.first]));
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
    Numbers q_ = zeros(), tau_ = zeros(), pushing_ = zeros(), joint_torque_ = zeros();
    Numbers wrench_;  // (6,) for each wrench sensor
};

}  // namespace armctl
