// Inverse kinematics of a tree with several tips: a search for one configuration, and steps that follow moving targets.
//
// A step dx of the unknowns minimizes the squared errors of the tasks, all with the same weight, while exact tasks hold:
//
//     minimize  |J dx - e|^2 + dx D dx + w |dx - p|^2    subject to  J_h dx = e_h,  c + G dx <= 0,  low <= dx <= high
//
// D bounds the curvature of the tasks, so that the error never grows: the tips stand still where they are nearest to targets
// that they cannot reach (majorize-minimize: Hunter and Lange, "A tutorial on MM algorithms", The American Statistician 58(1),
// 2004). The small weight w lets the joints approach a posture p as far as the tasks leave them free. Exact tasks as equalities:
// Escande, Mansard, Wieber, "Hierarchical quadratic programming", Int. J. Robotics Research 33(7), 2014.
#pragma once
#include "ik_search.hpp"
#include "quadratic_program.hpp"
#include "tree_tasks.hpp"

namespace armctl {

// What the joints may do, (n,) each, rad (m) and seconds.
struct JointLimits {
    Numbers q_min, q_max, v_max, a_max;
};

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

// It has scratch memory: use an object in one thread at a time.
class TreeIk {
public:
    TreeIk(const Model& model, double reach, Vector unit, FixedMass fixed, JointLimits limits, std::vector<TreeTask> tasks,
           std::vector<HalfPlane> polygon)
        : errors_(model, reach, unit, fixed), limits_(std::move(limits)), tasks_(std::move(tasks)), polygon_(std::move(polygon)),
          soft_(6 * (tasks_.size() + polygon_.size()), n()), exact_(6 * tasks_.size(), n()), solver_(n(), exact_.errors.size() + polygon_.size()),
          box_(n(), 0), M_(exact_.errors.size() + polygon_.size(), n()) {}

    size_t n() const { return errors_.n(); }
    const std::vector<TreeTask>& tasks() const { return tasks_; }
    void set_target(size_t task, const Pose& target) { tasks_[task].target = target; }
    const JointLimits& limits() const { return limits_; }

    // Places the joints at q (n,).
    void locate(Vector q) { errors_.locate(q); }
    // The errors of a task where the joints are placed, m and rad.
    PoseError error(size_t task) const { return errors_.error(tasks_[task]); }
    // By how much the center of mass is outside the polygon where the joints are placed, m; 0 inside.
    double outside_polygon() {
        double most = 0.0;
        for (const HalfPlane& half : polygon_) { most = std::max(most, errors_.reach() * errors_.center_of_mass(half, change_)); }
        return most;
    }

    // The pose of a task's frame where the joints are placed.
    Pose frame(size_t task) const { return errors_.pose_of(tasks_[task].frame); }

    // One step of dt from q (n,), after the speeds v_before (n,): fills the speeds v (n,), rad/s.
    //
    // The limits of position, speed and acceleration hold. All joints go their part of the way to where the tips are nearest to
    // their targets, so fast that each can still stop there. They go on to `posture` at `posture_gain`, 1/s, as far as they are
    // free.
    StepEnd step(Vector q, Vector v_before, double dt, Vector posture, double posture_gain, Result v) {
        set_room(q, MAX_STEP);
        for (size_t i = 0; i < n(); ++i) { pull_[i] = std::min(1.0, posture_gain * dt) * (posture[i] - q[i]) / errors_.unit()[i]; }
        set_program(q, posture_gain > 0.0 ? POSTURE_WEIGHT : 0.0);
        bound_curvature();
        approach_polygon(dt);
        bool is_exact = solve_program(way_);
        const double share = share_of_way(way_, dt);
        for (size_t i = 0; i < n(); ++i) {
            const Bounds bounds = speeds(i, q[i], v_before[i], dt);
            low_[i] = bounds.low * dt / errors_.unit()[i];
            high_[i] = bounds.high * dt / errors_.unit()[i];
            before_[i] = v_before[i] * dt / errors_.unit()[i];
            way_[i] *= share;
        }
        is_exact = is_exact && turn_to(q, 1.0, dt);
        const double slower = is_exact ? slowed_by_curves(dt) : 1.0;
        if (slower < 1.0) { is_exact = turn_to(q, slower, dt); }
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
        for (std::int64_t start = starts.first; start < starts.last && !outcome.solved; ++start) {
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

    static constexpr double POSTURE_WEIGHT = 1e-8;   // squared reaches per squared radian: what it moves a tip away is below 1e-8 reaches
    static constexpr double MIN_WEIGHT = 1e-10;      // of the step itself, where nothing else determines it
    static constexpr double NO_MOTION = 1e-18;       // squared, of a row that no joint changes, such as the height of an arm in a plane
    static constexpr double EXACT = 1e-9;            // reaches: an exact task, or a polygon, with so small an error holds
    static constexpr double RELAXED_WEIGHT = 1e4;    // of exact tasks where limits contradict them
    static constexpr int EXACT_STEPS = 8;            // of Newton's method, back to the exact tasks
    static constexpr int EXACT_PASSES = 3;           // of a step, with what the exact tasks were missed by
    static constexpr int MAX_APPROACH_STEPS = 300;
    static constexpr double EXACT_MERIT = 1e3;       // of exact tasks, beside the others
    static constexpr double MIN_SHIFT = 1e-6;        // squared reaches per squared radian: the smallest one that is tried
    static constexpr int MAX_HALVINGS = 8;           // of a step that leaves exact tasks
    static constexpr double MIN_MOVE = 1e-8;         // rad, or reaches: a smaller step ends an approach
    static constexpr double MAX_STEP = 0.5;          // rad, or reaches, of an approach
    static constexpr double NEARBY_SHARE = 0.25;     // of a joint's range: every other start is so near to the first one
    static constexpr double BRAKING_SHARE = 0.8;     // of the accelerations: the rest keeps exact tasks on their curves
    static constexpr double CURVE_SHARE = 0.1;       // of the accelerations, on the curves of exact tasks
    static constexpr double ROUNDING = 1e-12;        // relative, of speeds

    // The speeds that a joint may have for the next dt.
    Bounds speeds(size_t i, double q, double v_before, double dt) const {
        const double v_max = limits_.v_max[i] * (1.0 - ROUNDING);
        const double a = limits_.a_max[i] * (1.0 - ROUNDING);
        const double rounding = 4.0 * std::numeric_limits<double>::epsilon() * (1.0 + std::abs(q));
        const double above = limits_.q_max[i] - q - rounding;
        const double below = q - limits_.q_min[i] - rounding;
        double low = -std::min(v_max, fastest_to_stop(below, a, dt));
        double high = std::min(v_max, fastest_to_stop(above, a, dt));
        if (above < 0.0) { low = high = std::max(above / dt, -v_max); }
        if (below < 0.0) { low = high = std::min(-below / dt, v_max); }
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
        return newton(q, dx_) && is_above_polygon() && can_brake(q, dx_, dt);
    }

    // Whether the center of mass is above its polygon where the joints are placed, or nearer to it than at the start of the step.
    bool is_above_polygon() {
        double outside = EXACT;
        for (const double room : rooms_) { outside = std::max(outside, -room); }
        return polygon_.empty() || outside_polygon() <= outside * errors_.reach();
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
    // proportion, exact tasks go on to hold. It takes so long as the joint with the weakest brake needs.
    bool can_brake(Vector q, Vector dx, double dt) {
        const double duration = braking_time(dx, dt);
        for (size_t i = 0; i < n(); ++i) {
            const double way = dx[i] * errors_.unit()[i] * (1.0 + 0.5 * duration / dt);
            if (q[i] + way < limits_.q_min[i] || q[i] + way > limits_.q_max[i]) { return false; }
        }
        if (polygon_.empty()) { return true; }
        for (size_t i = 0; i < n(); ++i) { end_[i] = q[i] + dx[i] * errors_.unit()[i] * (1.0 + 0.5 * duration / dt); }
        errors_.locate(end_);
        return is_above_polygon();
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
        return newton(q, dx_);
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

    // Linearizes the tasks at q (n,), exact ones apart.
    void linearize(Vector q) {
        errors_.locate(q);
        soft_.clear();
        exact_.clear();
        firsts_.clear();
        for (const TreeTask& task : tasks_) {
            TaskRows& rows = task.exact ? exact_ : soft_;
            firsts_.push_back(rows.count);
            errors_.add_rows(task, rows);
        }
    }

    // Linearizes all tasks alike, or only exact ones, and what of the polygon is violated.
    void linearize_alike(Vector q, bool only_exact) {
        errors_.locate(q);
        soft_.clear();
        for (const TreeTask& task : tasks_) {
            if (task.exact || !only_exact) { errors_.add_rows(task, soft_); }
        }
        add_polygon();
    }

    // J^T J of the soft rows and the gradient, with a diagonal.
    void set_normal(Vector diagonal) {
        for (size_t i = 0; i < n(); ++i) {
            for (size_t k = 0; k <= i; ++k) { H_(i, k) = 0.0; }
            f_[i] = 0.0;
        }
        add_squares(soft_, 1.0);
        for (size_t i = 0; i < n(); ++i) { H_(i, i) += diagonal[i]; }
    }

    void add_squares(const TaskRows& rows, double weight) {
        for (size_t row = 0; row < rows.count; ++row) {
            const Vector J = rows.J.row(row);
            for (size_t i = 0; i < n(); ++i) {
                if (J[i] == 0.0) { continue; }
                const double scaled = weight * J[i];
                for (size_t k = 0; k <= i; ++k) { H_(i, k) += scaled * J[k]; }
                f_[i] -= scaled * rows.errors[row];
            }
        }
    }

    // The program of a step from q (n,): the tasks, and a weight of the way to the posture.
    void set_program(Vector q, double posture_weight) {
        linearize(q);
        std::ranges::fill(diagonal_, MIN_WEIGHT + posture_weight);
        set_normal(diagonal_);
        std::ranges::fill(C_.numbers(), 0.0);
        for (size_t t = 0; t < tasks_.size(); ++t) {
            if (!tasks_[t].exact) { errors_.add_curvature(tasks_[t], soft_, firsts_[t], C_); }
        }
        for (size_t i = 0; i < n(); ++i) { f_[i] -= posture_weight * pull_[i]; }
        for (size_t row = 0; row < exact_.count; ++row) {
            copy(exact_.J.row(row), M_.row(row));
            rhs_[row] = exact_.errors[row];
        }
        for (size_t k = 0; k < polygon_.size(); ++k) {
            rooms_[k] = -errors_.center_of_mass(polygon_[k], M_.row(exact_.count + k));
            rhs_[exact_.count + k] = rooms_[k];
        }
    }

    // Lets the center of mass come no nearer to the edges of the polygon than it can slow down: at most by a rate times the distance,
    // with which each joint stays inside its acceleration limit.
    void approach_polygon(double dt) {
        double rate = INF;
        for (size_t i = 0; i < n(); ++i) { rate = std::min(rate, limits_.a_max[i] / limits_.v_max[i]); }
        for (double& room : Result(rhs_).subspan(exact_.count, polygon_.size())) {
            if (room > 0.0) { room *= std::min(1.0, rate * dt); }
        }
    }

    // Adds a diagonal matrix to the program's that is above the curvature: its sums of absolute values.
    void bound_curvature() {
        for (size_t i = 0; i < n(); ++i) {
            for (size_t k = 0; k < n(); ++k) { H_(i, i) += std::abs(k <= i ? C_(i, k) : C_(k, i)); }
        }
    }

    // Adds the curvature itself, and so much of the identity that the program stays convex. Returns how much.
    double add_curvature(double shift) {
        for (;; shift = std::max(4.0 * shift, MIN_SHIFT)) {
            bool is_convex = true;
            for (size_t i = 0; i < n(); ++i) {
                for (size_t k = 0; k <= i; ++k) { factor_(i, k) = H_(i, k) + C_(i, k) + (i == k ? shift : 0.0); }
            }
            factorize(factor_);
            for (size_t i = 0; i < n(); ++i) { is_convex = is_convex && factor_(i, i) > 0.0 && std::isfinite(factor_(i, i)); }
            if (is_convex) { break; }
        }
        for (size_t i = 0; i < n(); ++i) {
            for (size_t k = 0; k <= i; ++k) { H_(i, k) += C_(i, k) + (i == k ? shift : 0.0); }
        }
        return shift;
    }

    // The solution dx (n,) of the program between `low_` and `high_`, with exact tasks as equalities. Returns false if they contradict
    // the bounds: then they are only a cost.
    bool solve_program(Result dx) {
        std::ranges::fill(lower_, -unbounded);
        std::ranges::fill(upper_, unbounded);
        for (size_t i = 0; i < n(); ++i) {
            lower_[i] = low_[i];
            upper_[i] = high_[i];
        }
        for (size_t row = 0; row < exact_.count + polygon_.size(); ++row) {
            if (dot(M_.row(row), M_.row(row)) < NO_MOTION) { continue; }
            upper_[n() + row] = rhs_[row];
            if (row < exact_.count) { lower_[n() + row] = rhs_[row]; }
        }
        if (solver_.solve({.H = H_, .f = f_, .M = M_, .lower = lower_, .upper = upper_}, dx)) { return true; }
        copy(rhs_, relaxed_.errors);
        for (size_t row = 0; row < M_.rows(); ++row) { copy(M_.row(row), relaxed_.J.row(row)); }
        relaxed_.count = exact_.count;
        for (size_t row = exact_.count; row < exact_.count + polygon_.size(); ++row) {
            if (rhs_[row] < 0.0) {
                relaxed_.errors[relaxed_.count] = rhs_[row];
                copy(M_.row(row), relaxed_.J.row(relaxed_.count++));
            }
        }
        add_squares(relaxed_, RELAXED_WEIGHT);
        double size = 0.0;
        for (size_t row = 0; row < relaxed_.count; ++row) { size += relaxed_.errors[row] * relaxed_.errors[row]; }
        for (size_t i = 0; i < n(); ++i) { H_(i, i) += RELAXED_WEIGHT * (DAMPING * std::min(size, std::sqrt(size)) + MIN_DAMPING); }
        const auto bounds = [this](const Numbers& all) { return Vector(all).first(n()); };
        if (!box_.solve({.H = H_, .f = f_, .M = {}, .lower = bounds(lower_), .upper = bounds(upper_)}, dx)) {
            for (size_t i = 0; i < n(); ++i) { dx[i] = Bounds{low_[i], high_[i]}.clamp(0.0); }
        }
        return false;
    }

    // Changes a step dx (n,) from q so that exact tasks and the polygon hold at its end, and not only to first order. Returns
    // whether they do.
    bool keep_exact(Vector q, Result dx) {
        if (!has_exact()) { return true; }
        for (int pass = 0;; ++pass) {
            copy(dx, kept_);
            if (newton(q, kept_) && outside_polygon() <= EXACT * errors_.reach()) {
                copy(kept_, dx);
                return true;
            }
            // At a bound, or too far: the program once more, with what its end misses.
            if (pass == EXACT_PASSES) { return false; }
            set_end(q, dx);
            find_exact(end_, end_rows_);
            for (size_t row = 0; row < end_rows_.count; ++row) { rhs_[row] += end_rows_.errors[row]; }
            for (size_t k = 0; k < polygon_.size(); ++k) {
                double& room = rhs_[exact_.count + k];
                room -= std::max(0.0, errors_.center_of_mass(polygon_[k], change_));
            }
            if (!solve_program(dx)) { return false; }
        }
    }

    // Newton's method with the least change of dx, to exact tasks that hold at q + dx. Joints that it would take out of the bounds stay
    // there. False if the others cannot do it.
    bool newton(Vector q, Result dx) {
        std::ranges::fill(is_held_, 0);
        for (int iteration = 0; iteration < EXACT_STEPS; ++iteration) {
            set_end(q, dx);
            find_exact(end_, end_rows_);
            const size_t count = end_rows_.count;
            double most = 0.0;
            for (size_t row = 0; row < count; ++row) { most = std::max(most, std::abs(end_rows_.errors[row])); }
            if (most < EXACT) { return true; }
            const MatrixResult gram{gram_.numbers().data(), count, count};
            for (size_t row = 0; row < count; ++row) {
                for (size_t i = 0; i < n(); ++i) { end_rows_.J(row, i) *= is_held_[i] ? 0.0 : 1.0; }
                for (size_t other = 0; other <= row; ++other) { gram(row, other) = dot(end_rows_.J.row(row), end_rows_.J.row(other)); }
                gram(row, row) += MIN_WEIGHT;
            }
            factorize(gram);
            const Result multipliers = Result(end_rows_.errors).first(count);
            solve(gram, multipliers);
            for (size_t i = 0; i < n(); ++i) {
                for (size_t row = 0; row < count; ++row) { dx[i] += end_rows_.J(row, i) * multipliers[row]; }
                const Bounds bounds{low_[i], high_[i]};
                is_held_[i] = is_held_[i] || !bounds.contain(dx[i]);
                dx[i] = bounds.clamp(dx[i]);
            }
        }
        return false;
    }

    void set_end(Vector q, Vector dx) {
        for (size_t i = 0; i < n(); ++i) { end_[i] = q[i] + dx[i] * errors_.unit()[i]; }
    }

    void find_exact(Vector q, TaskRows& rows) {
        errors_.locate(q);
        rows.clear();
        for (const TreeTask& task : tasks_) {
            if (task.exact) { errors_.add_rows(task, rows); }
        }
    }

    // One descent from q (n,) with all tasks, or all exact ones, alike, by Levenberg-Marquardt with the joint limits as bounds. q becomes the best
    // configuration met.
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

    // The half planes that the center of mass is outside of, as rows.
    void add_polygon() {
        for (const HalfPlane& half : polygon_) {
            const double outside = errors_.center_of_mass(half, change_);
            if (outside <= 0.0) { continue; }
            soft_.errors[soft_.count] = -outside;
            copy(change_, soft_.J.row(soft_.count++));
        }
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

    // Bounds of a step from q: the joint limits, and the longest move, rad or reaches.
    void set_room(Vector q, double longest) {
        for (size_t i = 0; i < n(); ++i) {
            const double unit = errors_.unit()[i];
            low_[i] = std::max(std::min(limits_.q_min[i] - q[i], 0.0) / unit, -longest);
            high_[i] = std::min(std::max(limits_.q_max[i] - q[i], 0.0) / unit, longest);
        }
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
            set_program(q, 0.0);
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
            if (newton(q, kept_) && outside_polygon() <= EXACT * errors_.reach()) {
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

    bool has_exact() const { return !polygon_.empty() || std::ranges::any_of(tasks_, &TreeTask::exact); }

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

    TreeErrors errors_;
    JointLimits limits_;
    std::vector<TreeTask> tasks_;
    std::vector<HalfPlane> polygon_;
    TaskRows soft_, exact_;
    ActiveSetSolver solver_;
    ActiveSetSolver box_;
    Mat M_;
    // Scratch memory.
    TaskRows end_rows_{exact_.errors.size(), n()};
    TaskRows relaxed_{exact_.errors.size() + polygon_.size(), n()};
    std::vector<size_t> firsts_;
    std::vector<char> is_held_ = std::vector<char>(n());
    Mat H_{n(), n()}, C_{n(), n()}, factor_{n(), n()};
    Mat gram_{exact_.errors.size(), exact_.errors.size()};
    Numbers f_ = Numbers(n()), diagonal_ = f_, pull_ = f_, low_ = f_, high_ = f_, way_ = f_, before_ = f_, straight_ = f_, dx_ = f_, kept_ = f_, end_ = f_, trial_ = f_, best_ = f_,
            change_ = f_;
    Numbers rhs_ = Numbers(M_.rows());
    Numbers rooms_ = Numbers(polygon_.size());  // of the center of mass, to each edge of the polygon, reaches
    Numbers lower_ = Numbers(n() + M_.rows()), upper_ = lower_;
};

}  // namespace armctl
