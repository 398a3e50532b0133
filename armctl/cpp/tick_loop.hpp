// The tick loop of a simulation: measure, control, step, record.
#pragma once
#include <array>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "delay.hpp"
#include "law.hpp"
#include "motors.hpp"
#include "mujoco_api.hpp"
#include "spans.hpp"
#include "tip_force.hpp"
#include "wrench_sensor.hpp"

namespace armctl {

// A trajectory on the ticks, (ticks, n) each: rows for a Setpoint.
struct TickReference {
    Matrix q;
    Matrix v;
    Matrix a;
    Matrix v_tick;
    Matrix a_tick;

    Setpoint setpoint(size_t tick) const { return {q.row(tick), v.row(tick), a.row(tick), v_tick.row(tick), a_tick.row(tick)}; }
};

// Where ticks are recorded.
struct TickRows {
    MatrixResult qpos;     // (ticks, nq) of the whole model
    MatrixResult v;        // (ticks, n) rad/s
    MatrixResult command;  // (ticks, n) N m
    MatrixResult torque;   // (ticks, n) N m, what the motors did
    MatrixResult wrench;   // (ticks, 6) the true wrench; empty if it is not measured
};

// What disturbs the signals of the ticks of one call. The first row is that of the first tick.
struct Disturbances {
    Delay* delay = nullptr;  // null: the motors receive the command itself, and nothing pushes
    MeasurementNoise noise;
    Matrix pushes;  // (ticks, 6) N and N m, on the tip; empty for none
    Result push;    // (6,) the wrench of the last tick, which the loop writes
    // (n,) of the last tick, NaN at the first one, for measured velocities that are differences; empty if they are not.
    Result last_position;
};

// Measures the wrench for a law that needs it. The first row is that of the first tick of the call.
struct TickSensor {
    WrenchSensor* sensor = nullptr;
    Vector times;  // (ticks,) s
    Matrix noise;  // (ticks, 6); empty for none
};

// The geoms that touch from a row on.
struct ContactChange {
    size_t row = 0;
    std::vector<GeomPair> geoms;
};

enum class TickStatus : std::uint8_t { complete, diverged, not_finite };

struct TickEnd {
    TickStatus status = TickStatus::complete;
    size_t row = 0;                   // the last one that was begun
    size_t count = 0;                 // complete rows
    std::string error = {};           // MuJoCo's message, if it could not make a step
    std::vector<double> q_seen = {};  // measured in the last row that was begun
    std::vector<double> v_seen = {};
    std::vector<ContactChange> contacts = {};
};

struct TickOptions {
    size_t substeps = 1;          // steps of MuJoCo in a tick
    double dt = 0.0;              // s, the tick
    double diverged_speed = 0.0;  // rad/s, norm of the velocities from which a simulation counts as diverged
};

// The loop of one simulation. It is used by one thread at a time: a call while another runs throws InputError.
class TickLoop {
public:
    // `pushed_arm` is the arm on whose tip pushes act; its joints are the first ones.
    TickLoop(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, std::vector<Motor> motors,
             std::shared_ptr<const ArmModel> pushed_arm, const TickOptions& options);

    size_t joints() const { return motors_.size(); }
    const MujocoSimulation& simulation() const { return simulation_; }

    // Runs the ticks [first, last) with the law. `touching` are the geoms that touch in the row before.
    TickEnd run(Law& law, const TickReference& reference, const TickRows& rows, size_t first, size_t last, const Disturbances& disturbances,
                const TickSensor& sensor, std::vector<GeomPair> touching);

private:
    // What the ticks of one call use. It belongs to `run`, which MuJoCo's errors do not leave.
    struct Run {
        Law& law;
        const TickReference& reference;
        const TickRows& rows;
        size_t first;
        size_t last;
        const Disturbances& disturbances;
        const TickSensor& sensor;
        std::vector<GeomPair> touching;
        TickEnd end;
    };

    void run_ticks(Run& run);
    Vector measured_wrench(Run& run, size_t row);
    void measure_velocity(Result last_position);
    void drive(const Run& run, size_t row);
    void note_contacts(Run& run, size_t row) const;

    std::shared_ptr<const MujocoApi> api_;
    MujocoSimulation simulation_;
    std::vector<Motor> motors_;
    TipForce pushed_;
    TickOptions options_;
    std::mutex in_use_;
    // Scratch memory, (n,) each.
    std::vector<double> q_;
    std::vector<double> q_seen_;
    std::vector<double> v_seen_;
    std::vector<double> tau_;
    std::array<double, 6> wrench_{};
};

}  // namespace armctl
