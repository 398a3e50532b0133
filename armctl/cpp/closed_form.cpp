#include "closed_form.hpp"

#include <numbers>
#include <utility>

#include "chain_kinematics.hpp"

namespace armctl {

namespace {

constexpr double NEAR_DOUBLE_ROOT = 1e-6;  // of a cosine from 1: the two roots are closer than 3e-3 rad, and may be one
constexpr double TINY = 1e-9;              // reaches, or sine of an angle: a circle with that radius is a point

// The angles that solve an equation, and whether their number is doubtful: rounding decides, or all angles are solutions.
struct Roots {
    std::array<double, 2> angles{};
    size_t count = 0;
    bool doubtful = false;
};

// The angles t with a cos t + b sin t = d, at most two.
//
// A cosine up to 1 + slack counts as 1. If every angle is a solution, the preferred one is returned.
Roots linear_roots(double a, double b, double d, double slack, double preferred) {
    const double radius = std::sqrt(a * a + b * b);
    if (radius < TINY) { return {.angles = {preferred}, .count = std::abs(d) <= TINY + slack ? 1u : 0u, .doubtful = true}; }
    const double cos = d / radius;
    const double size = std::abs(cos);
    const double middle = std::atan2(b, a);
    if (size > 1.0 + slack) { return {.doubtful = size <= 1.0 + NEAR_DOUBLE_ROOT}; }
    if (size > 1.0) { return {.angles = {cos > 0 ? middle : middle + std::numbers::pi}, .count = 1, .doubtful = true}; }
    const double half = std::acos(cos);
    return {.angles = {middle + half, middle - half}, .count = 2, .doubtful = size > 1.0 - NEAR_DOUBLE_ROOT};
}

using Triple = std::array<double, 3>;

// Configurations of some joints, and whether their number is doubtful.
template <size_t JOINTS, size_t CAPACITY>
struct Configurations {
    std::array<std::array<double, JOINTS>, CAPACITY> angles{};
    size_t count = 0;
    bool doubtful = false;

    void add(const std::array<double, JOINTS>& configuration) { angles[count++] = configuration; }
};

using PairAngles = Configurations<2, 2>;
using LoopAngles = Configurations<3, 4>;     // of the three joints that are found first, in the order of the loop
using SpecialAngles = Configurations<3, 2>;  // of the three special joints
using SixAngles = Configurations<6, MAX_CONFIGURATIONS>;

struct Turn {
    double cos;
    double sin;

    explicit Turn(double angle) : cos(std::cos(angle)), sin(std::sin(angle)) {}
};

// The part of a vector across an axis.
Vec3 across(Vec3 axis, Vec3 a) { return a - dot(axis, a) * axis; }

// A vector turned about an axis (Rodrigues).
Vec3 turned(Vec3 axis, Turn turn, Vec3 a) {
    const double along = (1.0 - turn.cos) * dot(axis, a);
    return along * axis + turn.cos * a + turn.sin * cross(axis, a);
}

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

// The angle about an axis from a to b; it is undetermined if one of them is on the axis.
struct Angle {
    double value = 0.0;
    bool undetermined = false;
};

Angle angle_between(Vec3 axis, Vec3 a, Vec3 b, double preferred) {
    const Vec3 u = across(axis, a);
    const Vec3 v = across(axis, b);
    if (std::min(dot(u, u), dot(v, v)) < TINY * TINY) { return {preferred, true}; }
    return {std::atan2(dot(axis, cross(u, v)), dot(u, v)), false};
}

// Where a line moves a point: centre + u cos t + v sin t.
class Circle {
public:
    Circle(const Line& line, Vec3 start)
        : centre_(line.point + dot(line.axis, start - line.point) * line.axis), u_(start - centre_), v_(cross(line.axis, u_)) {}

    Vec3 at(double angle) const { return centre_ + (std::cos(angle) * u_ + std::sin(angle) * v_); }

    // The angles at which the point is as high along an axis as the goal.
    Roots at_height_of(Vec3 goal, Vec3 axis, double slack, double preferred) const {
        return linear_roots(dot(axis, u_), dot(axis, v_), dot(axis, goal - centre_), slack, preferred);
    }

    // The angles at which it is as far from a point as the goal.
    Roots at_distance_of(Vec3 goal, Vec3 from, double slack, double preferred) const {
        const Vec3 away = goal - from;
        const Vec3 out = centre_ - from;
        return linear_roots(dot(out, u_), dot(out, v_), 0.5 * (dot(away, away) - dot(out, out) - dot(u_, u_)), slack, preferred);
    }

private:
    Vec3 centre_;
    Vec3 u_;
    Vec3 v_;
};

// E_1 E_2 x = goal, for two lines that meet or are parallel. Where all angles are solutions, they are the preferred ones.
PairAngles pair_angles(const Line& first, const Line& second, AxesRelation relation, Vec3 x, Vec3 goal, double slack,
                       std::array<double, 2> preferred) {
    const auto& [f1, p1] = first;
    const Circle circle(second, x);
    // Line 1 keeps the height along it, and the distance from it; where the lines are parallel, line 2 keeps the height too.
    const Roots angles2 = relation == AxesRelation::meet ? circle.at_height_of(goal, f1, slack, preferred[1])
                                                         : circle.at_distance_of(goal, p1 + dot(f1, goal - p1) * f1, slack, preferred[1]);
    PairAngles pair{.doubtful = angles2.doubtful};
    for (size_t k = 0; k < angles2.count; ++k) {
        const Angle angle1 = angle_between(f1, circle.at(angles2.angles[k]) - p1, goal - p1, preferred[0]);
        pair.doubtful = pair.doubtful || angle1.undetermined;
        pair.add({angle1.value, angles2.angles[k]});
    }
    return pair;
}

// E_1 E_2 E_3 start = goal, for three lines of which the first two are related.
LoopAngles point_angles(const std::array<Line, 3>& lines, Vec3 start, Vec3 goal, AxesRelation relation, double slack,
                        const Triple& preferred) {
    const auto& [f1, p1] = lines[0];
    // Line 3 moves the point to where lines 2 and 1 can turn it to the goal.
    const Circle circle(lines[2], start);
    const Roots last = relation == AxesRelation::meet ? circle.at_distance_of(goal, p1, slack, preferred[2])
                                                      : circle.at_height_of(goal, f1, slack, preferred[2]);
    LoopAngles loop{.doubtful = last.doubtful};
    for (size_t i = 0; i < last.count; ++i) {
        const Vec3 x = circle.at(last.angles[i]);
        const PairAngles pair = pair_angles(lines[0], lines[1], relation, x, goal, slack, {preferred[0], preferred[1]});
        loop.doubtful = loop.doubtful || pair.doubtful;
        for (size_t k = 0; k < pair.count; ++k) { loop.add({pair.angles[k][0], pair.angles[k][1], last.angles[i]}); }
    }
    return loop;
}

// The factors of one cosine or sine, or the right-hand sides, of the equations of the turn and of the height.
struct Column {
    double turn;
    double height;
};

// E_1 E_2 E_3 turns the direction u into h and keeps the heights along them.
//
// Without the angle of the joint in the middle, these are f2 . (E_3 u) = f2 . (E_1^-1 h) and
// h . (E_1 p2) = u . (E_3^-1 p2) + offset.
//
// p2 must be the point in which f2 meets its neighbour. The offset is h . (X x) - u . x, which is the same for all x. Of the
// axes, `pair_first` and the next one are related.
LoopAngles plane_angles(const std::array<Line, 3>& lines, Vec3 h, Vec3 u, double offset, AxesRelation relation, size_t pair_first,
                        double slack, const Triple& preferred) {
    const auto& [f1, p1] = lines[0];
    const auto& [f2, p2] = lines[1];
    const auto& [f3, p3] = lines[2];
    const Vec3 r1 = p2 - p1;
    const Vec3 r3 = p2 - p3;
    // Of angle 1 and of angle 3.
    const Column cos[2] = {{-dot(f2, across(f1, h)), dot(h, across(f1, r1))}, {dot(f2, across(f3, u)), -dot(u, across(f3, r3))}};
    const Column sin[2] = {{dot(f2, cross(f1, h)), dot(h, cross(f1, r1))}, {dot(f2, cross(f3, u)), dot(u, cross(f3, r3))}};
    const Column rest = {dot(f2, f1) * dot(f1, h) - dot(f2, f3) * dot(f3, u),
                         offset + dot(u, p3) - dot(h, p1) + dot(u, f3) * dot(f3, r3) - dot(h, f1) * dot(f1, r1)};
    // One of the equations holds only one angle, and `remaining` gives the other.
    double Column::* const decisive = relation == AxesRelation::meet ? &Column::height : &Column::turn;
    double Column::* const remaining = relation == AxesRelation::meet ? &Column::turn : &Column::height;
    const size_t one = pair_first == 0 ? 1 : 0;  // that angle: 0 is angle 1, and 1 is angle 3
    const size_t other = 1 - one;
    const Roots found = linear_roots(cos[one].*decisive, sin[one].*decisive, rest.*decisive, slack, preferred[2 * one]);
    LoopAngles loop;
    loop.doubtful = found.doubtful;
    for (size_t i = 0; i < found.count; ++i) {
        const auto [c, s] = Turn(found.angles[i]);
        const double left = rest.*remaining - cos[one].*remaining * c - sin[one].*remaining * s;
        const Roots others = linear_roots(cos[other].*remaining, sin[other].*remaining, left, slack, preferred[2 * other]);
        loop.doubtful = loop.doubtful || others.doubtful;
        for (size_t k = 0; k < others.count; ++k) {
            const double angle1 = other == 0 ? others.angles[k] : found.angles[i];
            const double angle3 = other == 0 ? found.angles[i] : others.angles[k];
            const Angle angle2 = angle_between(f2, turned(f3, Turn(angle3), u), turned(f1, Turn(-angle1), h), preferred[1]);
            loop.doubtful = loop.doubtful || angle2.undetermined;
            loop.add({angle1, angle2.value, angle3});
        }
    }
    return loop;
}

// The special joints, from their motion E_a E_b E_c.
SpecialAngles special_angles(std::span<const Line, 3> lines, AxesRelation relation, const Pose& moved, const Triple& preferred,
                             double slack) {
    const auto& [a, b, c] = std::array{lines[0], lines[1], lines[2]};
    const bool do_meet = relation == AxesRelation::meet;
    // E_c leaves a point of its axis where it is, and turns a direction across its axis.
    const Vec3 x = do_meet ? c.point + c.axis : c.point;
    const Vec3 u = do_meet ? b.axis : b.point - a.point;
    const Vec3 moved_u = moved.rotation * u;
    const Angle sum = do_meet ? Angle{} : angle_between(a.axis, u, moved_u, 0.0);  // of the angles about parallel axes
    const PairAngles pair = pair_angles(a, b, relation, x, moved * x, slack, {preferred[0], preferred[1]});
    SpecialAngles special{.doubtful = sum.undetermined || pair.doubtful};
    for (size_t k = 0; k < pair.count; ++k) {
        const auto [first, middle] = pair.angles[k];
        double last = dot(a.axis, c.axis) * (sum.value - first - dot(a.axis, b.axis) * middle);
        if (do_meet) {
            const Vec3 back = turned(b.axis, Turn(-middle), turned(a.axis, Turn(-first), moved_u));
            // Where the last angle is undetermined, the middle one is doubtful already.
            last = angle_between(c.axis, u, back, preferred[2]).value;
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
    SixAngles solve(const Pose& X, const std::array<double, 6>& preferred, double slack) const;

private:
    LoopAngles loop_angles(const Pose& X, const std::array<Line, 3>& loop, const Triple& preferred, double slack) const;
};

// The angles of the three joints that are not special.
LoopAngles SixHinges::loop_angles(const Pose& X, const std::array<Line, 3>& loop, const Triple& preferred, double slack) const {
    const AxesRelation relation = special.pair_relation;
    const auto [axis, point] = lines[first];
    if (special.relation == AxesRelation::parallel) {
        const double offset = dot(axis, X.translation);
        return plane_angles(loop, axis, X.rotation.inverse_times(axis), offset, relation, special.pair_first, slack, preferred);
    }
    const Vec3 start = X.rotation.inverse_times(point - X.translation);
    if (special.pair_first == 0) { return point_angles(loop, start, point, relation, slack, preferred); }
    // The last two are the pair: the chain is gone through backwards.
    const auto reversed = [&loop](size_t k) { return Line{-1.0 * loop[k].axis, loop[k].point}; };
    const Triple preferred_back{preferred[2], preferred[1], preferred[0]};
    LoopAngles found = point_angles({reversed(2), reversed(1), reversed(0)}, point, start, relation, slack, preferred_back);
    for (Triple& angles : found.angles) { std::swap(angles[0], angles[2]); }
    return found;
}

SixAngles SixHinges::solve(const Pose& X, const std::array<double, 6>& preferred, double slack) const {
    // The joints that are not special, in the order of the loop: those at its front are moved to its end.
    std::array<size_t, 3> others{};
    std::array<Line, 3> loop;
    for (size_t k = 0; k < 3; ++k) {
        others[k] = (first + 3 + k) % 6;
        loop[k] = first + 3 + k < 6 ? lines[others[k]] : seen_from(X, lines[others[k]]);
    }
    const std::span<const Line, 3> axes(&lines[first], 3);
    const Triple preferred_special{preferred[first], preferred[first + 1], preferred[first + 2]};
    const LoopAngles three = loop_angles(X, loop, {preferred[others[0]], preferred[others[1]], preferred[others[2]]}, slack);
    SixAngles six{.doubtful = three.doubtful};
    for (size_t i = 0; i < three.count; ++i) {
        const auto [f, g, h] = three.angles[i];
        // E_a E_b E_c of the special joints, which is X (E_f E_g E_h)^-1.
        const Pose special_motion = over(X, motion(loop[0], f) * motion(loop[1], g) * motion(loop[2], h));
        const SpecialAngles found = special_angles(axes, special.relation, special_motion, preferred_special, slack);
        six.doubtful = six.doubtful || found.doubtful;
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
    Seeds found;
    for (const double angle : sweep.positions) {
        if (found.samples >= sweep.least && found.count >= sweep.wanted) { break; }
        const SixHinges six = with_held(*chain_->special_axes(), zero_, angle);
        const SixAngles solved = six.solve(over(goal, six.tip), preferred, slack);
        found.doubtful = found.doubtful || solved.doubtful;
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
