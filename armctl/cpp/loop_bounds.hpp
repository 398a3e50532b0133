// How far the joints of closed loops move at most while the driven ones stay near a configuration.
//
// With the passive joints x, the driven ones y and the equations F(x, y) = 0, and A = (F_x^T F_x)^-1 F_x^T at the middle,
//
//     x - x_c = A F_x (x - x_c) = -A F_y (y - y_c) - A R,
//
// where R is the rest of Taylor's formula of second order. Bounds of the second derivatives follow from the lengths of links. If they
// confirm a box around x_c strictly, the solution cannot leave it. Source: Krawczyk's operator in Neumaier, Interval Methods for
// Systems of Equations (1990), 5.1.
#pragma once
#include "loop_closure.hpp"

namespace armctl {

constexpr double PASSIVE_LIMIT_TOLERANCE = 1e-9;  // rad (m): solutions at the limits of passive joints are inside

// What is known of closed loops while the driven joints stay in an interval.
enum class LoopVerdict {
    closed,  // they stay closed, with all passive joints inside their limits
    open,    // that is not settled: a shorter interval may
    broken,  // in the middle they cannot be closed, or a passive joint is outside its limits
};

// It has scratch memory: use an object in one thread at a time.
class BoundedLoops : public ClosedLoops {
public:
    explicit BoundedLoops(Closure given)
        : ClosedLoops(std::move(given)), inverse_(closure().passive.size(), closure().rows), next_(closure().passive.size()),
          delta_(closure().m()) {
        for (const Loop& loop : closure().loops) { paths_.push_back(paths_of(loop)); }
    }

    // Closes the loops at q (n,), and bounds by how much each joint (m,) leaves its position there while the driven ones leave
    // theirs by at most delta_q (n,). A bound that is not known is infinite.
    LoopVerdict bound(Vector q, Vector delta_q, Result delta) {
        std::ranges::fill(delta, UNKNOWN);
        if (!close(q)) { return LoopVerdict::broken; }
        double largest = 0.0;
        for (const size_t i : closure().drivers) { largest = std::max(largest, delta_q[i]); }
        for (size_t k = 0; k < next_.size(); ++k) {
            const double position = positions()[closure().passive[k]];
            if (position < closure().low[k] - PASSIVE_LIMIT_TOLERANCE || position > closure().high[k] + PASSIVE_LIMIT_TOLERANCE) {
                return LoopVerdict::broken;
            }
        }
        if (!confine(delta_q)) { return largest < SMALLEST ? LoopVerdict::broken : LoopVerdict::open; }
        copy(delta_, delta);
        return largest < NEAR_LIMIT || is_inside() ? LoopVerdict::closed : LoopVerdict::open;
    }

    // Whether the solution at another configuration q (n,) is in the box of the last call, so that both are on one branch. The
    // memory then holds that solution; `middle` (m,) are the positions in the middle.
    bool holds(Vector q, Vector middle) {
        if (!close(q)) { return false; }
        for (size_t j = 0; j < middle.size(); ++j) {
            if (!(std::abs(positions()[j] - middle[j]) <= delta_[j] + BOX_ROUNDING)) { return false; }
        }
        return true;
    }

private:
    static constexpr double UNKNOWN = 1e300;    // more than any motion
    static constexpr double NEAR_LIMIT = 1e-4;  // rad (m) of the driven joints: so short an interval at a limit counts as inside
    static constexpr double SMALLEST = 1e-7;    // rad (m): where so short an interval has no bound, the loops are singular
    static constexpr double BOX_ROUNDING = 1e-9;
    static constexpr double MAX_DELTA = 0.5;  // rad (m)
    static constexpr double GROWTH = 1.1;
    static constexpr int MAX_TRIALS = 12;

    // The joints from a frame of a loop up to what carries the loop as a whole, the nearest first.
    using Path = std::vector<size_t>;
    struct Paths {
        Path first;
        Path second;
    };

    Paths paths_of(const Loop& loop) const {
        int a = loop.first.joint;
        int b = loop.second.joint;
        Paths paths;
        while (a != b) {
            int& later = a > b ? a : b;
            (a > b ? paths.first : paths.second).push_back(static_cast<size_t>(later));
            later = closure().joints[static_cast<size_t>(later)].parent;
        }
        return paths;
    }

    // Finds a box (m,) that the solution cannot leave, in `delta_`; false if there is none.
    bool confine(Vector delta_q) {
        const LoopClosure& loops = closure();
        for (const TiedJoints& tie : loops.ties) {
            if (tie.terms[2] != 0.0 || tie.terms[3] != 0.0 || tie.terms[4] != 0.0) { return false; }
        }
        invert(inverse_);
        for (size_t j = 0; j < loops.m(); ++j) {
            delta_[j] = 0.0;
            for (size_t i = 0; i < loops.n(); ++i) { delta_[j] += std::abs(ratio()(j, i)) * delta_q[i]; }
        }
        Numbers linear(next_.size());
        for (size_t k = 0; k < linear.size(); ++k) {
            linear[k] = delta_[loops.passive[k]] + BOX_ROUNDING;
            delta_[loops.passive[k]] = GROWTH * linear[k];
        }
        for (int trial = 0; trial < MAX_TRIALS; ++trial) {
            double share = 0.0;
            copy(linear, next_);
            add_rest(share);
            bool is_confirmed = share < 1.0;
            for (size_t k = 0; k < next_.size(); ++k) {
                double& box = delta_[loops.passive[k]];
                is_confirmed = is_confirmed && next_[k] < box;
                if (!(next_[k] < MAX_DELTA)) { return false; }
                box = std::max(box, GROWTH * next_[k]);
            }
            if (is_confirmed) { return true; }
        }
        return false;
    }

    // Adds to `next_` what the rest of second order moves the passive joints at most inside the box; `share` becomes the largest
    // factor by which the box shrinks the difference of two solutions, below 1 if there is only one.
    void add_rest(double& share) {
        const LoopClosure& loops = closure();
        Numbers shares(next_.size());
        size_t row = 0;
        for (size_t l = 0; l < loops.loops.size(); ++l) {
            const Loop& loop = loops.loops[l];
            const double length = 1.0 / loops.length;
            double curved = 0.0;
            double turned = 0.0;
            Numbers changes(loops.m());  // of the derivatives of the gap by each joint
            add_path(loop.first, paths_[l].first, curved, turned, changes);
            add_path(loop.second, paths_[l].second, curved, turned, changes);
            for (size_t k = 0; k < next_.size(); ++k) {
                const double linear = norm_of(k, row) * length;
                const double angular = loop.holds_axes ? norm_of(k, row + 3) : 0.0;
                next_[k] += linear * curved + angular * 0.5 * turned * turned;
                for (const size_t passive : loops.passive) {
                    const bool is_on_path =
                        std::ranges::count(paths_[l].first, passive) + std::ranges::count(paths_[l].second, passive) > 0;
                    if (is_on_path) { shares[k] += linear * changes[passive] + angular * turned; }
                }
            }
            row += loop.rows();
        }
        for (const double each : shares) { share = std::max(share, each); }
    }

    // Adds for one end of a loop the rest of its position, m, the sum of its turns, rad, and the changes of the derivatives.
    //
    // The second derivative of a point by a hinge b and a hinge a above it is z_a x (z_b x r), with the way r from b to the point: at
    // most as long as the links between. By a slide b it is z_a x z_b.
    void add_path(const LoopFrame& frame, const Path& path, double& curved, double& turned, Numbers& changes) const {
        double reach = norm(frame.placement.translation);
        for (size_t below = 0; below < path.size(); ++below) {
            const size_t b = path[below];
            const LoopJoint& joint = closure().joints[b];
            const double weight = joint.slides ? 1.0 : reach;
            if (!joint.slides) {
                curved += 0.5 * weight * delta_[b] * delta_[b];
                changes[b] += weight * delta_[b];
                turned += delta_[b];
            }
            for (size_t above = below + 1; above < path.size(); ++above) {
                const size_t a = path[above];
                if (closure().joints[a].slides) { continue; }
                curved += weight * delta_[a] * delta_[b];
                changes[b] += weight * delta_[a];
                changes[a] += weight * delta_[b];
            }
            reach += norm(joint.placement.translation) + (joint.slides ? std::abs(positions()[b]) + delta_[b] : 0.0);
        }
    }

    // The length of three numbers of the inverse.
    double norm_of(size_t k, size_t row) const { return norm({inverse_(k, row), inverse_(k, row + 1), inverse_(k, row + 2)}); }

    bool is_inside() const {
        for (size_t k = 0; k < next_.size(); ++k) {
            const size_t joint = closure().passive[k];
            const double position = positions()[joint];
            if (position - delta_[joint] < closure().low[k] || position + delta_[joint] > closure().high[k]) { return false; }
        }
        return true;
    }

    std::vector<Paths> paths_;  // of each loop
    Mat inverse_;               // (passive, rows)
    Numbers next_;              // of the passive joints
    Numbers delta_;             // (m,)
};

}  // namespace armctl
