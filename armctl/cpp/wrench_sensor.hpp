// The wrench of the environment on the tip of an arm, true or as a sensor measures it: with noise and delay, by a flange sensor
// or from the torques of the motors.
#pragma once
#include <deque>
#include <limits>
#include <optional>

#include "dynamics.hpp"
#include "errors.hpp"
#include "law.hpp"
#include "mujoco_api.hpp"

namespace armctl {

// N and N m, at the tip: force first, world axes.
using Wrench = std::array<double, 6>;

// What a sensor is given at a tick.
struct WrenchSignals {
    double t = 0.0;  // s
    Vector q;        // (n,) rad, measured
    Vector v;        // (n,) rad/s, measured
    Vector tau;      // (n,) N m of the motors in the last tick
    Vector noise;    // (6,) of a new measurement; empty for none
    Vector push;     // (6,) the wrench of the plant's pushes; empty for none
};

// The wrench on the tip from torques and motion of the joints, w = J^-T LP[ID(q, v, (v_next - v) / dt) - tau].
//
// After De Luca, Mattone, "Sensorless robot collision detection and hybrid force/motion control" (2005), with the discrete
// inverse dynamics of the nominal model. Errors of the model, such as friction and payloads, appear as forces.
class WrenchEstimate {
public:
    // rows: 3 for the force only, 6 for force and moment.
    WrenchEstimate(const Model& model, double dt, size_t rows) : dynamics_(model), dt_(dt), square_(rows, rows) {}

    void reset() { last_t_ = std::numeric_limits<double>::quiet_NaN(); }

    Wrench update(const WrenchSignals& signals) {
        const bool follows = std::abs(signals.t - last_t_ - dt_) <= 0.5 * dt_;
        if (follows) {
            for (size_t i = 0; i < last_v_.size(); ++i) { acceleration_[i] = (signals.v[i] - last_v_[i]) / dt_; }
            dynamics_.inverse_dynamics(last_q_, last_v_, acceleration_, needed_);
            dynamics_.add_friction(last_v_, acceleration_, needed_);
            for (size_t i = 0; i < needed_.size(); ++i) {
                filtered_[i] += low_pass_weight(bandwidth, dt_) * (needed_[i] - signals.tau[i] - filtered_[i]);
            }
        } else {
            std::ranges::fill(filtered_, 0.0);
        }
        last_t_ = signals.t;
        copy(signals.q, last_q_);
        copy(signals.v, last_v_);
        dynamics_.locate(signals.q);
        return wrench_for_torques();
    }

private:
    static constexpr double bandwidth = 200.0;  // rad/s of the low-pass
    // Relative, of J J^T: a wrench along a direction of less, which is nearly singular, hardly moves a joint.
    static constexpr double damping = 1e-13;

    // The shortest wrench that explains the torques best, at the located joints: (J J^T + damping)^-1 J tau.
    Wrench wrench_for_torques() {
        const Matrix J = dynamics_.tip_jacobian();
        const size_t rows = square_.rows();
        Wrench wrench{};
        double trace = 0.0;
        for (size_t r = 0; r < rows; ++r) {
            for (size_t c = 0; c <= r; ++c) { square_(r, c) = dot(J.row(r), J.row(c)); }
            trace += square_(r, r);
            wrench[r] = dot(J.row(r), filtered_);
        }
        for (size_t r = 0; r < rows; ++r) { square_(r, r) += damping * trace; }
        factorize(square_);
        solve(square_, Result(wrench).first(rows));
        return wrench;
    }

    Numbers zeros() const { return Numbers(dynamics_.model().n()); }

    Dynamics dynamics_;
    double dt_;
    double last_t_ = std::numeric_limits<double>::quiet_NaN();
    Mat square_;
    Numbers last_q_ = zeros(), last_v_ = zeros(), filtered_ = zeros(), acceleration_ = zeros(), needed_ = zeros();
};

struct WrenchSensorOptions {
    std::vector<size_t> bodies;  // behind the arm's last joint
    size_t root = 0;             // the body of the tree
    size_t tip = 0;              // the body of the tip
    Vec3 offset;                 // m, of the tip in its body
    bool is_connected = false;   // whether equalities act on bodies of the model
    bool is_sampled = false;     // whether noise, delay or an estimate makes the measurement differ from the true wrench
    double dt = 0.0;             // s, the tick
    size_t delay = 0;            // ticks after which the sensor gives a wrench
    // Numbers of the wrench, 3 or 6, that follow from the torques of the motors; 0 if a flange sensor measures it.
    size_t estimated = 0;
};

class WrenchSensor {
public:
    WrenchSensor(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, const Model& arm, WrenchSensorOptions options)
        : api_(std::move(api)), simulation_(simulation), joints_(arm->n()), options_(std::move(options)) {
        const size_t count = simulation.xpos.rows;
        require_index(options_.root, count, "root");
        require_index(options_.tip, count, "tip");
        for (const size_t body : options_.bodies) { require_index(body, count, "bodies"); }
        const size_t estimated = options_.estimated;
        if (estimated != 0 && estimated != 3 && estimated != 6) { throw InputError("estimated: need 0, 3 or 6"); }
        if (estimated > 0) { estimate_.emplace(arm, options_.dt, estimated); }
    }

    size_t joints() const { return joints_; }

    // Forgets all measurements.
    void reset() {
        samples_.clear();
        if (estimate_) { estimate_->reset(); }
    }

    // Whether the measurement at a time, s, is made already.
    bool has_measured(double t) const { return !samples_.empty() && samples_.back().t == t; }

    // The true wrench: of contacts, connections, applied forces and pushes.
    Wrench read(Vector push) const {
        Wrench wrench{};
        if (is_loaded()) {
            api_->rne_post_constraint(simulation_.model, simulation_.data);
            wrench = external_wrench();
        }
        add(push, wrench);
        return wrench;
    }

    // What the sensor gives at this tick, the same until the next one. Sets `truth` to the true wrench.
    Wrench measure(const WrenchSignals& signals, Wrench& truth) {
        truth = read(signals.push);
        if (!options_.is_sampled) { return truth; }
        if (!has_measured(signals.t)) {
            Wrench wrench = estimate_ ? estimate_->update(signals) : truth;
            add(signals.noise, wrench);
            samples_.push_back({signals.t, wrench});
        }
        // The caller's ticks may be shorter than those of the sensor.
        const auto is_too_old = [&](const Sample& sample) {
            return sample.t < signals.t - (static_cast<double>(options_.delay) + 0.5) * options_.dt;
        };
        while (samples_.size() > max_samples() || (samples_.size() > 1 && is_too_old(samples_.front()))) { samples_.pop_front(); }
        return samples_.front().wrench;
    }

private:
    struct Sample {
        double t = 0.0;
        Wrench wrench{};
    };

    // Those of the delay, the newest one, and one in reserve: a rounding error may keep a sample a tick longer.
    size_t max_samples() const { return options_.delay + 2; }

    // Adds a wrench, if there is one.
    static void add(Vector added, Result wrench) {
        for (size_t k = 0; k < added.size(); ++k) { wrench[k] += added[k]; }
    }

    bool is_loaded() const {
        if (options_.is_connected || Contacts(api_->contacts, simulation_.data).count() != 0) { return true; }
        const Matrix& applied = simulation_.xfrc_applied;
        return std::ranges::any_of(Vector(applied.data, applied.rows * applied.columns), [](double force) { return force != 0.0; });
    }

    // The sum of MuJoCo's external forces on the bodies behind the last joint. Forces between two of the bodies, such as two
    // fingers, cancel.
    Wrench external_wrench() const {
        Vec3 force;
        Vec3 moment;  // about the center of mass of the tree
        for (const size_t body : options_.bodies) {
            const Vector external = simulation_.cfrc_ext.row(body);
            moment += vec3(external);
            force += vec3(external.subspan(3));
        }
        const Pose T_world_tip_body{Rotation::from_rows(simulation_.xmat.row(options_.tip)), vec3(simulation_.xpos.row(options_.tip))};
        const Vec3 lever = T_world_tip_body * options_.offset - vec3(simulation_.subtree_com.row(options_.root));
        moment -= cross(lever, force);
        return numbers({force, moment});
    }

    std::shared_ptr<const MujocoApi> api_;
    MujocoSimulation simulation_;
    size_t joints_;
    WrenchSensorOptions options_;
    std::optional<WrenchEstimate> estimate_;
    std::deque<Sample> samples_;
};

}  // namespace armctl
