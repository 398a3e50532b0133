// The closed form of six hinges of which three in a row meet in a point or are parallel.
//
// E_k are the joints' motions about their axes in the zero configuration, and X is the target's pose times the inverse of the
// tip's pose in the zero configuration: E_1 E_2 ... E_6 = X. This loop may begin at any joint: an axis moved from its front to
// its end is transformed by the inverse of X. So the three special joints (a, b, c) can be anywhere, and with the other three
// (f, g, h) in the order of the loop
//
//     (E_a E_b E_c)^-1 = E_f E_g E_h X^-1.
//
// If the axes a, b, c meet in a point, both sides leave this point where it is; if they are parallel, both sides leave their
// direction and the heights along it as they are. These are three equations for the other three joints, which have two to four
// solutions. Then E_a E_b E_c is known, and each time two configurations of the special joints remain. The first three
// equations are a quadratic equation after another if two neighbours of f, g, h meet or are parallel, otherwise a quartic one.
//
// Sources: Pieper, "The kinematics of manipulators under computer control", 1968; Elias and Wen, "IK-Geo: unified robot inverse
// kinematics using subproblem decomposition", Mech. Mach. Theory 209, 2025, whose subproblems 1 to 6 are used here.
//
// Seven hinges are swept: one of them is held at sampled positions, and the other six have a closed form.
#pragma once
#include <array>
#include <cstddef>
#include <optional>
#include <vector>

#include "chain.hpp"
#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

// A line in space: the axis of a hinge.
struct Line {
    Vec3 axis;
    Vec3 point;
};

// How the axes of six hinges are related.
struct AxesStructure {
    AxesRelation relation;       // of the three special axes: they meet or are parallel
    size_t first;                // of these three, among the six
    AxesRelation pair_relation;  // of two neighbours among the other three
    size_t pair_first;           // 0 if these are the first two of the three, 1 if the last two
};

struct Hinge {
    Line line;
    Bounds bounds;
};

// Six or seven hinges in the zero configuration, lengths in reaches.
struct HingeChain {
    std::vector<Hinge> hinges;  // where special axes meet, their point is the common one
    Pose tip;
    double reach;  // m
    AxesStructure structure;
    std::optional<size_t> held;  // the joint that is swept, of seven
};

inline constexpr size_t MAX_CONFIGURATIONS = 16;  // of six joints: eight of the first three, and two for each of them

// How many positions of the swept joint to sample.
struct Samples {
    std::int64_t least;
    std::int64_t most;
    std::int64_t wanted;  // configurations, after which the sweep ends
};

struct Seeds {
    std::int64_t count = 0;  // rows that are filled
    std::int64_t samples = 0;
    bool doubtful = false;  // whether the number of solutions is doubtful
};

// Immutable after its construction: threads share it.
class ClosedForm {
public:
    // Throws InputError if the numbers of the joints do not fit.
    explicit ClosedForm(HingeChain chain);

    size_t n() const { return chain_.hinges.size(); }

    // Fills `seeds` (M, n) with the configurations inside the bounds, up to `margin`, for a target in m.
    //
    // Six joints are solved once. Of seven joints one is held at q0 first and then at sampled positions.
    Seeds find(const Pose& target, Vector q0, double slack, double margin, const Samples& samples, MatrixResult seeds) const;

private:
    bool store(const std::array<double, 6>& angles, double held_angle, Vector q0, double margin, Result seed) const;

    HingeChain chain_;
};

}  // namespace armctl
