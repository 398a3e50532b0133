// Inverse kinematics of a tree with several tips: a search for one configuration, and steps that follow moving targets.
//
// Both solve the programs of tree_program.hpp.
#pragma once
#include "tree_program.hpp"

namespace armctl {

// How a step ended.
enum class StepEnd {
    solved = 0,
    held_back = 1,  // exact tasks and limits contradict each other: the limits hold, and the exact tasks as well as they allow
};

// What a search found. The errors are those of `TreeIk::error`.
struct TreeSearch {
    bool solved;
    std::int64_t starts;
    std::int64_t steps;
};

// The greatest speed from which a joint can still stop within a distance, with a speed that is constant in each period dt and
// changes by at most a dt from one to the next.
//
// From the speed (m + f) a dt, with a whole m and 0 <= f < 1, it stops after a dt^2 (m + 1) (f + m / 2).
inline double fastest_to_stop(double distance, double a, double dt) {
    if (!(distance > 0.0)) { return 0.0; }
    if (!std::isfinite(a) || !std::isfinite(distance)) { return distance / dt; }
    const double steps = distance / (a * dt * dt);
    const double whole = std::floor(0.5 * (std::sqrt(1.0 + 8.0 * steps) - 1.0));
    return std::max(whole, whole + steps / (whole + 1.0) - 0.5 * whole) * a * dt;
}

// Where the joints go as far as the tips leave them free.
struct Posture {
    Vector q;             // (n,) rad (m)
    double gain = 0.0;    // 1/s; 0 for none
    double weight = 0.0;  // of the way there while tips are away from their targets, PostureWeights::away for a step of the whole way
};

// It has scratch memory: use an object in one thread at a time.
class TreeIk : public TreeProgram {
public:
    using TreeProgram::TreeProgram;

    // One step of dt from q (n,), after the speeds v_before (n,): fills the speeds v (n,), rad/s.
    //
    // The limits of position, speed and acceleration hold. All joints go their part of the way to where the tips are nearest to
    // their targets, so fast that each can still stop there. They go on to `posture` at `posture_gain`, 1/s, as far as they are
    // free.
    StepEnd step(Vector q, Vector v_before, double dt, const Posture& posture, Result v) {
        set_room(q, MAX_STEP);
        const double part = std::min(1.0, posture.gain * dt);
        for (size_t i = 0; i < n(); ++i) { pull_[i] = part * (posture.q[i] - q[i]) / errors_.unit()[i]; }
        set_program(q, part > 0.0 ? PostureWeights{.everywhere = POSTURE_WEIGHT, .away = posture.weight / part} : PostureWeights{});
        const double exact_error = largest_exact_error();
        tolerance_ = std::min(exact_error + EXACT, NEARLY_EXACT);
        // Near a singular configuration, what makes up for nanometers can be a long way. Newton's method does it, with damping.
        if (exact_error < NEARLY_EXACT) { std::ranges::fill(Result(rhs_).first(exact_.count), 0.0); }
        bound_curvature();
        approach_polygon(dt);
        const bool is_solved = solve_program(way_);
        const double share = share_of_way(way_, dt);
        for (size_t i = 0; i < n(); ++i) {
            const Bounds bounds = speeds(i, q[i], v_before[i], dt);
            low_[i] = bounds.low * dt / errors_.unit()[i];
            high_[i] = bounds.high * dt / errors_.unit()[i];
            before_[i] = v_before[i] * dt / errors_.unit()[i];
            way_[i] *= share;
        }
        bool is_exact = is_solved && turn_to(q, 1.0, dt);
        const double slower = is_exact ? slowed_by_curves(dt) : 1.0;
        if (slower < 1.0) { is_exact = turn_to(q, slower, dt); }
        if (std::ranges::any_of(tasks_, &TreeTask::exact)) {
            // Where a step bends too much, a slower one bends less: out of a singular configuration the joints creep.
            double slow = slower;
            is_exact = is_exact && can_rest(q, dt);
            for (int trial = 0; !is_exact && is_solved && trial < MAX_SLOWER; ++trial) {
                slow *= SLOWER;
                is_exact = turn_to(q, slow, dt) && can_rest(q, dt);
            }
        }
        if (!is_exact) { is_exact = brake(q, dt); }
        for (size_t i = 0; i < n(); ++i) {
            const Bounds bounds{low_[i], high_[i]};
            v[i] = bounds.clamp(dx_[i]) * errors_.unit()[i] / dt;
        }
        return is_exact ? StepEnd::solved : StepEnd::held_back;
    }

    // Searches from q (n,), then from random starts, for a configuration in which all errors are inside the tolerances.
    //
    // Fills q with it, or with the best approximation: that in which exact tasks hold, and the others are nearest.
    TreeSearch search(const Tolerances& tolerances, const Starts& starts, Result q) {
        const Numbers q0(q.begin(), q.end());
        Numbers best(q0);
        double least = INF;
        TreeSearch outcome{.solved = false, .starts = 0, .steps = 0};
        const auto is_worthwhile = [&] { return is_promising(outcome.starts, true, least / static_cast<double>(tasks_.size())); };
        for (std::int64_t start = starts.first; start < starts.last && !outcome.solved && is_worthwhile(); ++start) {
            copy(q0, trial_);
            if (start > 0) { random_start(start, starts.seed, trial_); }
            const Descent descent = descend(tolerances, false, trial_);
            ++outcome.starts;
            outcome.steps += descent.steps;
            outcome.solved = descent.solved;
            if (descent.solved || descent.squared_error < least) {
                least = descent.squared_error;
                copy(trial_, best);
            }
        }
        if (outcome.solved) {
            copy(best, q);
            return outcome;
        }
        const Approach from_best = approach(best);
        const Approach from_start = approach(q);
        outcome.steps += from_best.steps + from_start.steps;
        if (from_best.is_better_than(from_start)) { copy(best, q); }
        errors_.locate(q);
        outcome.solved = all_inside(tolerances, false);
        return outcome;
    }

private:
    // Where an approach ended, in squared reaches.
    struct Approach {
        double exact_error;
        double squared_error;
        std::int64_t steps;

        bool holds() const { return exact_error < EXACT; }
        bool is_better_than(const Approach& other) const {
            if (holds() != other.holds()) { return holds(); }
            return holds() ? squared_error < other.squared_error : exact_error < other.exact_error;
        }
    };

    static constexpr double POSTURE_WEIGHT = 1e-8;  // squared reaches per squared radian: what it moves a tip away is below 1e-8 reaches
    static constexpr int MAX_APPROACH_STEPS = 300;
    static constexpr double EXACT_MERIT = 1e3;    // of exact tasks, beside the others
    static constexpr int MAX_HALVINGS = 8;        // of a step that leaves exact tasks
    static constexpr double MIN_MOVE = 1e-8;      // rad, or reaches: a smaller step ends an approach
    static constexpr double MAX_STEP = 0.5;       // rad, or reaches, of an approach
    static constexpr double NEARBY_SHARE = 0.25;  // of a joint's range: every other start is so near to the first one
    static constexpr double BRAKING_SHARE = 0.8;  // of the accelerations: the rest keeps exact tasks on their curves
    static constexpr double CURVE_SHARE = 0.1;    // of the accelerations, on the curves of exact tasks
    static constexpr double ROUNDING = 1e-12;     // relative, of speeds
    static constexpr double CORRECTION = 1e-8;    // rad (m), of a joint: of the order of `EXACT`
    static constexpr int MAX_STOPPING = 400;      // steps that are looked ahead
    static constexpr double NEARLY_EXACT = 2e-7;  // reaches: what braking may miss exact tasks by
    static constexpr int MAX_SLOWER = 6;          // trials of slower steps, ...
    static constexpr double SLOWER = 0.25;        // ... each slower than the one before

    // The speeds that a joint may have for the next dt.
    Bounds speeds(size_t i, double q, double v_before, double dt) const {
        const double v_max = limits_.v_max[i] * (1.0 - ROUNDING);
        const double a = limits_.a_max[i] * (1.0 - ROUNDING);
        const double rounding = 4.0 * std::numeric_limits<double>::epsilon() * (1.0 + std::abs(q));
        const double above = limits_.q_max[i] - q - rounding;
        const double below = q - limits_.q_min[i] - rounding;
        // From full speed, a joint stops in less than this.
        const double far = v_max * (0.5 * v_max / a + dt);
        double low = below > far ? -v_max : -std::min(v_max, fastest_to_stop(below, a, dt));
        double high = above > far ? v_max : std::min(v_max, fastest_to_stop(above, a, dt));
        if (above < 0.0) { high = std::max(above / dt, -v_max); }
        if (below < 0.0) { low = std::min(-below / dt, v_max); }
        const Bounds reachable{v_before - a * dt, v_before + a * dt};
        return {reachable.clamp(low), reachable.clamp(high)};
    }

    // Fills dx_ with the last step, changed towards a share of the way as far as all accelerations allow: a sum of two steps that keep
    // exact tasks keeps them, too. Returns whether they hold at its end, and all joints can stop from there.
    bool turn_to(Vector q, double share, double dt) {
        double part = 1.0;
        for (size_t i = 0; i < n(); ++i) {
            const double change = std::abs(share * way_[i] - before_[i]) * errors_.unit()[i];
            const double possible = BRAKING_SHARE * limits_.a_max[i] * dt * dt;
            if (possible < part * change) { part = possible / change; }
        }
        for (size_t i = 0; i < n(); ++i) {
            straight_[i] = before_[i] + part * (share * way_[i] - before_[i]);
            dx_[i] = Bounds{low_[i], high_[i]}.clamp(straight_[i]);
        }
        return newton(q, dx_, tolerance_) && is_above_polygon(q, dx_, allowed_outside()) && can_brake(q, dx_, dt);
    }

    // The greatest error of exact tasks at the start of the step.
    double largest_exact_error() const {
        double largest = 0.0;
        for (size_t row = 0; row < exact_.count; ++row) { largest = std::max(largest, std::abs(exact_.errors[row])); }
        return largest;
    }

    // By how much the center of mass may be outside its polygon, reaches: no farther than at the start of the step.
    double allowed_outside() const {
        double outside = EXACT;
        for (const double room : rooms_) { outside = std::max(outside, -room); }
        return outside;
    }

    // The share of the way at which what bends the straight step to where exact tasks hold takes no more of any joint's acceleration
    // than braking leaves: it grows with the square of the speed, without bounds towards a singular configuration such as a
    // straight leg.
    double slowed_by_curves(double dt) const {
        double most = 0.0;
        for (size_t i = 0; i < n(); ++i) {
            const double acceleration = 2.0 * std::abs(dx_[i] - straight_[i]) * errors_.unit()[i] / (dt * dt);
            most = std::max(most, acceleration / (CURVE_SHARE * limits_.a_max[i]));
        }
        return most > 1.0 ? 1.0 / std::sqrt(most) : 1.0;
    }

    // Whether all joints can stop together after a step dx (n,) from q (n,), each inside its limits: with speeds that become smaller in
    // proportion, exact tasks go on to hold. It takes so long as the joint with the weakest brake needs. A joint at its limit may be
    // corrected towards it, to keep exact tasks; that is no motion which goes on.
    bool can_brake(Vector q, Vector dx, double dt) {
        const double duration = braking_time(dx, dt);
        for (size_t i = 0; i < n(); ++i) {
            const double way = dx[i] * errors_.unit()[i] * (1.0 + 0.5 * duration / dt);
            if (q[i] + way < limits_.q_min[i] - CORRECTION || q[i] + way > limits_.q_max[i] + CORRECTION) { return false; }
        }
        if (polygon_.empty()) { return true; }
        for (size_t i = 0; i < n(); ++i) { kept_[i] = dx[i] * (1.0 + 0.5 * duration / dt); }
        return is_above_polygon(q, kept_, allowed_outside());
    }

    // s, until all joints stop together from a step dx (n,) in dt.
    double braking_time(Vector dx, double dt) const {
        double duration = 0.0;
        for (size_t i = 0; i < n(); ++i) {
            duration = std::max(duration, std::abs(dx[i]) * errors_.unit()[i] / (dt * BRAKING_SHARE * limits_.a_max[i]));
        }
        return duration;
    }

    // Fills dx_ with the step with which all joints go on as before and brake together. Returns whether exact tasks hold at its end.
    bool brake(Vector q, double dt) {
        const double share = std::max(0.0, 1.0 - dt / std::max(braking_time(before_, dt), dt));
        for (size_t i = 0; i < n(); ++i) { dx_[i] = Bounds{low_[i], high_[i]}.clamp(share * before_[i]); }
        return newton(q, dx_, tolerance_);
    }

    // Whether `brake`, step by step from the end of the step dx_ from q (n,), keeps exact tasks until the joints rest. Near a singular
    // configuration what bends a step can grow faster than braking slows the joints down. Then they brake at once: after the step before,
    // that was found to keep exact tasks.
    bool can_rest(Vector q, double dt) {
        copy(q, rest_q_);
        copy(dx_, rest_dx_);
        copy(before_, rest_before_);
        copy(low_, rest_low_);
        copy(high_, rest_high_);
        bool holds = true;
        for (int step = 0; holds && step < MAX_STOPPING && braking_time(dx_, dt) > dt; ++step) {
            for (size_t i = 0; i < n(); ++i) {
                const double v = dx_[i] * errors_.unit()[i] / dt;
                rest_q_[i] += dx_[i] * errors_.unit()[i];
                const Bounds bounds = speeds(i, rest_q_[i], v, dt);
                low_[i] = bounds.low * dt / errors_.unit()[i];
                high_[i] = bounds.high * dt / errors_.unit()[i];
                before_[i] = dx_[i];
            }
            holds = brake(rest_q_, dt) || exact_error(rest_q_, dx_) < NEARLY_EXACT;
        }
        copy(rest_dx_, dx_);
        copy(rest_before_, before_);
        copy(rest_low_, low_);
        copy(rest_high_, high_);
        return holds;
    }

    // The share of a way (n,) that all joints can go in dt, so that each can stop at its end.
    double share_of_way(Vector way, double dt) const {
        double share = 1.0;
        for (size_t i = 0; i < n(); ++i) {
            const double length = std::abs(way[i]) * errors_.unit()[i];
            const double fastest = std::min(limits_.v_max[i], fastest_to_stop(length, limits_.a_max[i], dt)) * dt;
            if (fastest < share * length) { share = fastest / length; }
        }
        return share * (1.0 - ROUNDING);
    }

    // One descent from q (n,) with all tasks, or all exact ones, alike, by Levenberg-Marquardt with the joint limits as bounds. q becomes
    // the best configuration met.
    Descent descend(const Tolerances& tolerances, bool only_exact, Result q) {
        Descent descent{.solved = false, .squared_error = INF, .first_squared_error = INF, .steps = 0};
        double reference = INF;
        int stalled = 0;
        while (descent.steps < MAX_DESCENT_STEPS && stalled < STALL_STEPS && !descent.solved) {
            ++descent.steps;
            linearize_alike(q, only_exact);
            double size = 0.0;
            for (size_t row = 0; row < soft_.count; ++row) { size += soft_.errors[row] * soft_.errors[row]; }
            if (descent.steps == 1) { descent.first_squared_error = size; }
            descent.solved = all_inside(tolerances, only_exact);
            if (descent.solved || size < descent.squared_error) {
                descent.squared_error = size;
                copy(q, best_);
            }
            ++stalled;
            if (size < STALL_RATIO * reference) {
                reference = size;
                stalled = 0;
            }
            if (!descent.solved) { descend_once(DAMPING * std::min(size, std::sqrt(size)) + MIN_DAMPING, q); }
        }
        copy(best_, q);
        return descent;
    }

    bool all_inside(const Tolerances& tolerances, bool only_exact) {
        for (const TreeTask& task : tasks_) {
            if ((task.exact || !only_exact) && !tolerances.contain(errors_.error(task))) { return false; }
        }
        return polygon_.empty() || outside_polygon() <= tolerances.position;
    }

    void descend_once(double damping, Result q) {
        std::ranges::fill(diagonal_, damping);
        set_normal(diagonal_);
        set_room(q, 2.0 * MAX_STEP);
        if (!box_.solve({.H = H_, .f = f_, .M = {}, .lower = low_, .upper = high_}, dx_)) { return; }
        move(dx_, q);
    }

    void move(Vector dx, Result q) const {
        for (size_t i = 0; i < n(); ++i) { q[i] = Bounds{limits_.q_min[i], limits_.q_max[i]}.clamp(q[i] + dx[i] * errors_.unit()[i]); }
    }

    // Moves q (n,) to where exact tasks hold, and then, as long as they do, to where the others are nearest.
    Approach approach(Result q) {
        std::ranges::fill(pull_, 0.0);
        Approach result{.exact_error = INF, .squared_error = INF, .steps = 0};
        if (has_exact()) { result.steps += descend({.position = EXACT, .orientation = EXACT}, true, q).steps; }
        double moved = INF;
        double shift = 0.0;
        double merit = merit_at(q);
        for (int step = 0; moved > MIN_MOVE && step < MAX_APPROACH_STEPS; ++step) {
            ++result.steps;
            set_room(q, MAX_STEP);
            set_program(q, {});
            shift = add_curvature(shift);
            if (!(solve_program(dx_) && keep_exact(q, dx_)) && !shorten(q, dx_)) { break; }
            moved = 0.0;
            for (const double x : dx_) { moved = std::max(moved, std::abs(x)); }
            copy(q, trial_);
            move(dx_, trial_);
            const double reached = merit_at(trial_);
            if (reached <= merit) {
                copy(trial_, q);
                merit = reached;
                shift *= 0.25;
            } else {
                shift = std::max(4.0 * shift, MIN_SHIFT);
            }
        }
        errors_.locate(q);
        result.exact_error = squared_error(true);
        result.squared_error = squared_error(false);
        return result;
    }

    // Halves a step dx (n,) from q until Newton's method takes its end to where exact tasks hold; false if it never does.
    bool shorten(Vector q, Result dx) {
        for (int halving = 0; halving < MAX_HALVINGS; ++halving) {
            for (double& x : dx) { x *= 0.5; }
            copy(dx, kept_);
            if (newton(q, kept_, EXACT) && is_above_polygon(q, kept_, EXACT)) {
                copy(kept_, dx);
                return true;
            }
        }
        return false;
    }

    // What an approach makes smaller: the squared errors, those of exact tasks with a weight.
    double merit_at(Vector q) {
        errors_.locate(q);
        return squared_error(false) + EXACT_MERIT * squared_error(true);
    }

    // The squared error of exact tasks and the polygon, or of the other tasks, where the joints are placed.
    double squared_error(bool exact) {
        const double outside = exact ? outside_polygon() / errors_.reach() : 0.0;
        double sum = outside * outside;
        for (const TreeTask& task : tasks_) {
            if (task.exact != exact) { continue; }
            const PoseError error = errors_.error(task);
            sum += squared({error.position / errors_.reach(), error.orientation}, ROTATION_WEIGHT);
        }
        return sum;
    }

    // The random start of a number: in the joint limits, or at a share of them from q.
    void random_start(std::int64_t start, std::uint64_t seed, Result q) const {
        std::uint64_t state = seed ^ (static_cast<std::uint64_t>(start) * 0xD1B54A32D192ED03u);
        const double share = start % 2 == 0 ? NEARBY_SHARE : 1.0;
        for (size_t i = 0; i < n(); ++i) {
            const double fraction = next_fraction(state);
            const double half_turn = std::numbers::pi * errors_.unit()[i];
            const Bounds limits{limits_.q_min[i], limits_.q_max[i]};
            const bool is_wide = !(limits.high - limits.low <= 2.0 * half_turn);
            const Bounds range = is_wide ? Bounds{q[i] - half_turn, q[i] + half_turn} : limits;
            const double drawn = range.low + fraction * (range.high - range.low);
            q[i] = limits.clamp(q[i] + share * (drawn - q[i]));
        }
    }

    // Reaches, of exact tasks at the end of a step: the error at its start and `EXACT`. Where a singular configuration does not let the
    // joints make up for the last nanometers, they would stand still for ever if the errors had to become smaller.
    double tolerance_ = EXACT;
    // Scratch memory.
    Numbers rest_q_ = Numbers(n()), rest_dx_ = rest_q_, rest_before_ = rest_q_, rest_low_ = rest_q_, rest_high_ = rest_q_;
};

}  // namespace armctl
