#include "closed_form.hpp"

#include <numbers>
#include <utility>

#include "errors.hpp"

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
    if (radius < TINY) { return {.angles = {preferred, preferred}, .count = std::abs(d) <= TINY + slack ? 1u : 0u, .doubtful = true}; }
    const double cos = d / radius;
    const double middle = std::atan2(b, a);
    const bool doubtful = std::abs(cos) > 1.0 - NEAR_DOUBLE_ROOT && std::abs(cos) <= 1.0 + std::max(slack, NEAR_DOUBLE_ROOT);
    if (std::abs(cos) > 1.0) {
        if (std::abs(cos) > 1.0 + slack) { return {.angles = {middle, middle}, .count = 0, .doubtful = doubtful}; }
        const double angle = cos > 0 ? middle : middle + std::numbers::pi;
        return {.angles = {angle, angle}, .count = 1, .doubtful = true};
    }
    const double half = std::acos(cos);
    return {.angles = {middle + half, middle - half}, .count = 2, .doubtful = doubtful};
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

// A line as another frame sees it.
Line seen_from(const Pose& X, const Line& line) {
    return {X.rotation.inverse_times(line.axis), X.rotation.inverse_times(line.point - X.translation)};
}

// The angle about an axis from a to b; it is undetermined if one of them is on the axis.
struct Angle {
    double value;
    bool undetermined;
};

Angle angle_between(Vec3 axis, Vec3 a, Vec3 b, double preferred) {
    const Vec3 u = across(axis, a);
    const Vec3 v = across(axis, b);
    if (std::min(dot(u, u), dot(v, v)) < TINY * TINY) { return {preferred, true}; }
    return {std::atan2(dot(axis, cross(u, v)), dot(u, v)), false};
}

// E_1 E_2 x = goal, for two lines that meet or are parallel. Where all angles are solutions, they are the preferred ones.
PairAngles pair_angles(const Line& first, const Line& second, AxesRelation relation, Vec3 x, Vec3 goal, double slack,
                       std::array<double, 2> preferred) {
    const auto& [f1, p1] = first;
    const auto& [f2, p2] = second;
    const bool is_parallel = relation == AxesRelation::parallel;
    // Where the axes are parallel, the heights along them remain; where they meet, the distance from their point.
    const Vec3 r = is_parallel ? across(f1, x - p2) : x - p2;
    const Vec3 end = is_parallel ? across(f1, goal - p1) : goal - p1;
    const Vec3 w = across(f1, p2 - p1);
    Roots angles2;
    if (is_parallel) {
        const double square = 0.5 * (dot(end, end) - dot(w, w) - dot(r, r));
        angles2 = linear_roots(dot(w, r), dot(w, cross(f2, r)), square, slack, preferred[1]);
    } else {
        const double height = dot(f1, end) - dot(f1, f2) * dot(f2, r);
        angles2 = linear_roots(dot(f1, across(f2, r)), dot(f1, cross(f2, r)), height, slack, preferred[1]);
    }
    PairAngles pair{.doubtful = angles2.doubtful};
    for (size_t k = 0; k < angles2.count; ++k) {
        const Turn turn(angles2.angles[k]);
        const Vec3 arm = (is_parallel ? w : p2 - p1) + turned(f2, turn, r);
        const Angle angle1 = angle_between(f1, arm, end, preferred[0]);
        pair.doubtful = pair.doubtful || angle1.undetermined;
        pair.add({angle1.value, angles2.angles[k]});
    }
    return pair;
}

// E_1 E_2 E_3 start = goal, for three lines of which the first two are related.
LoopAngles point_angles(const std::array<Line, 3>& lines, Vec3 start, Vec3 goal, AxesRelation relation, double slack,
                        const Triple& preferred) {
    const auto& [f1, p1] = lines[0];
    const auto& [f3, p3] = lines[2];
    // Axis 3 moves the point on a circle, centre + u cos t + v sin t, to where axes 2 and 1 can turn it to the goal.
    const Vec3 centre = p3 + dot(f3, start - p3) * f3;
    const Vec3 u = start - centre;
    const Vec3 v = cross(f3, u);
    Roots last;
    if (relation == AxesRelation::meet) {
        const Vec3 to_goal = goal - p1;
        const Vec3 out = centre - p1;
        const double square = 0.5 * (dot(to_goal, to_goal) - dot(out, out) - dot(u, u));
        last = linear_roots(dot(out, u), dot(out, v), square, slack, preferred[2]);
    } else {
        const double height = dot(f1, goal) - dot(f1, centre);
        last = linear_roots(dot(f1, u), dot(f1, v), height, slack, preferred[2]);
    }
    LoopAngles loop{.doubtful = last.doubtful};
    for (size_t i = 0; i < last.count; ++i) {
        const Turn turn(last.angles[i]);
        const Vec3 x = centre + (turn.cos * u + turn.sin * v);
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

// The special joints whose axes meet, from where E_a E_b E_c brings the axes b and c.
SpecialAngles meeting_angles(std::span<const Line, 3> lines, Vec3 moved_b, Vec3 moved_c, const Triple& preferred, double slack) {
    const Line a{lines[0].axis, {}};
    const Line b{lines[1].axis, {}};
    const Vec3 c = lines[2].axis;
    const PairAngles pair = pair_angles(a, b, AxesRelation::meet, c, moved_c, slack, {preferred[0], preferred[1]});
    SpecialAngles special{.doubtful = pair.doubtful};
    for (size_t k = 0; k < pair.count; ++k) {
        const auto [first, middle] = pair.angles[k];
        const Vec3 back = turned(b.axis, Turn(-middle), turned(a.axis, Turn(-first), moved_b));
        // Where the third angle is undetermined, the middle one is doubtful already.
        special.add({first, middle, angle_between(c, b.axis, back, preferred[2]).value});
    }
    return special;
}

// The special joints whose axes are parallel, from where E_a E_b E_c brings the point of c and the direction w from a to b.
SpecialAngles parallel_angles(std::span<const Line, 3> lines, Vec3 moved_point, Vec3 w, Vec3 moved_w, const Triple& preferred,
                              double slack) {
    const Vec3 a = lines[0].axis;
    const Angle whole = angle_between(a, w, moved_w, 0.0);
    const PairAngles pair =
        pair_angles(lines[0], lines[1], AxesRelation::parallel, lines[2].point, moved_point, slack, {preferred[0], preferred[1]});
    SpecialAngles special{.doubtful = whole.undetermined || pair.doubtful};
    for (size_t k = 0; k < pair.count; ++k) {
        const auto [first, middle] = pair.angles[k];
        special.add({first, middle, dot(a, lines[2].axis) * (whole.value - first - dot(a, lines[1].axis) * middle)});
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
        const Pose fgh = motion(loop[0], f) * motion(loop[1], g) * motion(loop[2], h);
        // E_a E_b E_c of the special joints, which is X (E_f E_g E_h)^-1, applied to a direction and to a point.
        const auto directed = [&](Vec3 a) { return X.rotation * fgh.rotation.inverse_times(a); };
        const auto placed = [&](Vec3 a) { return X * fgh.rotation.inverse_times(a - fgh.translation); };
        SpecialAngles found;
        if (special.relation == AxesRelation::meet) {
            found = meeting_angles(axes, directed(axes[1].axis), directed(axes[2].axis), preferred_special, slack);
        } else {
            const Vec3 w = across(axes[0].axis, axes[1].point - axes[0].point);
            found = parallel_angles(axes, placed(axes[2].point), w, directed(w), preferred_special, slack);
        }
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

ClosedForm::ClosedForm(std::shared_ptr<const Chain> chain, const Arguments& arguments) : chain_(std::move(chain)) {
    if (arguments.has("held")) { zero_.held = arguments.count("held"); }
    const size_t n = zero_.held ? 7 : 6;
    if (!chain_->special_axes() || chain_->n() != n || zero_.held.value_or(0) >= n) {
        throw InputError("axes: expected special axes of six hinges, or of seven with one that is held");
    }
    const Matrix axes = arguments.matrix(n, 3, "axes");
    const Matrix points = arguments.matrix(n, 3, "points");
    for (size_t k = 0; k < n; ++k) { zero_.lines.push_back({vec3(axes.row(k)), vec3(points.row(k))}); }
    zero_.tip = {Rotation::from_rows(arguments.shaped({3, 3}, "tip_rotation")), vec3(arguments.vector(3, "tip_translation"))};
    checked_index(static_cast<std::int64_t>(with_held(*chain_->special_axes(), zero_, 0.0).first), 4, "first");
}

// Writes a configuration with the hinges turned inside their bounds; returns whether it is inside.
bool ClosedForm::store(const std::array<double, 6>& angles, double held_angle, Vector q0, double margin, Result seed) const {
    bool inside = true;
    size_t row = 0;
    for (size_t k = 0; k < seed.size(); ++k) {
        if (zero_.held == k) {
            seed[k] = held_angle;
            continue;
        }
        const Unknown& unknown = chain_->unknowns()[k];
        const Bounds bounds{unknown.bounds.low - margin, unknown.bounds.high + margin};
        seed[k] = wound(angles[row], q0[k], bounds, unknown.period);
        inside = inside && bounds.contain(seed[k]);
        ++row;
    }
    return inside;
}

Seeds ClosedForm::find(const Pose& target, Vector q0, double slack, double margin, const Sweep& sweep, MatrixResult seeds) const {
    std::array<double, 6> preferred{};
    for (size_t k = 0; k < preferred.size(); ++k) { preferred[k] = q0[zero_.held && k >= *zero_.held ? k + 1 : k]; }
    const Vec3 p = target.translation;
    const double reach = chain_->reach();
    const Vec3 goal{p.x / reach, p.y / reach, p.z / reach};
    Seeds found;
    for (const double angle : sweep.positions) {
        if (found.samples >= sweep.least && found.count >= sweep.wanted) { break; }
        const SixHinges six = with_held(*chain_->special_axes(), zero_, angle);
        const Rotation& tip = six.tip.rotation;
        Pose X;  // the target's pose times the inverse of the tip's
        X.rotation = {target.rotation * tip.row_x(), target.rotation * tip.row_y(), target.rotation * tip.row_z()};
        X.translation = goal - X.rotation * six.tip.translation;
        const SixAngles solved = six.solve(X, preferred, slack);
        found.doubtful = found.doubtful || solved.doubtful;
        ++found.samples;
        for (size_t i = 0; i < solved.count; ++i) {
            if (found.count == static_cast<std::int64_t>(seeds.rows)) { return found; }
            if (store(solved.angles[i], angle, q0, margin, seeds.row(static_cast<size_t>(found.count)))) { ++found.count; }
        }
    }
    return found;
}

}  // namespace armctl
