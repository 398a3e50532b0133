#include "closed_form.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include "errors.hpp"
#include "trigonometric_roots.hpp"

namespace armctl {

namespace {

constexpr double PI = std::numbers::pi;

using Triple = std::array<double, 3>;

// Configurations of some joints, and whether their number is doubtful.
template <size_t JOINTS, size_t CAPACITY>
struct Configurations {
    std::array<std::array<double, JOINTS>, CAPACITY> angles{};
    size_t count = 0;
    bool doubtful = false;

    void add(const std::array<double, JOINTS>& configuration) {
        angles[count] = configuration;
        ++count;
    }
};

using LoopAngles = Configurations<3, 8>;     // of the three joints that are found first, in the order of the loop
using SpecialAngles = Configurations<3, 2>;  // of the three special joints
using SixAngles = Configurations<6, MAX_CONFIGURATIONS>;

// Six hinges in the zero configuration.
struct SixHinges {
    std::array<Line, 6> lines;
    AxesStructure structure;
    Pose tip;

    // All angles with E_1 ... E_6 = X. Where all angles of a joint are solutions, it is the preferred one.
    SixAngles solve(const Pose& X, const std::array<double, 6>& preferred, double slack) const;
};

// The part of a vector across an axis.
Vec3 across(Vec3 axis, Vec3 a) { return a - dot(axis, a) * axis; }

// A vector turned about an axis by an angle with this cosine and sine (Rodrigues).
Vec3 turned(Vec3 axis, double cos, double sin, Vec3 a) {
    const double along = (1.0 - cos) * dot(axis, a);
    return along * axis + cos * a + sin * cross(axis, a);
}

// A point turned about a line.
Vec3 moved(const Line& line, double cos, double sin, Vec3 a) { return line.point + turned(line.axis, cos, sin, a - line.point); }

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

// The foot points, on both lines, of the common normal of two lines that are neither parallel nor meet.
std::array<Vec3, 2> common_normal(const Line& a, const Line& b) {
    const Vec3 normal = cross(a.axis, b.axis);
    const double square = dot(normal, normal);
    const Vec3 between = b.point - a.point;
    return {a.point + (dot(cross(between, b.axis), normal) / square) * a.axis,
            b.point + (dot(cross(between, a.axis), normal) / square) * b.axis};
}

// E_1 E_2 E_3 start = goal, for three lines of which the first two are related.
struct PointEquation {
    std::array<Line, 3> lines;
    Vec3 start;
    Vec3 goal;
    AxesRelation relation;
    double slack;
    Triple preferred;

    LoopAngles solve() const;

private:
    Roots last_angles(Vec3 centre, Vec3 u, Vec3 v) const;
    Roots middle_angles(Vec3 x) const;
};

// Angle 3, where axes 2 and 1 can turn the point to the goal. Axis 3 moves the point on a circle: centre + u cos t + v sin t.
Roots PointEquation::last_angles(Vec3 centre, Vec3 u, Vec3 v) const {
    const auto& [f1, p1] = lines[0];
    const auto& [f2, p2] = lines[1];
    const Vec3 to_goal = goal - p1;
    if (relation == AxesRelation::meet) {
        const Vec3 out = centre - p1;
        const double square = 0.5 * (dot(to_goal, to_goal) - dot(out, out) - dot(u, u));
        return linear_roots(dot(out, u), dot(out, v), square, slack, preferred[2]);
    }
    if (relation == AxesRelation::parallel) {
        const double height = dot(f1, goal) - dot(f1, centre);
        return linear_roots(dot(f1, u), dot(f1, v), height, slack, preferred[2]);
    }
    // With the common normal w from p1 to p2, the goal's height along axis 1 and its distance determine the part of the point
    // across axis 2. Its length is known, too.
    const Vec3 w = p2 - p1;
    const Vec3 side = across(f2, f1);
    const Vec3 out = centre - p2;
    const double cos = dot(f1, f2);
    const Vec3 along{dot(f2, out), dot(f2, u), dot(f2, v)};
    const Vec3 square{dot(out, out) + dot(u, u), 2.0 * dot(out, u), 2.0 * dot(out, v)};
    const double rest = dot(to_goal, to_goal) - dot(w, w);
    TrigonometricForm form{.constant = -square.x, .cos = -square.y, .sin = -square.z};
    const double height = dot(f1, to_goal) - cos * along.x;
    form.add_square(height, -cos * along.y, -cos * along.z, 1.0 / dot(side, side));
    form.add_square(0.5 * (rest - square.x), -0.5 * square.y, -0.5 * square.z, 1.0 / dot(w, w));
    form.add_square(along.x, along.y, along.z, 1.0);
    return trigonometric_roots(form, slack);
}

// Angle 2, which turns the point x to where axis 1 can turn it to the goal.
Roots PointEquation::middle_angles(Vec3 x) const {
    const auto& [f1, p1] = lines[0];
    const auto& [f2, p2] = lines[1];
    const Vec3 to_goal = goal - p1;
    const Vec3 r = x - p2;
    if (relation == AxesRelation::meet) {
        const double height = dot(f1, to_goal) - dot(f1, f2) * dot(f2, r);
        return linear_roots(dot(f1, across(f2, r)), dot(f1, cross(f2, r)), height, slack, preferred[1]);
    }
    if (relation == AxesRelation::parallel) {
        const Vec3 w = across(f1, p2 - p1);
        const Vec3 arm = across(f1, r);
        const Vec3 end = across(f1, to_goal);
        const double square = 0.5 * (dot(end, end) - dot(w, w) - dot(arm, arm));
        return linear_roots(dot(w, arm), dot(w, cross(f2, arm)), square, slack, preferred[1]);
    }
    const Vec3 w = p2 - p1;
    const Vec3 side = across(f2, f1);
    const double height = dot(f1, to_goal) - dot(f1, f2) * dot(f2, r);
    const double square = 0.5 * (dot(to_goal, to_goal) - dot(w, w) - dot(r, r));
    const Vec3 end = (height / dot(side, side)) * side + (square / dot(w, w)) * w;
    const Angle angle = angle_between(f2, r, end, preferred[1]);
    return {.angles = {angle.value}, .count = 1, .doubtful = angle.undetermined};
}

LoopAngles PointEquation::solve() const {
    const Line& third = lines[2];
    const Vec3 centre = third.point + dot(third.axis, start - third.point) * third.axis;
    const Vec3 u = start - centre;
    const Vec3 v = cross(third.axis, u);
    PointEquation equation = *this;
    if (relation == AxesRelation::neither) {
        const auto [foot1, foot2] = common_normal(lines[0], lines[1]);
        equation.lines[0].point = foot1;
        equation.lines[1].point = foot2;
    }
    const Line& first = equation.lines[0];
    const Line& second = equation.lines[1];
    const Roots last = equation.last_angles(centre, u, v);
    LoopAngles loop;
    loop.doubtful = last.doubtful;
    for (size_t i = 0; i < last.count; ++i) {
        const Vec3 x = centre + (std::cos(last.angles[i]) * u + std::sin(last.angles[i]) * v);
        const Roots middle = equation.middle_angles(x);
        loop.doubtful = loop.doubtful || middle.doubtful;
        for (size_t k = 0; k < middle.count; ++k) {
            const Vec3 y = moved(second, std::cos(middle.angles[k]), std::sin(middle.angles[k]), x);
            const Angle angle = angle_between(first.axis, y - first.point, goal - first.point, preferred[0]);
            loop.doubtful = loop.doubtful || angle.undetermined;
            loop.add({angle.value, middle.angles[k], last.angles[i]});
        }
    }
    return loop;
}

// The factors of one cosine or sine, or the right-hand sides, of the equations of the turn and of the height.
struct Column {
    double turn;
    double height;
};

double determinant(Column a, Column b) { return a.turn * b.height - b.turn * a.height; }

// E_1 E_2 E_3 turns the direction u into h and keeps the heights along them.
//
// Without the angle of the joint in the middle, these are f2 . (E_3 u) = f2 . (E_1^-1 h) and
// h . (E_1 p2) = u . (E_3^-1 p2) + offset.
struct PlaneEquation {
    std::array<Line, 3> lines;  // p2 must be the point in which f2 meets its neighbour
    Vec3 h;
    Vec3 u;
    double offset;          // h . (X x) is u . x + offset for all x
    AxesRelation relation;  // of two neighbours
    size_t pair_first;      // of them
    double slack;
    Triple preferred;

    LoopAngles solve() const;

private:
    struct Columns {
        std::array<Column, 2> cos;  // of angle 1 and of angle 3
        std::array<Column, 2> sin;
        Column rest;
    };

    Columns columns() const;
};

PlaneEquation::Columns PlaneEquation::columns() const {
    const auto& [f1, p1] = lines[0];
    const auto& [f2, p2] = lines[1];
    const auto& [f3, p3] = lines[2];
    const Vec3 r1 = p2 - p1;
    const Vec3 r3 = p2 - p3;
    return {
        .cos = {Column{-dot(f2, across(f1, h)), dot(h, across(f1, r1))}, Column{dot(f2, across(f3, u)), -dot(u, across(f3, r3))}},
        .sin = {Column{dot(f2, cross(f1, h)), dot(h, cross(f1, r1))}, Column{dot(f2, cross(f3, u)), dot(u, cross(f3, r3))}},
        .rest = {dot(f2, f1) * dot(f1, h) - dot(f2, f3) * dot(f3, u),
                 offset + dot(u, p3) - dot(h, p1) + dot(u, f3) * dot(f3, r3) - dot(h, f1) * dot(f1, r1)},
    };
}

LoopAngles PlaneEquation::solve() const {
    const auto [cos, sin, rest] = columns();
    const bool is_quartic = relation == AxesRelation::neither;
    // If two axes meet or are parallel, this equation holds only one angle, and `remaining` gives the other.
    double Column::* const decisive = relation == AxesRelation::meet ? &Column::height : &Column::turn;
    double Column::* const remaining = relation == AxesRelation::meet ? &Column::turn : &Column::height;
    size_t one = pair_first == 0 ? 1 : 0;  // the angle that is found first: 0 is angle 1, and 1 is angle 3
    double det = 1.0;
    LoopAngles loop;
    Roots found;
    if (is_quartic) {
        one = std::abs(determinant(cos[0], sin[0])) >= std::abs(determinant(cos[1], sin[1])) ? 1 : 0;
        const size_t other = 1 - one;
        det = determinant(cos[other], sin[other]);
        if (std::abs(det) < TINY) {
            loop.doubtful = true;
            return loop;
        }
        TrigonometricForm form{.constant = -det * det};
        for (const Column& column : {cos[other], sin[other]}) {
            // det times the sine, and det times the cosine of the other angle (Cramer).
            form.add_square(determinant(column, rest), -determinant(column, cos[one]), -determinant(column, sin[one]), 1.0);
        }
        found = trigonometric_roots(form, slack);
    } else {
        found = linear_roots(cos[one].*decisive, sin[one].*decisive, rest.*decisive, slack, preferred[2 * one]);
    }
    const size_t other = 1 - one;
    loop.doubtful = found.doubtful;
    for (size_t i = 0; i < found.count; ++i) {
        const double c = std::cos(found.angles[i]);
        const double s = std::sin(found.angles[i]);
        const Column left{rest.turn - cos[one].turn * c - sin[one].turn * s, rest.height - cos[one].height * c - sin[one].height * s};
        Roots others;
        if (is_quartic) {
            others.angles[0] =
                std::atan2(determinant(cos[other], left) / det, (left.turn * sin[other].height - left.height * sin[other].turn) / det);
            others.count = 1;
        } else {
            others = linear_roots(cos[other].*remaining, sin[other].*remaining, left.*remaining, slack, preferred[2 * other]);
            loop.doubtful = loop.doubtful || others.doubtful;
        }
        for (size_t k = 0; k < others.count; ++k) {
            const double angle1 = other == 0 ? others.angles[k] : found.angles[i];
            const double angle3 = other == 0 ? found.angles[i] : others.angles[k];
            const Vec3 before = turned(lines[2].axis, std::cos(angle3), std::sin(angle3), u);
            const Vec3 after = turned(lines[0].axis, std::cos(angle1), -std::sin(angle1), h);
            const Angle angle2 = angle_between(lines[1].axis, before, after, preferred[1]);
            loop.doubtful = loop.doubtful || angle2.undetermined;
            loop.add({angle1, angle2.value, angle3});
        }
    }
    return loop;
}

// E_a E_b E_c of the special joints, which is X (E_f E_g E_h)^-1.
class SpecialMotion {
public:
    SpecialMotion(const Pose& X, const std::array<Line, 3>& loop, const Triple& angles) : X_(X), loop_(loop) {
        for (size_t k = 0; k < angles.size(); ++k) {
            cos_[k] = std::cos(angles[k]);
            sin_[k] = std::sin(angles[k]);
        }
    }

    Vec3 of_vector(Vec3 a) const {
        for (size_t k = 0; k < loop_.size(); ++k) { a = turned(loop_[k].axis, cos_[k], -sin_[k], a); }
        return X_.rotation * a;
    }

    Vec3 of_point(Vec3 a) const {
        for (size_t k = 0; k < loop_.size(); ++k) { a = moved(loop_[k], cos_[k], -sin_[k], a); }
        return X_.rotation * a + X_.translation;
    }

private:
    Pose X_;
    std::array<Line, 3> loop_;
    Triple cos_{};
    Triple sin_{};
};

SpecialAngles meeting_angles(std::span<const Line, 3> lines, const SpecialMotion& motion, const Triple& preferred, double slack) {
    const Vec3 a = lines[0].axis;
    const Vec3 b = lines[1].axis;
    const Vec3 c = lines[2].axis;
    const Vec3 moved_b = motion.of_vector(b);
    const Vec3 moved_c = motion.of_vector(c);
    const double height = dot(a, moved_c) - dot(a, b) * dot(b, c);
    const Roots middle = linear_roots(dot(a, across(b, c)), dot(a, cross(b, c)), height, slack, preferred[1]);
    SpecialAngles special{.doubtful = middle.doubtful};
    for (size_t k = 0; k < middle.count; ++k) {
        const double cos = std::cos(middle.angles[k]);
        const double sin = std::sin(middle.angles[k]);
        const Angle first = angle_between(a, turned(b, cos, sin, c), moved_c, preferred[0]);
        special.doubtful = special.doubtful || first.undetermined;
        const Vec3 back = turned(b, cos, -sin, turned(a, std::cos(first.value), -std::sin(first.value), moved_b));
        // Where the third angle is undetermined, the middle one is doubtful already.
        const Angle last = angle_between(c, b, back, preferred[2]);
        special.add({first.value, middle.angles[k], last.value});
    }
    return special;
}

SpecialAngles parallel_angles(std::span<const Line, 3> lines, const SpecialMotion& motion, const Triple& preferred, double slack) {
    const Vec3 a = lines[0].axis;
    const Vec3 b = lines[1].axis;
    const Vec3 w = across(a, lines[1].point - lines[0].point);
    const Vec3 r = across(a, lines[2].point - lines[1].point);
    const Vec3 to_c = across(a, motion.of_point(lines[2].point) - lines[0].point);
    const Angle whole = angle_between(a, w, motion.of_vector(w), 0.0);
    const double square = 0.5 * (dot(to_c, to_c) - dot(w, w) - dot(r, r));
    const Roots middle = linear_roots(dot(w, r), dot(w, cross(b, r)), square, slack, preferred[1]);
    SpecialAngles special{.doubtful = whole.undetermined || middle.doubtful};
    for (size_t k = 0; k < middle.count; ++k) {
        const double angle = middle.angles[k];
        const Vec3 arm = w + turned(b, std::cos(angle), std::sin(angle), r);
        const Angle first = angle_between(a, arm, to_c, preferred[0]);
        special.doubtful = special.doubtful || first.undetermined;
        special.add({first.value, angle, dot(a, lines[2].axis) * (whole.value - first.value - dot(a, b) * angle)});
    }
    return special;
}

// The axes of the three joints that are not special, in the order of the loop: those at its front are moved to its end.
std::array<Line, 3> loop_lines(const SixHinges& hinges, const Pose& X) {
    std::array<Line, 3> lines;
    for (size_t k = 0; k < lines.size(); ++k) {
        const size_t joint = hinges.structure.first + 3 + k;
        lines[k] = hinges.lines[joint % 6];
        if (joint >= 6) { lines[k] = {X.rotation.inverse_times(lines[k].axis), X.rotation.inverse_times(lines[k].point - X.translation)}; }
    }
    return lines;
}

// The angles of these three joints.
LoopAngles first_three(const SixHinges& hinges, const Pose& X, const std::array<Line, 3>& loop, const Triple& preferred, double slack) {
    const Line& special = hinges.lines[hinges.structure.first];
    if (hinges.structure.relation == AxesRelation::parallel) {
        return PlaneEquation{
            .lines = loop,
            .h = special.axis,
            .u = X.rotation.inverse_times(special.axis),
            .offset = dot(special.axis, X.translation),
            .relation = hinges.structure.pair_relation,
            .pair_first = hinges.structure.pair_first,
            .slack = slack,
            .preferred = preferred,
        }
            .solve();
    }
    const Vec3 goal = special.point;
    const Vec3 start = X.rotation.inverse_times(goal - X.translation);
    if (hinges.structure.pair_relation == AxesRelation::neither || hinges.structure.pair_first == 0) {
        return PointEquation{loop, start, goal, hinges.structure.pair_relation, slack, preferred}.solve();
    }
    // The last two are the pair: the chain is gone through backwards.
    const std::array<Line, 3> back{Line{-1.0 * loop[2].axis, loop[2].point}, Line{-1.0 * loop[1].axis, loop[1].point},
                                   Line{-1.0 * loop[0].axis, loop[0].point}};
    const Triple preferred_back{preferred[2], preferred[1], preferred[0]};
    LoopAngles angles = PointEquation{back, goal, start, hinges.structure.pair_relation, slack, preferred_back}.solve();
    for (Triple& triple : angles.angles) { std::swap(triple[0], triple[2]); }
    return angles;
}

// An angle turned by whole turns to the position nearest to `near` inside the bounds, if there is one.
double wound(double angle, double near, double low, double high) {
    constexpr double TURN = 2.0 * PI;
    angle += TURN * std::nearbyint((near - angle) / TURN);
    if (angle > high) { angle -= TURN * std::ceil((angle - high) / TURN); }
    if (angle < low) { angle += TURN * std::ceil((low - angle) / TURN); }
    return angle;
}

// The k-th number of the sequence in base 2, in (0, 1): any beginning of it is spread evenly.
double van_der_corput(std::int64_t k) {
    double value = 0.0;
    for (double digit = 0.5; k > 0; digit *= 0.5) {
        value += digit * static_cast<double>(k % 2);
        k /= 2;
    }
    return value;
}

SixAngles SixHinges::solve(const Pose& X, const std::array<double, 6>& preferred, double slack) const {
    const size_t first = structure.first;
    const std::array<Line, 3> loop = loop_lines(*this, X);
    const std::span<const Line, 3> special_lines(&lines[first], 3);
    const Triple preferred_special{preferred[first], preferred[first + 1], preferred[first + 2]};
    const Triple preferred_loop{preferred[(first + 3) % 6], preferred[(first + 4) % 6], preferred[(first + 5) % 6]};
    const LoopAngles three = first_three(*this, X, loop, preferred_loop, slack);
    SixAngles six{.doubtful = three.doubtful};
    for (size_t i = 0; i < three.count; ++i) {
        const SpecialMotion motion(X, loop, three.angles[i]);
        const SpecialAngles special = structure.relation == AxesRelation::meet
                                          ? meeting_angles(special_lines, motion, preferred_special, slack)
                                          : parallel_angles(special_lines, motion, preferred_special, slack);
        six.doubtful = six.doubtful || special.doubtful;
        for (size_t k = 0; k < special.count; ++k) {
            std::array<double, 6> angles{};
            for (size_t j = 0; j < 3; ++j) {
                angles[first + j] = special.angles[k][j];
                angles[(first + 3 + j) % 6] = three.angles[i][j];
            }
            six.add(angles);
        }
    }
    return six;
}

// The six other joints with one held at an angle, and the tip, in their zero configuration.
SixHinges with_held(const HingeChain& chain, double angle) {
    SixHinges six{.lines = {}, .structure = chain.structure, .tip = chain.tip};
    if (!chain.held) {
        for (size_t k = 0; k < six.lines.size(); ++k) { six.lines[k] = chain.hinges[k].line; }
        return six;
    }
    const double cos = std::cos(angle);
    const double sin = std::sin(angle);
    const Line& held = chain.hinges[*chain.held].line;
    for (size_t k = 0; k < six.lines.size(); ++k) {
        if (k < *chain.held) {
            six.lines[k] = chain.hinges[k].line;
        } else {
            const Line& line = chain.hinges[k + 1].line;
            six.lines[k] = {turned(held.axis, cos, sin, line.axis), moved(held, cos, sin, line.point)};
        }
    }
    const Rotation& tip = chain.tip.rotation;
    six.tip.rotation = {turned(held.axis, cos, sin, tip.x), turned(held.axis, cos, sin, tip.y), turned(held.axis, cos, sin, tip.z)};
    six.tip.translation = moved(held, cos, sin, chain.tip.translation);
    return six;
}

// A sampled position of the joint that is swept: q0 first, then inside its bounds, or inside one turn if they are wider.
double swept_angle(Bounds bounds, double q0, std::int64_t sample) {
    if (sample == 0) { return q0; }
    double low = bounds.low;
    double span = bounds.high - bounds.low;
    if (!(span <= 2.0 * PI)) {  // also if the joint has no bounds
        low = std::max(low, std::min(q0 - PI, bounds.high - 2.0 * PI));
        span = 2.0 * PI;
    }
    return low + span * van_der_corput(sample);
}

}  // namespace

ClosedForm::ClosedForm(HingeChain chain) : chain_(std::move(chain)) {
    if (n() != (chain_.held ? 7u : 6u) || (chain_.held && *chain_.held >= n()) || chain_.structure.first > 3) {
        throw InputError("axes: expected six hinges, or seven with one that is held, and the first of three in a row of the six");
    }
}

// Writes a configuration with the hinges turned inside their bounds; returns whether it is inside.
bool ClosedForm::store(const std::array<double, 6>& angles, double held_angle, Vector q0, double margin, Result seed) const {
    bool inside = true;
    size_t row = 0;
    for (size_t k = 0; k < n(); ++k) {
        if (chain_.held == k) {
            seed[k] = held_angle;
            continue;
        }
        const double low = chain_.hinges[k].bounds.low - margin;
        const double high = chain_.hinges[k].bounds.high + margin;
        seed[k] = wound(angles[row], q0[k], low, high);
        inside = inside && seed[k] >= low && seed[k] <= high;
        ++row;
    }
    return inside;
}

Seeds ClosedForm::find(const Pose& target, Vector q0, double slack, double margin, const Samples& samples, MatrixResult seeds) const {
    std::array<double, 6> preferred{};
    for (size_t k = 0; k < preferred.size(); ++k) { preferred[k] = q0[chain_.held && k >= *chain_.held ? k + 1 : k]; }
    const Vec3 p = target.translation;
    const Vec3 goal{p.x / chain_.reach, p.y / chain_.reach, p.z / chain_.reach};
    const std::int64_t most = chain_.held ? samples.most : 1;
    Seeds found;
    while (found.samples < most && (found.samples < samples.least || found.count < samples.wanted)) {
        double angle = 0.0;
        if (chain_.held) {
            const Bounds& bounds = chain_.hinges[*chain_.held].bounds;
            angle = swept_angle(bounds, q0[*chain_.held], found.samples);
        }
        const SixHinges six = with_held(chain_, angle);
        Pose X;  // the target's pose times the inverse of the tip's
        X.rotation = {target.rotation * six.tip.rotation.row_x(), target.rotation * six.tip.rotation.row_y(),
                      target.rotation * six.tip.rotation.row_z()};
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
