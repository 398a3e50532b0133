#include "closed_form.hpp"

#include <algorithm>
#include <numbers>
#include <utility>

#include "chain_kinematics.hpp"

namespace armctl {

namespace {

constexpr double NEAR_DOUBLE_ROOT = 1e-6;  // of a cosine from 1: the two roots are closer than 3e-3 rad, and may be one
constexpr double TINY = 1e-9;              // reaches, or sine of an angle: a circle with that radius is a point

// What the closed form may miss by, in cosines, and whether the number of solutions is doubtful: rounding decides it, or all angles
// of a joint are solutions.
struct Rounding {
    double slack;
    bool is_doubtful = false;
};

// Configurations of some joints.
template <size_t JOINTS, size_t CAPACITY>
struct Configurations {
    std::array<std::array<double, JOINTS>, CAPACITY> angles{};
    size_t count = 0;

    void add(const std::array<double, JOINTS>& configuration) { angles[count++] = configuration; }
};

using Triple = std::array<double, 3>;
using PairAngles = Configurations<2, 2>;
using LoopAngles = Configurations<3, 4>;     // of the three joints that are found first, in the order of the loop
using SpecialAngles = Configurations<3, 2>;  // of the three special joints
using SixAngles = Configurations<6, MAX_CONFIGURATIONS>;

// The angles that solve an equation.
struct Roots {
    std::array<double, 2> angles{};
    size_t count = 0;
};

// The angles t with a cos t + b sin t = d, at most two.
//
// A cosine up to 1 + slack counts as 1. If every angle is a solution, the preferred one is returned.
Roots linear_roots(double a, double b, double d, Rounding& rounding, double preferred) {
    const double radius = std::sqrt(a * a + b * b);
    const double cos = radius < TINY ? 1.0 : d / radius;
    const double size = std::abs(cos);
    if (std::abs(size - 1.0) <= NEAR_DOUBLE_ROOT || (size > 1.0 && size <= 1.0 + rounding.slack)) { rounding.is_doubtful = true; }
    if (radius < TINY) { return {.angles = {preferred}, .count = std::abs(d) <= TINY + rounding.slack ? 1u : 0u}; }
    if (size > 1.0 + rounding.slack) { return {}; }
    const double middle = std::atan2(b, a);
    if (size > 1.0) { return {.angles = {cos > 0 ? middle : middle + std::numbers::pi}, .count = 1}; }
    const double half = std::acos(cos);
    return {.angles = {middle + half, middle - half}, .count = 2};
}

// The part of a vector across an axis.
Vec3 across(Vec3 axis, Vec3 a) { return a - dot(axis, a) * axis; }

// What a hinge moves as a whole, by an angle from the zero configuration.
Pose motion(const Line& line, double angle) {
    const Rotation turn = rotation_about(line.axis, angle);
    return {turn, line.point - turn * line.point};
}

// A B^-1
Pose over(const Pose& A, const Pose& B) {
    const Rotation& R = B.rotation;
    const Rotation turn = {A.rotation * R.row_x(), A.rotation * R.row_y(), A.rotation * R.row_z()};
    return {turn, A.translation - turn * B.translation};
}

// A line as another frame sees it.
Line seen_from(const Pose& X, const Line& line) {
    return {X.rotation.inverse_times(line.axis), X.rotation.inverse_times(line.point - X.translation)};
}

// The angle about an axis from a to b; the preferred one if one of them is on the axis.
double angle_between(Vec3 axis, Vec3 a, Vec3 b, Rounding& rounding, double preferred) {
    const Vec3 u = across(axis, a);
    const Vec3 v = across(axis, b);
    if (std::min(dot(u, u), dot(v, v)) < TINY * TINY) {
        rounding.is_doubtful = true;
        return preferred;
    }
    return std::atan2(dot(axis, cross(u, v)), dot(u, v));
}

// Where a line moves a point by an angle t, or an axis turns a direction: centre + u cos t + v sin t.
class Circle {
public:
    Circle(const Line& line, Vec3 start)
        : centre_(line.point + dot(line.axis, start - line.point) * line.axis), u_(start - centre_), v_(cross(line.axis, u_)) {}
    Circle(Vec3 axis, Vec3 direction) : Circle(Line{axis, {}}, direction) {}

    Vec3 at(double angle) const { return centre_ + (std::cos(angle) * u_ + std::sin(angle) * v_); }

    // The angles at a height along an axis.
    Roots at_height(Vec3 axis, double height, Rounding& rounding, double preferred) const {
        return linear_roots(dot(axis, u_), dot(axis, v_), height - dot(axis, centre_), rounding, preferred);
    }

    // The angles at which the point is as far from another one as the goal.
    Roots at_distance_of(Vec3 goal, Vec3 from, Rounding& rounding, double preferred) const {
        const Vec3 away = goal - from;
        const Vec3 out = centre_ - from;
        return linear_roots(dot(out, u_), dot(out, v_), 0.5 * (dot(away, away) - dot(out, out) - dot(u_, u_)), rounding, preferred);
    }

private:
    Vec3 centre_;
    Vec3 u_;
    Vec3 v_;
};

// E_1 E_2 x = goal, for two lines that meet or are parallel. Where all angles are solutions, they are the preferred ones.
PairAngles pair_angles(const Line& first, const Line& second, AxesRelation relation, Vec3 x, Vec3 goal, Rounding& rounding,
                       std::array<double, 2> preferred) {
    const auto& [f1, p1] = first;
    const Circle circle(second, x);
    // Line 1 keeps the height along it, and the distance from it; where the lines are parallel, line 2 keeps the height too.
    const double height = dot(f1, goal - p1);
    const Roots angles2 = relation == AxesRelation::meet ? circle.at_height(f1, dot(f1, p1) + height, rounding, preferred[1])
                                                         : circle.at_distance_of(goal, p1 + height * f1, rounding, preferred[1]);
    PairAngles pair;
    for (size_t k = 0; k < angles2.count; ++k) {
        const Vec3 x1 = circle.at(angles2.angles[k]);
        pair.add({angle_between(f1, x1 - p1, goal - p1, rounding, preferred[0]), angles2.angles[k]});
    }
    return pair;
}

// E_1 E_2 E_3 start = goal, for three lines of which the first two are related.
LoopAngles point_angles(const std::array<Line, 3>& lines, Vec3 start, Vec3 goal, AxesRelation relation, Rounding& rounding,
                        const Triple& preferred) {
    const auto& [f1, p1] = lines[0];
    // Line 3 moves the point to where lines 2 and 1 can turn it to the goal.
    const Circle circle(lines[2], start);
    const Roots last = relation == AxesRelation::meet ? circle.at_distance_of(goal, p1, rounding, preferred[2])
                                                      : circle.at_height(f1, dot(f1, goal), rounding, preferred[2]);
    LoopAngles loop;
    for (size_t i = 0; i < last.count; ++i) {
        const Vec3 x = circle.at(last.angles[i]);
        const PairAngles pair = pair_angles(lines[0], lines[1], relation, x, goal, rounding, {preferred[0], preferred[1]});
        for (size_t k = 0; k < pair.count; ++k) { loop.add({pair.angles[k][0], pair.angles[k][1], last.angles[i]}); }
    }
    return loop;
}

// E_1 E_2 E_3 turns the direction u into h and keeps the heights along them, for three lines of which the first two are related.
//
// Without the angle of the joint in the middle, these are f2 . (E_3 u) = f2 . (E_1^-1 h) and
// h . (E_1 p2) = u . (E_3^-1 p2) + offset. The first one holds only angle 3 if f1 and f2 are parallel, the second one if they meet.
//
// p2 must be the point in which they meet. The offset is h . (X x) - u . x, which is the same for all x.
LoopAngles plane_angles(const std::array<Line, 3>& lines, Vec3 u, Vec3 h, double offset, AxesRelation relation, Rounding& rounding,
                        const Triple& preferred) {
    const auto& [f1, p1] = lines[0];
    const auto& [f2, p2] = lines[1];
    const auto& [f3, p3] = lines[2];
    const bool do_meet = relation == AxesRelation::meet;
    const Circle turned_u(f3, u);             // E_3 u
    const Circle turned_h(-f1, h);            // E_1^-1 h
    const Circle moved_p2(lines[0], p2);      // E_1 p2
    const Circle returned_p2({-f3, p3}, p2);  // E_3^-1 p2
    const Roots last = do_meet ? returned_p2.at_height(u, dot(h, p2) - offset, rounding, preferred[2])
                               : turned_u.at_height(f2, dot(f2, h), rounding, preferred[2]);
    LoopAngles loop;
    for (size_t i = 0; i < last.count; ++i) {
        const double angle3 = last.angles[i];
        const Vec3 turned = turned_u.at(angle3);
        const Roots first = do_meet ? turned_h.at_height(f2, dot(f2, turned), rounding, preferred[0])
                                    : moved_p2.at_height(h, dot(u, returned_p2.at(angle3)) + offset, rounding, preferred[0]);
        for (size_t k = 0; k < first.count; ++k) {
            const double angle1 = first.angles[k];
            loop.add({angle1, angle_between(f2, turned, turned_h.at(angle1), rounding, preferred[1]), angle3});
        }
    }
    return loop;
}

// The special joints, from their motion E_a E_b E_c.
SpecialAngles special_angles(std::span<const Line, 3> lines, AxesRelation relation, const Pose& moved, const Triple& preferred,
                             Rounding& rounding) {
    const auto& [a, b, c] = std::array{lines[0], lines[1], lines[2]};
    const bool do_meet = relation == AxesRelation::meet;
    // E_c leaves a point of its axis where it is, and turns a direction across its axis.
    const Vec3 x = do_meet ? c.point + c.axis : c.point;
    const Vec3 u = do_meet ? b.axis : b.point - a.point;
    const Vec3 moved_u = moved.rotation * u;
    const double sum = do_meet ? 0.0 : angle_between(a.axis, u, moved_u, rounding, 0.0);  // of the angles about parallel axes
    const PairAngles pair = pair_angles(a, b, relation, x, moved * x, rounding, {preferred[0], preferred[1]});
    SpecialAngles special;
    for (size_t k = 0; k < pair.count; ++k) {
        const auto [first, middle] = pair.angles[k];
        double last = dot(a.axis, c.axis) * (sum - first - dot(a.axis, b.axis) * middle);
        if (do_meet) {
            const Vec3 back = Circle(b.axis, Circle(a.axis, moved_u).at(-first)).at(-middle);
            last = angle_between(c.axis, u, back, rounding, preferred[2]);
        }
        special.add({first, middle, last});
    }
    return special;
}

// Six hinges in the zero configuration.
struct SixHinges {
    std::array<Line, 6> lines;
    Pose tip;
    const SpecialAxes& special;
    size_t first;  // of the special axes, among the six

    // All angles with E_1 ... E_6 = X. Where all angles of a joint are solutions, it is the preferred one.
    SixAngles solve(const Pose& X, const std::array<double, 6>& preferred, Rounding& rounding) const;

private:
    LoopAngles loop_angles(const Pose& X, std::array<Line, 3> loop, Triple preferred, Rounding& rounding) const;
};

// The angles of the three joints that are not special.
LoopAngles SixHinges::loop_angles(const Pose& X, std::array<Line, 3> loop, Triple preferred, Rounding& rounding) const {
    const auto [axis, point] = lines[first];
    const bool do_meet = special.relation == AxesRelation::meet;
    // The point or the direction that the special joints leave as it is, and what the others have to move there.
    Vec3 goal = do_meet ? point : axis;
    Vec3 start = X.rotation.inverse_times(do_meet ? point - X.translation : axis);
    double offset = dot(axis, X.translation);
    const bool is_last_pair = special.pair_first == 1;
    if (is_last_pair) {  // the chain is gone through backwards
        std::ranges::reverse(loop);
        std::ranges::reverse(preferred);
        for (Line& line : loop) { line.axis = -line.axis; }
        std::swap(start, goal);
        offset = -offset;
    }
    LoopAngles found = do_meet ? point_angles(loop, start, goal, special.pair_relation, rounding, preferred)
                               : plane_angles(loop, start, goal, offset, special.pair_relation, rounding, preferred);
    if (is_last_pair) {
        for (Triple& angles : found.angles) { std::ranges::reverse(angles); }
    }
    return found;
}

SixAngles SixHinges::solve(const Pose& X, const std::array<double, 6>& preferred, Rounding& rounding) const {
    // The joints that are not special, in the order of the loop: those at its front are moved to its end.
    std::array<size_t, 3> others{};
    std::array<Line, 3> loop;
    for (size_t k = 0; k < 3; ++k) {
        others[k] = (first + 3 + k) % 6;
        loop[k] = first + 3 + k < 6 ? lines[others[k]] : seen_from(X, lines[others[k]]);
    }
    const std::span<const Line, 3> axes(&lines[first], 3);
    const Triple preferred_special{preferred[first], preferred[first + 1], preferred[first + 2]};
    const LoopAngles three = loop_angles(X, loop, {preferred[others[0]], preferred[others[1]], preferred[others[2]]}, rounding);
    SixAngles six;
    for (size_t i = 0; i < three.count; ++i) {
        const auto [f, g, h] = three.angles[i];
        // E_a E_b E_c of the special joints, which is X (E_f E_g E_h)^-1.
        const Pose special_motion = over(X, motion(loop[0], f) * motion(loop[1], g) * motion(loop[2], h));
        const SpecialAngles found = special_angles(axes, special.relation, special_motion, preferred_special, rounding);
        for (size_t k = 0; k < found.count; ++k) {
            std::array<double, 6> angles{};
            for (size_t j = 0; j < 3; ++j) {
                angles[first + j] = found.angles[k][j];
                angles[others[j]] = three.angles[i][j];
            }
            six.add(angles);
        }
    }
    return six;
}

// The six other joints with one held at an angle, and the tip, in their zero configuration.
SixHinges with_held(const SpecialAxes& special, const ZeroConfiguration& zero, double angle) {
    const size_t held = zero.held.value_or(6);
    SixHinges six{.lines = {}, .tip = zero.tip, .special = special, .first = special.first - (held < special.first ? 1 : 0)};
    std::copy_n(zero.lines.begin(), held, six.lines.begin());
    if (held == 6 && !zero.held) { return six; }
    const Pose moved = motion(zero.lines[held], angle);
    for (size_t k = held; k < 6; ++k) { six.lines[k] = {moved.rotation * zero.lines[k + 1].axis, moved * zero.lines[k + 1].point}; }
    six.tip = moved * zero.tip;
    return six;
}

}  // namespace

ClosedForm::ClosedForm(std::shared_ptr<const Chain> chain, std::optional<size_t> held) : chain_(std::move(chain)) {
    const size_t n = held ? 7 : 6;
    if (!chain_->special_axes() || chain_->joints().size() != n || chain_->n() != n || held.value_or(0) >= n) {
        throw InputError("chain: expected special axes of six hinges, or of seven with one that is held");
    }
    ChainKinematics kinematics(*chain_);
    kinematics.place(Numbers(n));
    zero_.held = held;
    zero_.tip = kinematics.tip();
    for (size_t k = 0; k < n; ++k) { zero_.lines.push_back({kinematics.joints()[k].axis, kinematics.special_point(k)}); }
    checked_index(static_cast<std::int64_t>(with_held(*chain_->special_axes(), zero_, 0.0).first), 4, "first");
}

Seeds ClosedForm::find(const Pose& target, Vector q0, double slack, double margin, const Sweep& sweep, MatrixResult seeds) const {
    std::array<double, 6> preferred{};
    const auto joint = [this](size_t k) { return zero_.held && k >= *zero_.held ? k + 1 : k; };  // of the six
    for (size_t k = 0; k < 6; ++k) { preferred[k] = q0[joint(k)]; }
    const Vec3 p = target.translation;
    const double reach = chain_->reach();
    const Pose goal{target.rotation, {p.x / reach, p.y / reach, p.z / reach}};
    Rounding rounding{.slack = slack};
    Seeds found;
    for (const double angle : sweep.positions) {
        if (found.samples >= sweep.least && found.count >= sweep.wanted) { break; }
        const SixHinges six = with_held(*chain_->special_axes(), zero_, angle);
        const SixAngles solved = six.solve(over(goal, six.tip), preferred, rounding);
        found.doubtful = rounding.is_doubtful;
        ++found.samples;
        for (size_t i = 0; i < solved.count; ++i) {
            if (found.count == static_cast<std::int64_t>(seeds.rows)) { return found; }
            const Result seed = seeds.row(static_cast<size_t>(found.count));
            for (size_t k = 0; k < 6; ++k) { seed[joint(k)] = solved.angles[i][k]; }
            if (zero_.held) { seed[*zero_.held] = angle; }
            if (chain_->wind_inside(q0, margin, seed)) { ++found.count; }
        }
    }
    return found;
}

}  // namespace armctl
