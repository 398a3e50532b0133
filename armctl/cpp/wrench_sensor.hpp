// The wrench of the environment on the tip of an arm, true or as a sensor measures it: with noise and delay, by a flange sensor
// or from the torques of the motors.
#pragma once
#include <array>
#include <limits>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "dynamics.hpp"
#include "mujoco_api.hpp"
#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

// A wrench at the tip, in world axes.
struct Wrench {
    Vec3 force;   // N
    Vec3 moment;  // N m

    void store(Result numbers) const;
};

inline Wrench& operator+=(Wrench& a, const Wrench& b) {
    a.force += b.force;
    a.moment += b.moment;
    return a;
}

// A wrench from (6,) numbers, force first.
inline Wrench wrench_of(Vector numbers) { return {vec3(numbers.first(3)), vec3(numbers.subspan(3, 3))}; }

// Where the wrench acts.
struct WrenchSite {
    size_t joints = 0;           // of the arm
    std::vector<size_t> bodies;  // behind the arm's last joint
    size_t root = 0;             // body of the tree
    size_t tip = 0;              // body
    Vec3 offset;                 // m, of the tip in its body
    bool is_connected = false;   // equalities act on bodies of the model
};

// How a wrench is measured.
struct WrenchMeasurement {
    double dt = 0.0;          // s, the tick
    size_t delay = 0;         // ticks
    bool is_sampled = false;  // noise, delay or an estimate: the measurement differs from the true wrench
};

// The wrench on the tip from torques and motion of the joints, w = J^-T LP[ID(q, v, (v_next - v) / dt) - tau].
//
// After De Luca, Mattone, "Sensorless robot collision detection and hybrid force/motion control" (2005), with the discrete
// inverse dynamics of the nominal model. Errors of the model, such as friction and payloads, appear as forces.
class WrenchEstimate {
public:
    // rows: 3 for the force only, 6 for force and moment.
    WrenchEstimate(std::shared_ptr<const ArmModel> model, double dt, size_t rows);

    void reset();

    // The wrench at time t, s, from measured positions and velocities and the torques of the last tick, (n,) each.
    Wrench update(double t, Vector q, Vector v, Vector tau);

private:
    Dynamics dynamics_;
    double dt_;
    size_t rows_;
    double last_t_ = std::numeric_limits<double>::quiet_NaN();
    std::vector<double> last_q_;
    std::vector<double> last_v_;
    std::vector<double> filtered_;
    std::vector<double> acceleration_;
    std::vector<double> needed_;
    std::vector<double> jacobian_;  // (6, n)
};

// What a sensor is given at a tick.
struct WrenchSignals {
    double t = 0.0;  // s
    Vector q;        // (n,) rad, measured
    Vector v;        // (n,) rad/s, measured
    Vector tau;      // (n,) N m of the motors in the last tick
    Vector noise;    // (6,) of a new measurement; empty for none
    Vector push;     // (6,) the wrench of the plant's pushes; empty for none
};

class WrenchSensor {
public:
    // `estimate` is empty if a flange sensor measures the wrench.
    WrenchSensor(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, WrenchSite site, WrenchMeasurement measurement,
                 std::optional<WrenchEstimate> estimate);

    // The number of joints of the arm.
    size_t joints() const { return site_.joints; }

    // Forgets all measurements.
    void reset();

    // The true wrench: of contacts, connections, applied forces and pushes.
    Wrench read(Vector push) const;

    // What the sensor gives at this tick, the same until the next one. Sets `truth` to the true wrench.
    Wrench measure(const WrenchSignals& signals, Wrench& truth);

private:
    struct Sample {
        double t = 0.0;
        Wrench wrench;
    };

    bool is_loaded() const;
    Wrench external_wrench() const;
    Sample& sample(size_t age_rank) { return samples_[(oldest_ + age_rank) % samples_.size()]; }
    void forget_oldest();

    std::shared_ptr<const MujocoApi> api_;
    MujocoSimulation simulation_;
    WrenchSite site_;
    WrenchMeasurement measurement_;
    std::optional<WrenchEstimate> estimate_;
    std::vector<Sample> samples_;  // ring buffer
    size_t oldest_ = 0;
    size_t count_ = 0;
};

}  // namespace armctl
