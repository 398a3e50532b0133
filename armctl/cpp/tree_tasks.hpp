// What the frames of a tree should reach: the errors of tasks, and how the joints change them.
//
// Errors have no unit: lengths are in reaches and angles have the weight ROTATION_WEIGHT, as in error_model.hpp. Unknowns are the
// positions of the arm's n in rad, or in reaches where a joint slides.
#pragma once
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

// Rows of a linear model: error (rows,) and its change per unknown (rows, n).
struct TaskRows {
    TaskRows(size_t capacity, size_t n) : errors(capacity), J(capacity, n) {}

    void clear() { count = 0; }

    Numbers errors;
    Mat J;
    size_t count = 0;
};

// The kinematics of the tasks at one configuration, with scratch memory: one object for each thread.
class TreeErrors {
public:
    // `unit` (n,) is one unit of each unknown: 1 rad, or the reach, m, for a joint that slides.
    TreeErrors(const Model& model, double reach, Vector unit, FixedMass fixed)
        : dynamics_(model), reach_(reach), unit_(unit.begin(), unit.end()), fixed_(fixed), J_(6, unit.size()), body_J_(6, unit.size()) {}

    size_t n() const { return unit_.size(); }
    double reach() const { return reach_; }
    Vector unit() const { return unit_; }

    // Places the joints at q (n,) rad (m).
    void locate(Vector q) { dynamics_.locate(q); }

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
        std::ranges::fill(J_.numbers(), 0.0);
        dynamics_.add_jacobian(task.frame.joint, tip.translation, 1.0, J_);
        dynamics_.add_jacobian(task.reference.joint, task.points ? tip.translation : goal.translation, -1.0, J_);
        if (task.points) {
            add_direction(tip, goal, rows);
            return;
        }
        const Vec3 linear = (1.0 / reach_) * (goal.translation - tip.translation);
        const double length = norm(linear);
        const double share = std::min(1.0, MAX_ERROR / std::max(length, TINIEST));
        add(share * linear, 1.0 / reach_, 0, rows);
        if (task.constraint == Constraint::position) { return; }
        if (has_free_axis(task.constraint)) { remove_turn(axis_of(tip.rotation, free_axis(task.constraint))); }
        add(ROTATION_WEIGHT * rotation_error(task.constraint, tip.rotation, goal.rotation), ROTATION_WEIGHT, 3, rows);
    }

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
        for (size_t i = 0; i < n(); ++i) { change[i] = unit_[i] / reach_ * (half.x * body_J_(0, i) + half.y * body_J_(1, i)); }
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

    // The direction of a frame's z axis: it turns with the frame, and the goal wanders as the frame moves.
    void add_direction(const Pose& tip, const Pose& goal, TaskRows& rows) {
        const Rotation wanted = towards(tip, goal);
        const double length = std::max(norm(goal.translation - tip.translation), least_distance());
        remove_turn(tip.rotation.z);
        for (size_t i = 0; i < n(); ++i) {
            const Vec3 moved = (1.0 / length) * cross(wanted.z, Vec3{J_(0, i), J_(1, i), J_(2, i)});
            J_(3, i) += moved.x;
            J_(4, i) += moved.y;
            J_(5, i) += moved.z;
        }
        add(ROTATION_WEIGHT * rotation_error(Constraint::free_z, tip.rotation, wanted), ROTATION_WEIGHT, 3, rows);
    }

    // Takes the turn about an axis out of the angular rows of the Jacobian: it costs nothing.
    void remove_turn(Vec3 axis) {
        for (size_t i = 0; i < n(); ++i) {
            const Vec3 angular{J_(3, i), J_(4, i), J_(5, i)};
            const Vec3 left = angular - dot(axis, angular) * axis;
            J_(3, i) = left.x;
            J_(4, i) = left.y;
            J_(5, i) = left.z;
        }
    }

    // Adds three rows from the rows of the Jacobian that begin at `from`.
    void add(Vec3 error, double scale, size_t from, TaskRows& rows) {
        error.store(Result(rows.errors).subspan(rows.count));
        for (size_t row = 0; row < 3; ++row) {
            for (size_t i = 0; i < n(); ++i) { rows.J(rows.count + row, i) = scale * unit_[i] * J_(from + row, i); }
        }
        rows.count += 3;
    }

    // The center of mass, and the Jacobian (6, n) of it.
    void find_center_of_mass() {
        const std::vector<Joint>& joints = dynamics_.model().joints;
        double total = fixed_.mass;
        Vec3 moment = fixed_.mass * fixed_.center;
        std::ranges::fill(body_J_.numbers(), 0.0);
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
    Mat J_;       // (6, n), of a task's frame in its reference
    Mat body_J_;  // (6, n), of the center of mass
    Vec3 center_;
};

}  // namespace armctl
