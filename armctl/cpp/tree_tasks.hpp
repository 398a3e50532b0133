// What the frames of a tree should reach: the errors of tasks, and how the joints change them.
//
// Errors have no unit: lengths are in reaches and angles have the weight ROTATION_WEIGHT, as in error_model.hpp. Unknowns are the
// positions of the arm's n in rad, or in reaches where a joint slides.
#pragma once
#include <numeric>
#include <optional>
#include <vector>

#include "dynamics.hpp"
#include "error_model.hpp"

namespace armctl {

// What one frame should reach.
struct TreeTask {
    CarriedFrame frame;
    CarriedFrame reference{};  // the frame in which the target is given
    Constraint constraint = Constraint::pose;
    bool points = false;  // whether the frame's z axis should point to the target's position, and nothing else matters
    bool exact = false;   // whether it holds before all others
    Pose target{};
};

// The half plane a . (x, y) <= bound, for the center of mass, m.
struct HalfPlane {
    double x;
    double y;
    double bound;
};

// Masses that no joint moves.
struct FixedMass {
    double mass = 0.0;
    Vec3 center;
};

// Rows of a linear model: error (rows,) and its change (rows, columns) per unknown that has a column.
struct TaskRows {
    TaskRows(size_t capacity, std::vector<size_t> unknowns) : columns(std::move(unknowns)), errors(capacity), J(capacity, columns.size()) {}

    void clear() { count = 0; }

    std::vector<size_t> columns;  // the unknowns
    Numbers errors;
    Mat J;
    size_t count = 0;
};

// 0, 1, ... to below a count.
inline std::vector<size_t> first_numbers(size_t count) {
    std::vector<size_t> numbers(count);
    std::iota(numbers.begin(), numbers.end(), size_t{0});
    return numbers;
}

// What moves some tasks: joints, parents before children, and the unknowns that move these.
struct Movers {
    std::vector<size_t> joints;
    std::vector<size_t> unknowns;
};

// The kinematics of the tasks at one configuration, with scratch memory: one object for each thread.
class TreeErrors {
public:
    // `unit` (n,) is one unit of each unknown: 1 rad, or the reach, m, for a joint that slides.
    TreeErrors(const Model& model, double reach, Vector unit, FixedMass fixed)
        : dynamics_(model), reach_(reach), unit_(unit.begin(), unit.end()), fixed_(fixed), J_(unit.size()), body_J_(unit.size()) {}

    size_t n() const { return unit_.size(); }
    double reach() const { return reach_; }
    Vector unit() const { return unit_; }

    // Places the joints at q (n,) rad (m).
    void locate(Vector q) { dynamics_.locate(q); }

    // Places some joints only: all that move the tasks whose errors, rows and frames are asked for then.
    void locate(Vector q, const std::vector<size_t>& joints) { dynamics_.locate(q, joints); }

    // What moves some tasks.
    Movers movers(const std::vector<TreeTask>& tasks) const {
        const ArmModel& model = dynamics_.model();
        if (!model.is_plain) { return {.joints = first_numbers(model.joints.size()), .unknowns = first_numbers(n())}; }
        std::vector<bool> moves(n());
        for (const TreeTask& task : tasks) {
            for (const int last : {task.frame.joint, task.reference.joint}) {
                for (int joint = last; joint >= 0; joint = parent(joint)) { moves[static_cast<size_t>(joint)] = true; }
            }
        }
        std::vector<size_t> moving;
        for (size_t j = 0; j < n(); ++j) {
            if (moves[j]) { moving.push_back(j); }
        }
        return {.joints = moving, .unknowns = moving};
    }

    // The errors of a task, m and rad.
    PoseError error(const TreeTask& task) const {
        const Pose tip = pose_of(task.frame);
        const Pose goal = goal_of(task);
        if (task.points) { return {0.0, norm(rotation_error(Constraint::free_z, tip.rotation, towards(tip, goal)))}; }
        return residual(task.constraint, goal, tip);
    }

    // Adds the rows of a task: the errors, and the motion of the frame per unknown that makes them smaller.
    void add_rows(const TreeTask& task, TaskRows& rows) {
        const Pose tip = pose_of(task.frame);
        const Pose goal = goal_of(task);
        const size_t first = rows.count;
        add_errors(task, tip, goal, rows);
        std::ranges::fill(J_, Twist{});
        dynamics_.add_jacobian(task.frame.joint, tip.translation, 1.0, J_);
        dynamics_.add_jacobian(task.reference.joint, task.points ? tip.translation : goal.translation, -1.0, J_);
        if (task.points) {
            turn_with_goal(tip, goal);
            set_derivatives(ROTATION_WEIGHT, &Twist::angular, first, rows);
            return;
        }
        set_derivatives(1.0 / reach_, &Twist::linear, first, rows);
        if (task.constraint == Constraint::position) { return; }
        if (has_free_axis(task.constraint)) { remove_turn(axis_of(tip.rotation, free_axis(task.constraint))); }
        set_derivatives(ROTATION_WEIGHT, &Twist::angular, first + 3, rows);
    }

    // The same, with derivatives that are left as they are.
    void add_errors(const TreeTask& task, TaskRows& rows) const { add_errors(task, pose_of(task.frame), goal_of(task), rows); }

    // Adds the curvature of a task in the world to the lower triangle of a matrix (n, n): minus error . d^2 tip / dq_i dq_j, which is
    // z_i x dp/dq_j where joint i carries joint j. `first` is the first row of the task.
    //
    // The curvature of other tasks, and of joints that follow others, is not known: the size of the error on the diagonal is a bound
    // of it where joints move the tip by a reach.
    void add_curvature(const TreeTask& task, const TaskRows& rows, size_t first, MatrixResult C) const {
        const ArmModel& model = dynamics_.model();
        const bool is_oriented = task.constraint != Constraint::position;
        if (!model.is_plain || task.points || task.reference.joint >= 0) {
            const size_t last = first + (task.points || !is_oriented ? 3 : 6);
            const Vector errors = Vector(rows.errors).subspan(first, last - first);
            for (size_t i = 0; i < n(); ++i) { C(i, i) += std::sqrt(dot(errors, errors)); }
            return;
        }
        const Vec3 linear = vec3(Vector(rows.errors).subspan(first));
        const Vec3 angular = is_oriented ? vec3(Vector(rows.errors).subspan(first + 3)) : Vec3{};
        for (int below = task.frame.joint; below >= 0; below = parent(below)) {
            const size_t j = static_cast<size_t>(below);
            const Vec3 p = column(rows, first, j);
            const Vec3 w = is_oriented ? column(rows, first + 3, j) : Vec3{};
            for (int above = below; above >= 0; above = parent(above)) {
                const size_t i = static_cast<size_t>(above);
                if (model.joints[i].slides) { continue; }
                const Vec3 z = dynamics_.joint_frame(above).rotation.z;
                C(j, i) -= dot(cross(linear, z), p) + 0.5 * dot(cross(angular, z), w);
            }
        }
    }

    // By how much the center of mass is outside a half plane, in reaches; negative inside. Fills its change per unknown (n,).
    double center_of_mass(const HalfPlane& half, Result change) {
        find_center_of_mass();
        for (size_t i = 0; i < n(); ++i) { change[i] = unit_[i] / reach_ * (half.x * body_J_[i].linear.x + half.y * body_J_[i].linear.y); }
        return (half.x * center_.x + half.y * center_.y - half.bound) / reach_;
    }

    Pose pose_of(const CarriedFrame& frame) const { return dynamics_.pose_of(frame); }

private:
    static constexpr double MAX_ERROR = 1e3;  // reaches: beyond it, a step's gain is lost to rounding

    Pose goal_of(const TreeTask& task) const { return pose_of(task.reference) * task.target; }

    int parent(int joint) const { return dynamics_.model().joints[static_cast<size_t>(joint)].parent; }

    static Vec3 column(const TaskRows& rows, size_t first, size_t i) {
        return {rows.J(first, i), rows.J(first + 1, i), rows.J(first + 2, i)};
    }

    // An orientation whose z axis points from the tip to the goal.
    Rotation towards(const Pose& tip, const Pose& goal) const {
        const Vec3 away = goal.translation - tip.translation;
        Rotation rotation;
        rotation.z = (1.0 / std::max(norm(away), least_distance())) * away;
        return rotation;
    }

    // m: from a frame that is nearer to what it points to, the direction means nothing.
    double least_distance() const { return 1e-6 * reach_; }

    void add_errors(const TreeTask& task, const Pose& tip, const Pose& goal, TaskRows& rows) const {
        const Result errors = Result(rows.errors).subspan(rows.count);
        if (task.points) {
            (ROTATION_WEIGHT * rotation_error(Constraint::free_z, tip.rotation, towards(tip, goal))).store(errors);
            rows.count += 3;
            return;
        }
        const Vec3 linear = (1.0 / reach_) * (goal.translation - tip.translation);
        const double share = std::min(1.0, MAX_ERROR / std::max(norm(linear), TINIEST));
        (share * linear).store(errors);
        rows.count += 3;
        if (task.constraint == Constraint::position) { return; }
        (ROTATION_WEIGHT * rotation_error(task.constraint, tip.rotation, goal.rotation)).store(errors.subspan(3));
        rows.count += 3;
    }

    // Adds to the Jacobian of a frame whose z axis points to a goal that the direction of the goal changes as the frame moves.
    void turn_with_goal(const Pose& tip, const Pose& goal) {
        const Rotation wanted = towards(tip, goal);
        const double length = std::max(norm(goal.translation - tip.translation), least_distance());
        remove_turn(tip.rotation.z);
        for (Twist& column : J_) { column.angular += (1.0 / length) * cross(wanted.z, column.linear); }
    }

    // Takes the turn about an axis out of the angular rows of the Jacobian: it costs nothing.
    void remove_turn(Vec3 axis) {
        for (Twist& column : J_) { column.angular -= dot(axis, column.angular) * axis; }
    }

    // Sets the derivatives of three rows from the linear or the angular part of the Jacobian.
    void set_derivatives(double scale, Vec3 Twist::* part, size_t first, TaskRows& rows) const {
        for (size_t c = 0; c < rows.columns.size(); ++c) {
            const size_t i = rows.columns[c];
            const Vec3 change = scale * unit_[i] * (J_[i].*part);
            rows.J(first, c) = change.x;
            rows.J(first + 1, c) = change.y;
            rows.J(first + 2, c) = change.z;
        }
    }

    // The center of mass, and the Jacobian of it.
    void find_center_of_mass() {
        const std::vector<Joint>& joints = dynamics_.model().joints;
        double total = fixed_.mass;
        Vec3 moment = fixed_.mass * fixed_.center;
        std::ranges::fill(body_J_, Twist{});
        for (size_t j = 0; j < joints.size(); ++j) { total += joints[j].mass; }
        for (size_t j = 0; j < joints.size(); ++j) {
            const Vec3 center = dynamics_.joint_frame(static_cast<int>(j)) * joints[j].center;
            moment += joints[j].mass * center;
            dynamics_.add_jacobian(static_cast<int>(j), center, joints[j].mass / total, body_J_);
        }
        center_ = (1.0 / total) * moment;
    }

    Dynamics dynamics_;
    double reach_;
    Numbers unit_;  // (n,)
    FixedMass fixed_;
    std::vector<Twist> J_;       // (n,) columns, of a task's frame in its reference
    std::vector<Twist> body_J_;  // (n,) columns, of the center of mass
    Vec3 center_;
};

}  // namespace armctl
