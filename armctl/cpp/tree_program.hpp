// The program of a step of a tree with several tips.
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
#include "null_space_program.hpp"
#include "tree_tasks.hpp"

namespace armctl {

// Squared reaches per squared radian of the way to the posture.
struct PostureWeights {
    double everywhere = 0.0;
    double away = 0.0;  // times the squared errors of the tips that an unknown moves, in reaches
};

// What the joints may do, (n,) each, rad (m) and seconds.
struct JointLimits {
    Numbers q_min, q_max, v_max, a_max;
};

// The program around one configuration, with scratch memory: use an object in one thread at a time.
class TreeProgram {
public:
    TreeProgram(const Model& model, double reach, Vector unit, FixedMass fixed, JointLimits limits, std::vector<TreeTask> tasks,
                std::vector<HalfPlane> polygon)
        : errors_(model, reach, unit, fixed), limits_(std::move(limits)), tasks_(std::move(tasks)), polygon_(std::move(polygon)),
          soft_(6 * (tasks_.size() + polygon_.size()), first_numbers(n())), exact_(6 * tasks_.size(), first_numbers(n())),
          movers_(errors_.movers(exact_tasks(tasks_))), end_rows_(exact_.errors.size(), movers_.unknowns),
          solver_(n(), movers_.unknowns, polygon_.size()), box_(n(), 0), M_(exact_.errors.size() + polygon_.size(), n()) {}

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

protected:
    static constexpr double MIN_WEIGHT = 1e-10;    // of the step itself, where nothing else determines it
    static constexpr double NO_MOTION = 1e-18;     // squared, of a row that no joint changes, such as the height of an arm in a plane
    static constexpr double EXACT = 1e-9;          // reaches: an exact task, or a polygon, with so small an error holds
    static constexpr double RELAXED_WEIGHT = 1e4;  // of exact tasks where limits contradict them
    static constexpr int EXACT_STEPS = 8;          // of Newton's method, back to the exact tasks
    static constexpr double CHORD_SHARE = 0.1;     // of an error: if a correction leaves more, it needs new derivatives
    static constexpr double STALLED_SHARE = 0.9;   // of an error: if one leaves more, at bounds or where damping stops it, none helps
    static constexpr int EXACT_PASSES = 3;         // of a step, with what the exact tasks were missed by
    static constexpr double MIN_SHIFT = 1e-6;      // squared reaches per squared radian: the smallest one that is tried

    // Linearizes the tasks at q (n,), exact ones apart.
    void linearize(Vector q) {
        errors_.locate(q);
        soft_.clear();
        exact_.clear();
        firsts_.clear();
        ends_.clear();
        for (const TreeTask& task : tasks_) {
            TaskRows& rows = task.exact ? exact_ : soft_;
            firsts_.push_back(rows.count);
            errors_.add_rows(task, rows);
            ends_.push_back(rows.count);
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

    // The program of a step from q (n,): the tasks, and a pull to the posture.
    void set_program(Vector q, PostureWeights weights) {
        linearize(q);
        std::ranges::fill(posture_weight_, weights.everywhere);
        if (weights.away > 0.0) { weigh_posture(weights.away); }
        for (size_t i = 0; i < n(); ++i) { diagonal_[i] = MIN_WEIGHT + posture_weight_[i]; }
        set_normal(diagonal_);
        std::ranges::fill(C_.numbers(), 0.0);
        for (size_t t = 0; t < tasks_.size(); ++t) {
            if (!tasks_[t].exact) { errors_.add_curvature(tasks_[t], soft_, firsts_[t], C_); }
        }
        for (size_t i = 0; i < n(); ++i) { f_[i] -= posture_weight_[i] * pull_[i]; }
        for (size_t row = 0; row < exact_.count; ++row) {
            copy(exact_.J.row(row), M_.row(row));
            rhs_[row] = exact_.errors[row];
        }
        for (size_t k = 0; k < polygon_.size(); ++k) {
            rooms_[k] = -errors_.center_of_mass(polygon_[k], M_.row(exact_.count + k));
            rhs_[exact_.count + k] = rooms_[k];
        }
    }

    // Adds to the weight of each unknown on its way to the posture: the more, the farther tips that it moves are from their targets.
    void weigh_posture(double weight) {
        find_movers();
        std::ranges::fill(squares_, 0.0);
        for (size_t t = 0; t < tasks_.size(); ++t) {
            if (tasks_[t].exact) { continue; }
            const Vector errors = Vector(soft_.errors).subspan(firsts_[t], ends_[t] - firsts_[t]);
            for (size_t i = 0; i < n(); ++i) {
                if (moves_[t][i]) { squares_[i] += dot(errors, errors); }
            }
        }
        for (size_t i = 0; i < n(); ++i) { posture_weight_[i] += weight * squares_[i] / (1.0 + std::sqrt(squares_[i])); }
    }

    // Finds the unknowns that move each task. Those that keep an exact task meanwhile, such as legs, belong to the others, too.
    void find_movers() {
        for (size_t t = 0; t < tasks_.size(); ++t) {
            const TaskRows& rows = tasks_[t].exact ? exact_ : soft_;
            for (size_t i = 0; i < n(); ++i) {
                moves_[t][i] = false;
                for (size_t row = firsts_[t]; row < ends_[t]; ++row) { moves_[t][i] = moves_[t][i] || rows.J(row, i) != 0.0; }
            }
        }
        for (size_t t = 0; t < tasks_.size(); ++t) {
            for (size_t e = 0; e < tasks_.size() && !tasks_[t].exact; ++e) {
                if (tasks_[e].exact && share_one(moves_[t], moves_[e])) {
                    for (size_t i = 0; i < n(); ++i) { moves_[t][i] = moves_[t][i] || moves_[e][i]; }
                }
            }
        }
    }

    static bool share_one(const std::vector<bool>& first, const std::vector<bool>& second) {
        for (size_t i = 0; i < first.size(); ++i) {
            if (first[i] && second[i]) { return true; }
        }
        return false;
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
        const Matrix rows = M_.top(exact_.count + polygon_.size());
        if (solver_.solve({.H = H_, .f = f_, .M = rows, .lower = lower_, .upper = upper_}, exact_.count, dx)) { return true; }
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
            if (newton(q, kept_, EXACT) && is_above_polygon(q, kept_, EXACT)) {
                copy(kept_, dx);
                return true;
            }
            // At a bound, or too far: the program once more, with what its end misses.
            if (pass == EXACT_PASSES) { return false; }
            exact_error(q, dx);
            for (size_t row = 0; row < end_rows_.count; ++row) { rhs_[row] += end_rows_.errors[row]; }
            errors_.locate(end_);
            for (size_t k = 0; k < polygon_.size(); ++k) {
                double& room = rhs_[exact_.count + k];
                room -= std::max(0.0, errors_.center_of_mass(polygon_[k], change_));
            }
            if (!solve_program(dx)) { return false; }
        }
    }

    // Newton's method with the least change of dx, to exact tasks whose errors at q + dx are below a tolerance, reaches. Joints that it
    // would take out of the bounds stay there. If the others cannot do it, it returns false, and dx is the best one that was found.
    //
    // It goes on with the derivatives of its start while these make the errors much smaller (chord method).
    bool newton(Vector q, Result dx, double tolerance) {
        std::ranges::fill(is_held_, 0);
        double least = INF;
        double moved = 0.0;  // since the derivatives were found, rad or reaches
        for (int iteration = 0; iteration < EXACT_STEPS; ++iteration) {
            const double error = exact_error(q, dx);
            if (error < tolerance) { return true; }
            if (error > STALLED_SHARE * least) { break; }
            if (iteration == 0 || error > CHORD_SHARE * least) {
                differentiate_exact();
                moved = 0.0;
            }
            least = error;
            copy(dx, nearest_);
            const Correction correction = correct(dx);
            // The second derivatives of a frame's pose are at most the levers of the joints that move it, which are at most one reach.
            if (correction.left + (moved + 0.5 * correction.size) * correction.size < tolerance) { return true; }
            moved += correction.size;
        }
        copy(nearest_, dx);
        return false;
    }

    // What a correction changed.
    struct Correction {
        double size = 0.0;  // the sum of all changes, rad or reaches
        double left = 0.0;  // what it leaves of the errors to first order
    };

    // Finds the derivatives of exact tasks where the joints are placed.
    void differentiate_exact() {
        end_rows_.clear();
        for (const TreeTask& task : tasks_) {
            if (task.exact) { errors_.add_rows(task, end_rows_); }
        }
        for (size_t c = 0; c < is_held_.size(); ++c) {
            if (is_held_[c]) { leave_out(c); }
        }
        factorize_gram();
    }

    void leave_out(size_t column) {
        for (size_t row = 0; row < end_rows_.count; ++row) { end_rows_.J(row, column) = 0.0; }
    }

    // Factorizes J J^T of the exact tasks.
    void factorize_gram() {
        const MatrixResult gram{gram_.numbers().data(), end_rows_.count, end_rows_.count};
        for (size_t row = 0; row < gram.rows; ++row) {
            for (size_t other = 0; other <= row; ++other) { gram(row, other) = dot(end_rows_.J.row(row), end_rows_.J.row(other)); }
            gram(row, row) += MIN_WEIGHT;
        }
        factorize(gram);
    }

    // Changes dx (n,) by the least step that makes up for the errors of exact tasks. Joints that it would take out of the bounds go there
    // and are held, and the others make up for the rest.
    Correction correct(Result dx) {
        Correction correction;
        do { correction.left = solve_gram(); } while (hold_at_bounds(dx, correction.size));
        for (size_t c = 0; c < correction_.size(); ++c) {
            dx[movers_.unknowns[c]] += correction_[c];
            correction.size += std::abs(correction_[c]);
        }
        return correction;
    }

    // Finds the least correction (C,) of the errors of exact tasks. Returns what it leaves of them to first order.
    double solve_gram() {
        const size_t count = end_rows_.count;
        const Result multipliers = Result(multipliers_).first(count);
        copy(Vector(end_rows_.errors).first(count), multipliers);
        solve(Matrix{gram_.numbers().data(), count, count}, multipliers);
        std::ranges::fill(correction_, 0.0);
        double left = 0.0;
        for (size_t row = 0; row < count; ++row) {
            const Vector J = end_rows_.J.row(row);
            for (size_t c = 0; c < J.size(); ++c) { correction_[c] += J[c] * multipliers[row]; }
            left = std::max(left, MIN_WEIGHT * std::abs(multipliers[row]));
        }
        return left;
    }

    // Moves the joints that a correction would take out of the bounds there, and holds them. Returns whether there are any.
    bool hold_at_bounds(Result dx, double& size) {
        bool is_any = false;
        for (size_t c = 0; c < correction_.size(); ++c) {
            const size_t i = movers_.unknowns[c];
            const Bounds bounds{low_[i], high_[i]};
            if (is_held_[c] || bounds.contain(dx[i] + correction_[c])) { continue; }
            const double change = bounds.clamp(dx[i] + correction_[c]) - dx[i];
            for (size_t row = 0; row < end_rows_.count; ++row) { end_rows_.errors[row] -= end_rows_.J(row, c) * change; }
            dx[i] += change;
            size += std::abs(change);
            is_held_[c] = true;
            is_any = true;
            leave_out(c);
        }
        if (is_any) { factorize_gram(); }
        return is_any;
    }

    void set_end(Vector q, Vector dx) {
        for (size_t i = 0; i < n(); ++i) { end_[i] = q[i] + dx[i] * errors_.unit()[i]; }
    }

    // The greatest error of exact tasks at the end of a step dx (n,) from q (n,). Places the joints that move them.
    double exact_error(Vector q, Vector dx) {
        set_end(q, dx);
        errors_.locate(end_, movers_.joints);
        end_rows_.clear();
        for (const TreeTask& task : tasks_) {
            if (task.exact) { errors_.add_errors(task, end_rows_); }
        }
        double most = 0.0;
        for (size_t row = 0; row < end_rows_.count; ++row) { most = std::max(most, std::abs(end_rows_.errors[row])); }
        return most;
    }

    // Whether the center of mass is above its polygon, or outside by at most a number of reaches, at the end of a step dx (n,) from
    // q (n,).
    bool is_above_polygon(Vector q, Vector dx, double outside) {
        if (polygon_.empty()) { return true; }
        set_end(q, dx);
        errors_.locate(end_);
        return outside_polygon() <= outside * errors_.reach();
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

    // Bounds of a step from q: the joint limits, and the longest move, rad or reaches.
    void set_room(Vector q, double longest) {
        for (size_t i = 0; i < n(); ++i) {
            const double unit = errors_.unit()[i];
            low_[i] = std::max(std::min(limits_.q_min[i] - q[i], 0.0) / unit, -longest);
            high_[i] = std::min(std::max(limits_.q_max[i] - q[i], 0.0) / unit, longest);
        }
    }

    static std::vector<TreeTask> exact_tasks(const std::vector<TreeTask>& tasks) {
        std::vector<TreeTask> exact;
        std::ranges::copy_if(tasks, std::back_inserter(exact), &TreeTask::exact);
        return exact;
    }

    bool has_exact() const { return !polygon_.empty() || std::ranges::any_of(tasks_, &TreeTask::exact); }

    TreeErrors errors_;
    JointLimits limits_;
    std::vector<TreeTask> tasks_;
    std::vector<HalfPlane> polygon_;
    TaskRows soft_, exact_;
    Movers movers_;      // of exact tasks
    TaskRows end_rows_;  // of exact tasks, at the end of a step
    NullSpaceSolver solver_;
    ActiveSetSolver box_;
    Mat M_;
    // Scratch memory.
    TaskRows relaxed_{exact_.errors.size() + polygon_.size(), first_numbers(n())};
    std::vector<size_t> firsts_, ends_;                                            // rows of each task
    std::vector<std::vector<bool>> moves_{tasks_.size(), std::vector<bool>(n())};  // which unknowns move each task
    Numbers correction_ = Numbers(movers_.unknowns.size());
    Numbers multipliers_ = Numbers(exact_.errors.size());
    std::vector<char> is_held_ = std::vector<char>(movers_.unknowns.size());
    Mat H_{n(), n()}, C_{n(), n()}, factor_{n(), n()};
    Mat gram_{exact_.errors.size(), exact_.errors.size()};
    Numbers f_ = Numbers(n()), diagonal_ = f_, pull_ = f_, posture_weight_ = f_, squares_ = f_, low_ = f_, high_ = f_, way_ = f_,
            before_ = f_, straight_ = f_, dx_ = f_, kept_ = f_, nearest_ = f_, end_ = f_, trial_ = f_, best_ = f_, change_ = f_;
    Numbers rhs_ = Numbers(M_.rows());
    Numbers rooms_ = Numbers(polygon_.size());  // of the center of mass, to each edge of the polygon, reaches
    Numbers lower_ = Numbers(n() + M_.rows()), upper_ = lower_;
};

}  // namespace armctl
