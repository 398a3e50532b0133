// The closed form of six hinges of which three in a row, and two neighbours of the others, meet in a point or are parallel.
//
// E_k are the joints' motions about their axes in the zero configuration, and X is the target's pose times the inverse of the
// tip's pose in the zero configuration: E_1 E_2 ... E_6 = X. This loop may begin at any joint: an axis moved from its front to
// its end is transformed by the inverse of X. So the three special joints (a, b, c) can be anywhere, and with the other three
// (f, g, h) in the order of the loop
//
//     (E_a E_b E_c)^-1 = E_f E_g E_h X^-1.
//
// If the axes a, b, c meet in a point, both sides leave this point where it is; if they are parallel, both sides leave their
// direction and the heights along it as they are. These are three equations for the other three joints. If two neighbours of
// them meet or are parallel, one quadratic equation after another solves these, with up to four solutions. Then E_a E_b E_c is
// known, and each time two configurations of the special joints remain.
//
// Sources: Pieper, "The kinematics of manipulators under computer control", 1968; Elias and Wen, "IK-Geo: unified robot inverse
// kinematics using subproblem decomposition", Mech. Mach. Theory 209, 2025, whose subproblems 1 to 4 are used here.
//
// Seven hinges are swept: one of them is held at sampled positions, and the other six have a closed form.
#pragma once
#include <memory>

#include "chain.hpp"

namespace armctl {

// A line in space: the axis of a hinge.
struct Line {
    Vec3 axis;
    Vec3 point;
};

// The hinges and the tip of a chain in the zero configuration, lengths in reaches.
struct ZeroConfiguration {
    std::vector<Line> lines;
    Pose tip;
    std::optional<size_t> held;  // the joint that is swept, of seven
};

inline constexpr size_t MAX_CONFIGURATIONS = 8;  // of six joints: four of the first three, and two for each of them

// The positions of the swept joint, and when the sweep ends. Six joints have one position, which means nothing.
struct Sweep {
    Vector positions;
    std::int64_t least;   // how many of them to take
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
    // Of a chain with special axes and six hinges, or seven of which one is `held`.
    ClosedForm(std::shared_ptr<const Chain> chain, std::optional<size_t> held);

    const Chain& chain() const { return *chain_; }

    // Fills `seeds` (M, n) with the configurations inside the bounds, up to `margin`, rad, for a target in m. `slack`, in cosines, is
    // what the closed form may miss by rounding, or because it is not exact.
    Seeds find(const Pose& target, Vector q0, double slack, double margin, const Sweep& sweep, MatrixResult seeds) const;

private:
    std::shared_ptr<const Chain> chain_;
    ZeroConfiguration zero_;
};

}  // namespace armctl
