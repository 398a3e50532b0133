#include "chain_kinematics.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace armctl {

namespace {

constexpr double SINGULAR = 1e-6;       // a factor of the Jacobian's determinant, in reaches and sines: below it, its sign means nothing
constexpr double MAX_LENGTH = 1.7e308;  // m: the errors of a result are finite
constexpr double INF = std::numeric_limits<double>::infinity();

// The triple product a . (b x c).
double volume(Vec3 a, Vec3 b, Vec3 c) { return dot(a, cross(b, c)); }

int sign_code(double value) {
    if (std::abs(value) < SINGULAR) { return 0; }
    return value > 0 ? 1 : 2;
}

// The distance of a target whose square overflows, in the unit of length.
double huge_distance(Vec3 away) {
    const double largest = std::max(std::max(std::abs(away.x), std::abs(away.y)), std::abs(away.z));
    const Vec3 share{away.x / largest, away.y / largest, away.z / largest};
    return std::min(largest * norm(share), MAX_LENGTH);
}

}  // namespace

PoseError residual(Constraint constraint, const Pose& target, const Pose& tip) {
    const Vec3 away = tip.translation - target.translation;
    const double squared = dot(away, away);
    const double distance = squared < INF ? std::sqrt(squared) : huge_distance(away);
    if (constraint == Constraint::position) { return {distance, 0.0}; }
    // The angle between two frames from the chords between their axes: exact for small angles, unlike that from the trace.
    const Vec3 x = tip.rotation.x - target.rotation.x;
    const Vec3 y = tip.rotation.y - target.rotation.y;
    const Vec3 z = tip.rotation.z - target.rotation.z;
    if (constraint == Constraint::pose) {
        const double squared_chord =
            x.x * x.x + y.x * y.x + z.x * z.x + x.y * x.y + y.y * y.y + z.y * z.y + x.z * x.z + y.z * y.z + z.z * z.z;
        return {distance, 2.0 * std::asin(std::min(1.0, std::sqrt(squared_chord / 8.0)))};
    }
    const Vec3 chord = axis_of({x, y, z}, free_axis(constraint));
    return {distance, 2.0 * std::asin(std::min(1.0, std::sqrt(dot(chord, chord) / 4.0)))};
}

ChainKinematics::ChainKinematics(const Chain& chain) : chain_(&chain), lines_(chain.joints().size()), jacobian_(chain.n()) {}

void ChainKinematics::place(Vector q) {
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

Twist ChainKinematics::joint_twist(size_t j) const {
    const JointLine& line = lines_[j];
    if (chain_->joints()[j].slides) { return {line.axis, {}}; }
    return {cross(line.axis, tip_.translation - line.origin), line.axis};
}

void ChainKinematics::find_jacobian() {
    if (!chain_->has_followers()) {
        for (size_t j = 0; j < lines_.size(); ++j) { jacobian_[j] = joint_twist(j); }
        return;
    }
    std::ranges::fill(jacobian_, Twist{});
    for (size_t j = 0; j < lines_.size(); ++j) {
        const ChainJoint& joint = chain_->joints()[j];
        const Twist twist = joint_twist(j);
        Twist& total = jacobian_[joint.unknown];
        total = {joint.ratio * twist.linear + total.linear, joint.ratio * twist.angular + total.angular};
    }
}

Vec3 ChainKinematics::special_point(size_t j) const { return lines_[j].origin + chain_->joints()[j].distance_to_point * lines_[j].axis; }

int ChainKinematics::branch() const {
    if (!chain_->special_axes()) { return NO_BRANCH; }
    const SpecialAxes& special = *chain_->special_axes();
    const auto axis = [&](size_t j) { return lines_[j].axis; };
    const auto point = [&](size_t j) { return special_point(j); };
    const auto [f, g, h] = special.others;
    const size_t a = special.first;
    const bool is_first_pair = special.pair_first == 0;
    double first = 0.0;
    double second = 0.0;
    double third = 1.0;
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
        } else if (special.pair_relation == AxesRelation::parallel) {
            second = volume(axis(u), to_u, to_v);
            third = volume(axis(u), axis(w), to_w);
        } else {
            // The volume of axis x arm of the three joints, by (a x b) x (c x d) = b [a c d] - a [b c d].
            const double across = volume(axis(u), axis(v), to_v);
            const double along = volume(to_u, axis(v), to_v);
            second = across * volume(to_u, axis(w), to_w) - along * volume(axis(u), axis(w), to_w);
        }
    } else {
        const Vec3 direction = axis(a);
        first = volume(direction, point(a + 1) - point(a), point(a + 2) - point(a));
        const double turn_f = volume(axis(g), axis(f), direction);
        const double turn_h = volume(axis(g), axis(h), direction);
        const double height_f = volume(direction, axis(f), point(g) - point(f));
        const double height_h = volume(direction, axis(h), point(g) - point(h));
        if (special.pair_relation == AxesRelation::neither) {
            second = turn_f * height_h - turn_h * height_f;
        } else if (is_first_pair == (special.pair_relation == AxesRelation::meet)) {
            second = height_h;
            third = turn_f;
        } else {
            second = height_f;
            third = turn_h;
        }
    }
    return 9 * sign_code(first) + 3 * sign_code(second) + sign_code(third);
}

double ChainKinematics::manipulability(bool oriented) {
    constexpr size_t MOST_ROWS = 6;
    find_jacobian();
    const size_t n = jacobian_.size();
    const size_t rows = oriented ? MOST_ROWS : 3;
    const size_t size = std::min(n, rows);
    // A = J J^T, or J^T J with fewer unknowns than rows.
    std::array<std::array<double, MOST_ROWS>, MOST_ROWS> A{};
    for (const Twist& twist : jacobian_) {
        const std::array<double, MOST_ROWS> column = numbers({chain_->reach() * twist.linear, twist.angular});
        for (size_t i = 0; n >= rows && i < rows; ++i) {
            for (size_t j = 0; j <= i; ++j) { A[i][j] += column[i] * column[j]; }
        }
    }
    for (size_t i = 0; n < rows && i < n; ++i) {
        const std::array<double, MOST_ROWS> a = numbers({chain_->reach() * jacobian_[i].linear, jacobian_[i].angular});
        for (size_t j = 0; j <= i; ++j) {
            const std::array<double, MOST_ROWS> b = numbers({chain_->reach() * jacobian_[j].linear, jacobian_[j].angular});
            for (size_t k = 0; k < rows; ++k) { A[i][j] += a[k] * b[k]; }
        }
    }
    double product = 1.0;
    for (size_t i = 0; i < size; ++i) {  // L D L^T in place
        for (size_t j = 0; j < i; ++j) {
            for (size_t k = 0; k < j; ++k) { A[i][j] -= A[i][k] * A[j][k] * A[k][k]; }
            A[i][j] /= std::max(A[j][j], 1e-300);
        }
        for (size_t k = 0; k < i; ++k) { A[i][i] -= A[i][k] * A[i][k] * A[k][k]; }
        product *= std::max(A[i][i], 0.0);
    }
    return std::sqrt(product);
}

}  // namespace armctl
