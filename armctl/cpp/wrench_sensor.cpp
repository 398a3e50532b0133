#include "wrench_sensor.hpp"

#include <algorithm>
#include <cmath>

#include "errors.hpp"
#include "least_squares.hpp"

namespace armctl {

namespace {

constexpr double ESTIMATE_BANDWIDTH = 200.0;  // rad/s of the low-pass of wrenches that are estimated from torques

}  // namespace

void Wrench::store(Result numbers) const {
    numbers[0] = force.x;
    numbers[1] = force.y;
    numbers[2] = force.z;
    numbers[3] = moment.x;
    numbers[4] = moment.y;
    numbers[5] = moment.z;
}

WrenchEstimate::WrenchEstimate(std::shared_ptr<const ArmModel> model, double dt, size_t rows)
    : dynamics_(std::move(model)), dt_(dt), rows_(rows) {
    const size_t n = dynamics_.model().n();
    last_q_.resize(n);
    last_v_.resize(n);
    filtered_.resize(n);
    acceleration_.resize(n);
    needed_.resize(n);
    jacobian_.resize(6 * n);
}

void WrenchEstimate::reset() {
    last_t_ = std::numeric_limits<double>::quiet_NaN();
    std::ranges::fill(filtered_, 0.0);
}

Wrench WrenchEstimate::update(double t, Vector q, Vector v, Vector tau) {
    const size_t n = last_q_.size();
    const bool follows = std::abs(t - last_t_ - dt_) <= 0.5 * dt_;
    if (follows) {
        for (size_t i = 0; i < n; ++i) { acceleration_[i] = (v[i] - last_v_[i]) / dt_; }
        dynamics_.inverse_dynamics(last_q_, last_v_, acceleration_, needed_);
        dynamics_.add_friction(last_v_, acceleration_, needed_);
        for (size_t i = 0; i < n; ++i) { filtered_[i] -= std::expm1(-ESTIMATE_BANDWIDTH * dt_) * (needed_[i] - tau[i] - filtered_[i]); }
    } else {
        std::ranges::fill(filtered_, 0.0);
    }
    last_t_ = t;
    std::ranges::copy(q, last_q_.begin());
    std::ranges::copy(v, last_v_.begin());
    dynamics_.place(q);
    dynamics_.locate();
    dynamics_.tip_jacobian({jacobian_.data(), 6, n});
    std::array<double, 36> rotations;
    std::array<double, 6> wrench{};
    solve_least_squares({jacobian_.data(), rows_, n}, filtered_, {rotations.data(), rows_, rows_}, wrench);
    return wrench_of(wrench);
}

WrenchSensor::WrenchSensor(std::shared_ptr<const MujocoApi> api, const MujocoSimulation& simulation, WrenchSite site,
                           WrenchMeasurement measurement, std::optional<WrenchEstimate> estimate)
    : api_(std::move(api)), simulation_(simulation), site_(std::move(site)), measurement_(measurement), estimate_(std::move(estimate)),
      // Those of the delay, the newest one, and one in reserve: a rounding error may keep a sample a tick longer.
      samples_(measurement.delay + 2) {
    const size_t bodies = simulation.xpos.rows;
    const bool are_bodies = std::ranges::all_of(site_.bodies, [bodies](size_t body) { return body < bodies; });
    if (!are_bodies || site_.root >= bodies || site_.tip >= bodies) { throw InputError("site: the model has no such body"); }
}

void WrenchSensor::reset() {
    oldest_ = 0;
    count_ = 0;
    if (estimate_) { estimate_->reset(); }
}

bool WrenchSensor::is_loaded() const {
    if (site_.is_connected || Contacts(api_->contacts, simulation_.data).count() != 0) { return true; }
    const Matrix& applied = simulation_.xfrc_applied;
    return std::ranges::any_of(Vector(applied.data, applied.rows * applied.columns), [](double force) { return force != 0.0; });
}

Wrench WrenchSensor::read(Vector push) const {
    Wrench wrench;
    if (is_loaded()) {
        api_->rne_post_constraint(simulation_.model, simulation_.data);
        wrench = external_wrench();
    }
    if (!push.empty()) { wrench += wrench_of(push); }
    return wrench;
}

// The sum of MuJoCo's external forces on the bodies behind the last joint. Forces between two of the bodies, such as two
// fingers, cancel.
Wrench WrenchSensor::external_wrench() const {
    Wrench wrench;
    for (const size_t body : site_.bodies) {
        const Vector external = simulation_.cfrc_ext.row(body);  // torque first, about the center of mass of the tree
        wrench.force += vec3(external.subspan(3, 3));
        wrench.moment += vec3(external.first(3));
    }
    const Rotation rotation = Rotation::from_rows(simulation_.xmat.row(site_.tip));
    Vec3 lever = vec3(simulation_.xpos.row(site_.tip)) - vec3(simulation_.subtree_com.row(site_.root));
    lever += site_.offset.x * rotation.x;
    lever += site_.offset.y * rotation.y;
    lever += site_.offset.z * rotation.z;
    wrench.moment -= cross(lever, wrench.force);
    return wrench;
}

void WrenchSensor::forget_oldest() {
    oldest_ = (oldest_ + 1) % samples_.size();
    --count_;
}

Wrench WrenchSensor::measure(const WrenchSignals& signals, Wrench& truth) {
    truth = read(signals.push);
    if (!measurement_.is_sampled) { return truth; }
    if (count_ == 0 || sample(count_ - 1).t != signals.t) {
        if (count_ == samples_.size()) {  // the caller's ticks are shorter than those of the sensor
            forget_oldest();
        }
        Sample& newest = sample(count_);
        ++count_;
        newest.t = signals.t;
        newest.wrench = estimate_ ? estimate_->update(signals.t, signals.q, signals.v, signals.tau) : truth;
        if (!signals.noise.empty()) { newest.wrench += wrench_of(signals.noise); }
    }
    const double age = (static_cast<double>(measurement_.delay) + 0.5) * measurement_.dt;
    while (count_ > 1 && sample(0).t < signals.t - age) { forget_oldest(); }
    return sample(0).wrench;
}

}  // namespace armctl
