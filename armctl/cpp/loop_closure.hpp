// Closed loops of links: where the joints that no motor drives are, how fast they move, and how they accelerate.
//
// A loop holds two frames of a tree of joints together. The positions p (m,) of all joints are a function of the positions q (n,)
// of the driven ones: p = R q + offsets for those that are driven, or follow a driven one at a fixed ratio, and for the passive ones
// the solution of the loops' equations r(p) = 0. It is found by Newton's method along the straight line from a reference, at which
// it is known, to q: so it depends on nothing but q, and stays on one branch.
#pragma once
#include <algorithm>
#include <memory>
#include <vector>

#include "errors.hpp"
#include "linear_algebra.hpp"
#include "vectors.hpp"

namespace armctl {

// A joint that turns about, or slides along, the z axis of its own frame.
struct LoopJoint {
    Pose placement;  // in the parent's frame, at position zero
    bool slides = false;
    int parent = -1;  // -1 for the base
};

// A frame that a joint carries; joint -1 is the base.
struct LoopFrame {
    int joint = -1;
    Pose placement;  // in the joint's frame
};

// Two frames that coincide: their origins only, or also their axes.
struct Loop {
    LoopFrame first;
    LoopFrame second;
    bool holds_axes = false;

    size_t rows() const { return holds_axes ? 6 : 3; }
};

// Two joints that are tied to each other: the position of `follower` is a polynomial of that of `leader`.
struct TiedJoints {
    size_t follower = 0;
    size_t leader = 0;
    std::array<double, 5> terms{};
};

struct ClosureDescription {
    std::vector<LoopJoint> joints{};  // m, parents before children
    Mat ratio;                        // (m, n), zero in the rows of passive joints
    Numbers offsets;                  // (m,)
    std::vector<size_t> passive{};    // the joints that no motor drives
    std::vector<Loop> loops{};
    std::vector<TiedJoints> ties{};
    Numbers low;  // of the passive joints, rad (m)
    Numbers high;
    Numbers reference_q;  // (n,)
    Numbers reference;    // (m,), closed at reference_q
    double length = 1.0;  // m, of a typical link: gaps are measured in it
};

// Immutable after its construction: threads share it.
struct LoopClosure {
    explicit LoopClosure(ClosureDescription given)
        : joints(std::move(given.joints)), ratio(std::move(given.ratio)), offsets(std::move(given.offsets)),
          passive(std::move(given.passive)), low(std::move(given.low)), high(std::move(given.high)), loops(std::move(given.loops)),
          ties(std::move(given.ties)), reference_q(std::move(given.reference_q)), reference(std::move(given.reference)),
          length(given.length) {
        const size_t m = joints.size();
        if (ratio.rows() != m) { throw InputError("ratio: need a row for each joint"); }
        require_size(offsets, m, "offsets");
        require_size(reference, m, "reference");
        require_size(reference_q, ratio.columns(), "reference_q");
        require_size(low, passive.size(), "low");
        require_size(high, passive.size(), "high");
        if (!(length > 0.0)) { throw InputError("length: need a length above 0"); }
        for (size_t j = 0; j < m; ++j) { checked_index(joints[j].parent + 1, j + 1, "parents"); }
        for (const size_t joint : passive) { require_index(joint, m, "passive"); }
        for (const Loop& loop : loops) {
            checked_index(loop.first.joint + 1, m + 1, "first_joints");
            checked_index(loop.second.joint + 1, m + 1, "second_joints");
            rows += loop.rows();
        }
        for (const TiedJoints& tie : ties) {
            require_index(tie.follower, m, "followers");
            require_index(tie.leader, m, "leaders");
        }
        rows += ties.size();
        find_drivers();
    }

    size_t m() const { return joints.size(); }
    size_t n() const { return ratio.columns(); }

    std::vector<LoopJoint> joints;
    Mat ratio;
    Numbers offsets;
    std::vector<size_t> passive;
    Numbers low;
    Numbers high;
    std::vector<Loop> loops;
    std::vector<TiedJoints> ties;
    Numbers reference_q;
    Numbers reference;
    double length;
    size_t rows = 0;              // of the equations
    std::vector<size_t> drivers;  // which of the n move a loop in itself: one that carries a loop as a whole does not

private:
    void find_drivers() {
        std::vector<bool> is_inside(m());
        const auto pass = [&](int joint) {
            for (; joint >= 0; joint = joints[static_cast<size_t>(joint)].parent) {
                is_inside[static_cast<size_t>(joint)] = !is_inside[static_cast<size_t>(joint)];
            }
        };
        std::vector<bool> counts(n());
        for (const Loop& loop : loops) {
            is_inside.assign(m(), false);
            pass(loop.first.joint);
            pass(loop.second.joint);
            for (size_t j = 0; j < m(); ++j) { count(j, is_inside[j], counts); }
        }
        for (const TiedJoints& tie : ties) {
            count(tie.follower, true, counts);
            count(tie.leader, true, counts);
        }
        for (size_t i = 0; i < n(); ++i) {
            if (counts[i]) { drivers.push_back(i); }
        }
    }

    void count(size_t joint, bool is_inside, std::vector<bool>& counts) const {
        for (size_t i = 0; i < n(); ++i) { counts[i] = counts[i] || (is_inside && ratio(joint, i) != 0.0); }
    }
};

using Closure = std::shared_ptr<const LoopClosure>;

// The closed loops at one configuration, with scratch memory: one object for each thread.
class ClosedLoops {
public:
    explicit ClosedLoops(Closure closure)
        : closure_(std::move(closure)), frames_(closure_->m()), motions_(closure_->m()), positions_(closure_->m()), trial_(closure_->m()),
          speeds_(closure_->m()), acceleration_(closure_->m()), q_(closure_->n()), next_q_(closure_->n()), errors_(closure_->rows),
          step_(closure_->passive.size()), G_(closure_->rows, closure_->m()), normal_(closure_->passive.size(), closure_->passive.size()),
          J_(closure_->m(), closure_->n()) {}

    const LoopClosure& closure() const { return *closure_; }

    // Finds the positions of all joints at q (n,), and how they change with q. Returns whether the loops close there; if not, it stays
    // at the last configuration on the way from the reference to q at which they do.
    bool close(Vector q) {
        const LoopClosure& closure = *closure_;
        copy(closure.reference, positions_);
        copy(closure.reference_q, q_);
        place(positions_);
        if (!differentiate()) { return false; }
        double way = 0.0;
        for (const size_t i : closure.drivers) { way = std::max(way, std::abs(q[i] - q_[i])); }
        if (!(way < MAX_WAY)) { return false; }
        double done = 0.0;
        double share = way > MAX_STEP ? MAX_STEP / way : 1.0;
        while (done < 1.0) {
            const double next = std::min(1.0, done + share);
            for (size_t i = 0; i < q.size(); ++i) {
                next_q_[i] = next < 1.0 ? closure.reference_q[i] + next * (q[i] - closure.reference_q[i]) : q[i];
            }
            if (step_to_next()) {
                done = next;
                copy(next_q_, q_);
                copy(trial_, positions_);
                continue;
            }
            share *= 0.5;
            if (share * way < MIN_STEP) { break; }
            place(positions_);
            differentiate();
        }
        if (done < 1.0) {
            place(positions_);
            differentiate();
        }
        return done == 1.0;
    }

    // Fills the left inverse (passive, rows) of the derivatives of the errors by the passive joints, after `close`.
    void invert(MatrixResult inverse) {
        for (size_t row = 0; row < G_.rows(); ++row) {
            for (size_t k = 0; k < step_.size(); ++k) { step_[k] = G_(row, closure_->passive[k]); }
            solve(normal_, step_);
            for (size_t k = 0; k < step_.size(); ++k) { inverse(k, row) = step_[k]; }
        }
    }

    // (m,) rad (m), after `close`.
    Vector positions() const { return positions_; }
    // (m, n), after `close`: the speeds of all joints per speed of the driven ones.
    const Mat& ratio() const { return J_; }
    // By how much the loops are open, in lengths and rad, after `close`.
    double error() const { return largest(errors_); }

    // The accelerations (m,) of all joints at speeds v (n,) of the driven ones whose own accelerations are zero, after `close`: the
    // derivative of `ratio` along the motion, times v.
    Vector acceleration(Vector v) {
        const LoopClosure& closure = *closure_;
        for (size_t j = 0; j < closure.m(); ++j) { speeds_[j] = dot(J_.row(j), v); }
        std::ranges::fill(acceleration_, 0.0);
        move_frames();
        size_t row = 0;
        for (const Loop& loop : closure.loops) {
            const Twist first = frame_acceleration(loop.first);
            const Twist second = frame_acceleration(loop.second);
            row = store(first.linear - second.linear, first.angular - second.angular, loop.holds_axes, row);
        }
        for (const TiedJoints& tie : closure.ties) {
            const double speed = speeds_[tie.leader];
            errors_[row++] = -curve(tie.terms, positions_[tie.leader], 2) * speed * speed;
        }
        project(errors_, step_);
        solve(normal_, step_);
        for (size_t k = 0; k < step_.size(); ++k) { acceleration_[closure.passive[k]] = -step_[k]; }
        return acceleration_;
    }

private:
    static constexpr double MAX_STEP = 0.25;   // rad (m) of a driven joint, from one solution to the next
    static constexpr double MIN_STEP = 1e-6;   // beyond it, the loops do not close
    static constexpr double MAX_WAY = 1e4;     // rad (m)
    static constexpr double MAX_ANSWER = 0.1;  // rad (m): a passive joint that leaves its prediction farther could be on another branch
    static constexpr int MAX_ITERATIONS = 8;
    static constexpr double CONVERGED = 1e-13;  // rad (m), of Newton's last step: the error is its square
    static constexpr double SQUARED = 1e-7;     // rad (m): a later step below it leaves an error of rounding, by quadratic convergence
    static constexpr double CLOSED = 1e-6;      // lengths and rad: numbers of a file are rounded, and a plane of links is never exactly one
    static constexpr double SINGULAR = 1e-12;   // of the squared singular values: passive joints that move a thousand times as fast

    struct Motion {
        Vec3 omega;
        Vec3 alpha;
        Vec3 linear;  // acceleration of the origin
    };

    // A polynomial's value (0), slope (1) or curvature (2).
    static double curve(const std::array<double, 5>& terms, double x, int derivative) {
        double total = 0.0;
        for (int power = 4; power >= derivative; --power) {
            double factor = 1.0;
            for (int k = 0; k < derivative; ++k) { factor *= power - k; }
            total = total * x + factor * terms[static_cast<size_t>(power)];
        }
        return total;
    }

    static double largest(Vector numbers) {
        double most = 0.0;
        for (const double x : numbers) { most = std::max(most, std::abs(x)); }
        return most;
    }

    // Newton's method from the tangent at the last solution to that at `next_q_`. Fills `trial_`.
    bool step_to_next() {
        const LoopClosure& closure = *closure_;
        for (size_t j = 0; j < closure.m(); ++j) { trial_[j] = dot(closure.ratio.row(j), next_q_, closure.offsets[j]); }
        for (const size_t joint : closure.passive) {
            trial_[joint] = positions_[joint];
            for (size_t i = 0; i < q_.size(); ++i) { trial_[joint] += J_(joint, i) * (next_q_[i] - q_[i]); }
        }
        double answer = 0.0;
        for (int iteration = 0; iteration < MAX_ITERATIONS; ++iteration) {
            place(trial_);
            if (!factorize_passive()) { return false; }
            project(errors_, step_);
            solve(normal_, step_);
            const double size = largest(step_);
            answer += size;
            if (!(answer < MAX_ANSWER)) { return false; }
            for (size_t k = 0; k < step_.size(); ++k) { trial_[closure.passive[k]] -= step_[k]; }
            if (size < CONVERGED || (iteration > 0 && size < SQUARED)) {
                place(trial_);
                return largest(errors_) < CLOSED && differentiate();
            }
        }
        return false;
    }

    // Places all joints at positions (m,), and finds the errors of the loops and their derivatives by all joints.
    void place(Vector positions) {
        const LoopClosure& closure = *closure_;
        for (size_t j = 0; j < closure.m(); ++j) {
            const LoopJoint& joint = closure.joints[j];
            const Pose& placement = joint.placement;
            const Pose local = joint.slides ? Pose{placement.rotation, placement.translation + positions[j] * placement.rotation.z}
                                            : Pose{placement.rotation.turned_about_z(positions[j]), placement.translation};
            frames_[j] = joint.parent < 0 ? local : frames_[static_cast<size_t>(joint.parent)] * local;
        }
        std::ranges::fill(G_.numbers(), 0.0);
        size_t row = 0;
        for (const Loop& loop : closure.loops) {
            const Pose first = pose_of(loop.first);
            const Pose second = pose_of(loop.second);
            const Vec3 turn = loop.holds_axes ? rotation_vector(second.rotation, first.rotation) : Vec3{};
            add_derivatives(loop.first.joint, first.translation, 1.0, loop.holds_axes, row);
            add_derivatives(loop.second.joint, second.translation, -1.0, loop.holds_axes, row);
            row = store(first.translation - second.translation, turn, loop.holds_axes, row);
        }
        for (const TiedJoints& tie : closure.ties) {
            errors_[row] = positions[tie.follower] - curve(tie.terms, positions[tie.leader], 0);
            G_(row, tie.follower) += 1.0;
            G_(row, tie.leader) -= curve(tie.terms, positions[tie.leader], 1);
            ++row;
        }
    }

    Pose pose_of(const LoopFrame& frame) const {
        return frame.joint < 0 ? frame.placement : frames_[static_cast<size_t>(frame.joint)] * frame.placement;
    }

    size_t store(Vec3 linear, Vec3 angular, bool holds_axes, size_t row) {
        ((1.0 / closure_->length) * linear).store(Result(errors_).subspan(row));
        if (holds_axes) { angular.store(Result(errors_).subspan(row + 3)); }
        return row + (holds_axes ? 6 : 3);
    }

    void add_derivatives(int above, Vec3 point, double sign, bool holds_axes, size_t row) {
        for (; above >= 0; above = closure_->joints[static_cast<size_t>(above)].parent) {
            const size_t j = static_cast<size_t>(above);
            const bool slides = closure_->joints[j].slides;
            const Vec3 z = sign * frames_[j].rotation.z;
            const Vec3 linear = (1.0 / closure_->length) * (slides ? z : cross(z, point - frames_[j].translation));
            const std::array<double, 3> rates{linear.x, linear.y, linear.z};
            for (size_t k = 0; k < 3; ++k) { G_(row + k, j) += rates[k]; }
            if (!holds_axes || slides) { continue; }
            const std::array<double, 3> turns{z.x, z.y, z.z};
            for (size_t k = 0; k < 3; ++k) { G_(row + 3 + k, j) += turns[k]; }
        }
    }

    // Factorizes the normal equations of the passive joints where they are placed; false if they are singular.
    bool factorize_passive() {
        const std::vector<size_t>& passive = closure_->passive;
        double most = 0.0;
        for (size_t i = 0; i < passive.size(); ++i) {
            for (size_t k = 0; k <= i; ++k) {
                double sum = 0.0;
                for (size_t row = 0; row < G_.rows(); ++row) { sum += G_(row, passive[i]) * G_(row, passive[k]); }
                normal_(i, k) = sum;
            }
            most = std::max(most, normal_(i, i));
        }
        factorize(normal_);
        for (size_t i = 0; i < passive.size(); ++i) {
            if (!(normal_(i, i) > 0.0) || normal_(i, i) * most > 1.0 / SINGULAR) { return false; }
        }
        return true;
    }

    // The products of the derivatives by the passive joints with numbers (rows,).
    void project(Vector numbers, Result products) const {
        for (size_t k = 0; k < products.size(); ++k) {
            products[k] = 0.0;
            for (size_t row = 0; row < numbers.size(); ++row) { products[k] += G_(row, closure_->passive[k]) * numbers[row]; }
        }
    }

    // Finds how all joints move with the driven ones, where they are placed: G_p p' = -G_d R. False where that is singular.
    bool differentiate() {
        const LoopClosure& closure = *closure_;
        if (!factorize_passive()) { return false; }
        J_.set(closure.ratio);
        for (size_t i = 0; i < closure.n(); ++i) {
            for (size_t k = 0; k < step_.size(); ++k) {
                step_[k] = 0.0;
                for (size_t row = 0; row < G_.rows(); ++row) {
                    double rate = 0.0;
                    for (size_t j = 0; j < closure.m(); ++j) { rate += G_(row, j) * closure.ratio(j, i); }
                    step_[k] += G_(row, closure.passive[k]) * rate;
                }
            }
            solve(normal_, step_);
            for (size_t k = 0; k < step_.size(); ++k) { J_(closure.passive[k], i) = -step_[k]; }
        }
        return true;
    }

    // The motion of all frames at `speeds_`, with no acceleration of any joint.
    void move_frames() {
        for (size_t j = 0; j < closure_->m(); ++j) {
            const LoopJoint& joint = closure_->joints[j];
            Motion motion;
            if (joint.parent >= 0) {
                const size_t above = static_cast<size_t>(joint.parent);
                motion = motions_[above];
                motion.linear = point_acceleration(motion, frames_[j].translation - frames_[above].translation);
            }
            const Vec3 rate = speeds_[j] * frames_[j].rotation.z;
            if (joint.slides) {
                motion.linear += 2.0 * cross(motion.omega, rate);
            } else {
                motion.alpha += cross(motion.omega, rate);
                motion.omega += rate;
            }
            motions_[j] = motion;
        }
    }

    static Vec3 point_acceleration(const Motion& motion, Vec3 away) {
        return motion.linear + cross(motion.alpha, away) + cross(motion.omega, cross(motion.omega, away));
    }

    Twist frame_acceleration(const LoopFrame& frame) const {
        if (frame.joint < 0) { return {}; }
        const size_t j = static_cast<size_t>(frame.joint);
        return {point_acceleration(motions_[j], frames_[j].rotation * frame.placement.translation), motions_[j].alpha};
    }

    Closure closure_;
    std::vector<Pose> frames_;
    std::vector<Motion> motions_;
    Numbers positions_, trial_, speeds_, acceleration_;  // (m,)
    Numbers q_, next_q_;                                 // (n,)
    Numbers errors_;                                     // (rows,) of the loops' equations
    Numbers step_;                                       // of the passive joints
    Mat G_;                                              // (rows, m), the derivatives of the errors by all joints
    Mat normal_;                                         // of the passive joints, factorized
    Mat J_;                                              // (m, n)
};

}  // namespace armctl
