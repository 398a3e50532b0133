// Where the joints and the tip of a chain are, and how they move.
#pragma once
#include "chain.hpp"

namespace armctl {

// Which parts of the tip's pose are constrained: `free_x` leaves the turn about the tip's x axis free.
enum class Constraint { pose = 0, position = 1, free_x = 2, free_y = 3, free_z = 4 };

inline bool has_free_axis(Constraint constraint) { return constraint >= Constraint::free_x; }
// The axis about which the tip may turn.
inline int free_axis(Constraint constraint) { return static_cast<int>(constraint) - static_cast<int>(Constraint::free_x); }

struct PoseError {
    double position;     // m, or reaches
    double orientation;  // rad
};

// The length of a vector; finite, also if its square overflows.
inline double distance(Vec3 away) { return std::min(std::hypot(away.x, away.y, away.z), 1.7e308); }

// The errors of a tip, in the unit of length of both poses. They are finite.
inline PoseError residual(Constraint constraint, const Pose& target, const Pose& tip) {
    const double away = distance(tip.translation - target.translation);
    if (constraint == Constraint::position) { return {away, 0.0}; }
    // The angle between two frames from the chords between their axes: exact for small angles, unlike that from the trace.
    const Vec3 x = tip.rotation.x - target.rotation.x;
    const Vec3 y = tip.rotation.y - target.rotation.y;
    const Vec3 z = tip.rotation.z - target.rotation.z;
    if (constraint == Constraint::pose) {
        return {away, 2.0 * std::asin(std::min(1.0, std::sqrt((dot(x, x) + dot(y, y) + dot(z, z)) / 8.0)))};
    }
    const Vec3 chord = axis_of({x, y, z}, free_axis(constraint));
    return {away, 2.0 * std::asin(std::min(1.0, std::sqrt(dot(chord, chord) / 4.0)))};
}

// The rotation vector from a tip to its goal; with a free axis the shortest one that aligns the two axes.
inline Vec3 rotation_error(Constraint constraint, const Rotation& tip, const Rotation& goal) {
    constexpr double min_sine = 1e-9;  // below it a rotation's axis is lost to rounding
    if (constraint == Constraint::pose) { return rotation_vector(tip, goal); }
    const int free = free_axis(constraint);
    const Vec3 wanted = axis_of(goal, free);
    const Vec3 axis = cross(axis_of(tip, free), wanted);
    const double cos = dot(axis_of(tip, free), wanted);
    const double sin = norm(axis);
    if (sin > min_sine) { return (std::atan2(sin, cos) / sin) * axis; }
    // Half a turn, about any axis across the free one.
    return cos >= 0.0 ? Vec3{} : std::numbers::pi * axis_of(tip, (free + 1) % 3);
}

// The joint of a chain in space.
struct JointLine {
    Vec3 origin;
    Vec3 axis;
};

// The signs of three factors of a Jacobian's determinant are numbered from 0 to 26; this is a chain without them.
inline constexpr int NO_BRANCH = 27;

// The kinematics of a chain at one configuration, with scratch memory: one object for each thread.
class ChainKinematics {
public:
    explicit ChainKinematics(const Chain& chain) : chain_(&chain), lines_(chain.joints().size()), jacobian_(chain.n()) {}

    const Chain& chain() const { return *chain_; }

    // Places the joints and the tip at q (n,).
    void place(Vector q) {
        Rotation rotation;
        Vec3 position;
        for (size_t j = 0; j < lines_.size(); ++j) {
            const ChainJoint& joint = chain_->joints()[j];
            position += rotation * joint.placement.translation;
            rotation = rotation * joint.placement.rotation;
            const double displacement = joint.ratio * q[joint.unknown];
            if (joint.slides) {
                position += displacement * rotation.z;
            } else {
                rotation = rotation.turned_about_z(displacement);
            }
            lines_[j] = {position, rotation.z};
        }
        tip_.translation = position + rotation * chain_->tip().translation;
        tip_.rotation = rotation * chain_->tip().rotation;
    }

    // The Jacobian of the tip where the joints are placed: a twist for each unknown, world axes.
    void find_jacobian() {
        std::ranges::fill(jacobian_, Twist{});
        for (size_t j = 0; j < lines_.size(); ++j) {
            const ChainJoint& joint = chain_->joints()[j];
            const Twist twist = joint_twist(j);
            Twist& total = jacobian_[joint.unknown];
            total = {joint.ratio * twist.linear + total.linear, joint.ratio * twist.angular + total.angular};
        }
    }

    // The branch where the joints are placed: the signs of the three factors of the Jacobian's determinant, as a number. Of an arm
    // with seven joints it is the Jacobian without the joint that is swept.
    int branch() const {
        if (!chain_->special_axes()) { return NO_BRANCH; }
        const SpecialAxes& special = *chain_->special_axes();
        const auto axis = [&](size_t j) { return lines_[j].axis; };
        const auto point = [&](size_t j) { return special_point(j); };
        const auto [f, g, h] = special.others;
        const size_t a = special.first;
        const bool is_first_pair = special.pair_first == 0;
        double first = 0.0;
        double second = 0.0;
        double third = 0.0;
        if (special.relation == AxesRelation::meet) {
            first = volume(axis(a), axis(a + 1), axis(a + 2));
            const size_t u = is_first_pair ? f : g;
            const size_t v = is_first_pair ? g : h;
            const size_t w = is_first_pair ? h : f;
            const Vec3 to_u = point(a) - point(u);
            const Vec3 to_v = point(a) - point(v);
            const Vec3 to_w = point(a) - point(w);
            if (special.pair_relation == AxesRelation::meet) {
                second = volume(to_u, axis(u), axis(v));
                third = volume(to_u, axis(w), to_w);
            } else {
                second = volume(axis(u), to_u, to_v);
                third = volume(axis(u), axis(w), to_w);
            }
        } else {
            const Vec3 direction = axis(a);
            first = volume(direction, point(a + 1) - point(a), point(a + 2) - point(a));
            const bool last_turns_plane = is_first_pair == (special.pair_relation == AxesRelation::meet);
            const size_t u = last_turns_plane ? h : f;
            second = volume(direction, axis(u), point(g) - point(u));
            third = volume(axis(g), axis(last_turns_plane ? f : h), direction);
        }
        return 9 * sign_code(first) + 3 * sign_code(second) + sign_code(third);
    }

    const std::vector<JointLine>& joints() const { return lines_; }
    // On the axis of a joint, the point in which it meets others.
    Vec3 special_point(size_t j) const { return lines_[j].origin + chain_->joints()[j].distance_to_point * lines_[j].axis; }
    const Pose& tip() const { return tip_; }
    // The tip with its position in m.
    Pose metric_tip() const { return {tip_.rotation, chain_->reach() * tip_.translation}; }
    std::vector<Twist>& jacobian() { return jacobian_; }
    const std::vector<Twist>& jacobian() const { return jacobian_; }

private:
    // A factor of the Jacobian's determinant, in reaches and sines: below it, its sign means nothing.
    static constexpr double SINGULAR = 1e-6;

    // The triple product a . (b x c).
    static double volume(Vec3 a, Vec3 b, Vec3 c) { return dot(a, cross(b, c)); }

    static int sign_code(double value) {
        if (std::abs(value) < SINGULAR) { return 0; }
        return value > 0 ? 1 : 2;
    }

    Twist joint_twist(size_t j) const {
        const JointLine& line = lines_[j];
        if (chain_->joints()[j].slides) { return {line.axis, {}}; }
        return {cross(line.axis, tip_.translation - line.origin), line.axis};
    }

    const Chain* chain_;
    std::vector<JointLine> lines_;  // (k,)
    Pose tip_;
    std::vector<Twist> jacobian_;  // (n,)
};

}  // namespace armctl
