// How the sensors of a plant or an environment measure joints: with noise, in steps, late, at the links or at the motors.
#pragma once
#include "motors.hpp"

namespace armctl {

struct SensorsOptions {
    Motors motors;
    double dt = 0.0;              // s, the tick
    Numbers steps{};              // (n,) rad, of the encoders; empty for exact ones
    bool is_at_motors = false;    // whether the encoders are at the motors instead of the links
    bool is_differenced = false;  // whether a measured velocity is the difference of two measured positions
    size_t max_age = 0;           // ticks by which what is read is old at most
};

// The sensors of one run, which know what they measured in its earlier ticks.
class Sensors {
public:
    explicit Sensors(SensorsOptions options)
        : options_(std::move(options)), samples_(options_.max_age + 1, 4 * joints()), read_(4 * joints()), last_(joints(), unknown) {
        if (!options_.steps.empty() && options_.steps.size() != joints()) { throw InputError("steps: need one for each joint"); }
    }

    size_t joints() const { return options_.motors.size(); }

    // Begins a new run.
    void restart() {
        std::ranges::fill(last_, unknown);
        taken_ = 0;
        has_measured_ = false;
    }

    // Whether this tick is measured already.
    bool has_measured() const { return has_measured_; }

    // Begins the next tick.
    void end_tick() { has_measured_ = false; }

    // Measures, once in a tick. The noise (2, n) on positions and velocities, and the ages (n,) in ticks of what is read, may be empty.
    void measure(const MujocoSimulation& simulation, Vector noise, Integers ages) {
        if (has_measured_) { return; }
        has_measured_ = true;
        const size_t n = joints();
        const Result sample = samples_.row(taken_ % samples_.rows());
        ++taken_;
        const Result q = sample.first(n);
        const Result v = sample.subspan(n, n);
        const Result shift = sample.subspan(2 * n, n);
        const Result shift_rate = sample.last(n);
        read_joints(options_.motors, simulation, q, v);
        read_rotors(options_.motors, simulation, shift, shift_rate);
        for (size_t i = 0; i < n; ++i) {
            const double rotor = shift[i];
            const double rotor_speed = shift_rate[i];
            shift[i] -= q[i];
            shift_rate[i] -= v[i];
            if (options_.is_at_motors) {
                q[i] = rotor;
                v[i] = rotor_speed;
            }
            measure_joint(i, q[i], v[i], noise);
        }
        for (size_t i = 0; i < n; ++i) {
            const size_t age = ages.empty() ? 0 : static_cast<size_t>(std::max<std::int64_t>(ages[i], 0));
            const size_t newest = taken_ - 1;
            const Vector then = samples_.row((newest - std::min({age, newest, options_.max_age})) % samples_.rows());
            for (size_t k = i; k < read_.size(); k += n) { read_[k] = then[k]; }
        }
    }

    // What was read at this tick, (n,) each: rad and rad/s.
    Vector q() const { return Vector(read_).first(joints()); }
    Vector v() const { return Vector(read_).subspan(joints(), joints()); }
    // Positions and velocities of the motors minus those of the links, (2 n,).
    Vector deflection() const { return Vector(read_).last(2 * joints()); }

private:
    static constexpr double unknown = std::numeric_limits<double>::quiet_NaN();

    // What the encoder of a joint makes of its true position and velocity, in place.
    void measure_joint(size_t i, double& q, double& v, Vector noise) {
        const size_t n = joints();
        const bool is_coarse = !options_.steps.empty();
        const double truth = q;
        const double speed_noise = noise.empty() ? 0.0 : noise[n + i];
        if (!noise.empty()) { q += noise[i]; }
        if (is_coarse) { q = options_.steps[i] * std::nearbyint(q / options_.steps[i]); }
        // The noise of a velocity is that of the difference already; steps of the encoder are not.
        const double seen = is_coarse ? q : truth;
        const double before = last_[i];
        last_[i] = seen;
        if (!options_.is_differenced || std::isnan(before)) {
            v += speed_noise;
        } else {
            v = (seen - before) / options_.dt + (is_coarse ? 0.0 : speed_noise);
        }
    }

    SensorsOptions options_;
    Mat samples_;  // ring buffer of (4 n,): positions, velocities, deflections and their rates
    Numbers read_;
    Numbers last_;  // (n,) rad, the positions of the last tick whose differences are velocities
    size_t taken_ = 0;
    bool has_measured_ = false;
};

}  // namespace armctl
