// The tick loop of a simulation: measure, control, step, record.
#pragma once
#include <array>
#include <mutex>

#include "dynamics.hpp"
#include "law.hpp"
#include "motors.hpp"
#include "wrench_sensor.hpp"

namespace armctl {

// The geoms that touch from a row on.
struct ContactChange {
    size_t row = 0;
    std::vector<GeomPair> geoms;
};

enum class TickStatus : std::uint8_t { complete, diverged, not_finite };

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
    Ticks(const Arguments& given, size_t n, size_t nq);

    size_t first;
    size_t last;
    // The trajectory, (ticks, n) each.
    Matrix q;
    Matrix v;
    Matrix a;
    Matrix v_tick;
    Matrix a_tick;
    // The records.
    MatrixResult qpos_rows;     // (ticks, nq) of the whole model
    MatrixResult v_rows;        // (ticks, n) rad/s
    MatrixResult command_rows;  // (ticks, n) N m
    MatrixResult torque_rows;   // (ticks, n) N m, what the motors did
    MatrixResult wrench_rows;   // (ticks, 6) the true wrench, if it is measured
    // What disturbs the signals. The first row is that of the first tick.
    Vector noise;         // (last - first, 2, n) on measured positions and velocities
    Matrix pushes;        // (last - first, 6) N and N m, on the tip
    Result push;          // (6,) the wrench of the last tick, which the loop writes
    Vector times;         // (last - first,) s, for the sensor
    Matrix wrench_noise;  // (last - first, 6)

    Setpoint setpoint(size_t row) const { return {q.row(row), v.row(row), a.row(row), v_tick.row(row), a_tick.row(row)}; }
};

// The loop of one simulation. It is used by one thread at a time: a call while another runs throws InputError.
class TickLoop {
public:
    // `pushed_arm` is the arm on whose tip pushes act; its joints are the first ones. The motors are those of `motors_of`;
    // `substeps` are the steps of MuJoCo in a tick, `diverged_speed`, rad/s, is the norm of the velocities from which a simulation
    // counts as diverged.
    TickLoop(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, const Model& pushed_arm, const Arguments& given)
        : api_(std::move(api)), simulation_(simulation), motors_(motors_of(given)), pushed_(pushed_arm), substeps_(given.count("substeps")),
          diverged_speed_(given.number("diverged_speed")) {
        check_addresses(motors_, simulation_);
        if (pushed_arm->n() > joints()) { throw InputError("pushed_arm: it has more joints than the simulation has motors"); }
    }

    size_t joints() const { return motors_.size(); }
    const MujocoSimulation& simulation() const { return simulation_; }

    // Throws InputError if the ticks cannot run with a law, a delay and a sensor, each of which may be null.
    void check(const Ticks& ticks, const Law& law, const Delay* delay, const WrenchSensor* sensor) const;

    // Runs the ticks with the law. Without a delay, the motors receive the command itself, and nothing pushes. The sensor measures
    // the wrench for a law that needs it. `touching` are the geoms that touch in the row before.
    TickEnd run(const Ticks& ticks, Law& law, Delay* delay, WrenchSensor* sensor, std::vector<GeomPair> touching);

private:
    // What the ticks of one call use. It belongs to `run`, which MuJoCo's errors do not leave.
    struct Run {
        const Ticks& ticks;
        Law& law;
        Delay* delay;
        WrenchSensor* sensor;
        std::vector<GeomPair> touching;
        TickEnd end;
    };

    void run_ticks(Run& run);
    Vector measured_wrench(const Run& run, size_t row);
    void drive(const Run& run, size_t row);
    void note_contacts(Run& run, size_t row) const;
    Numbers zeros() const { return Numbers(joints()); }

    std::shared_ptr<const MujocoApi> api_;
    MujocoSimulation simulation_;
    Motors motors_;
    Dynamics pushed_;
    size_t substeps_;
    double diverged_speed_;
    std::mutex in_use_;
    Numbers q_ = zeros(), q_seen_ = zeros(), v_seen_ = zeros(), tau_ = zeros();
    std::array<double, 6> wrench_{};
};

}  // namespace armctl
