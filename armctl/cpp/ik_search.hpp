// Inverse kinematics: Levenberg-Marquardt on a serial chain, joint bounds as an active set, counted random restarts.
//
// The damping follows the error as proposed by Sugihara ("Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
// method", IEEE Trans. Robotics 27(5), 2011).
#pragma once
#include <cstdint>
#include <vector>

#include "error_model.hpp"

namespace armctl {

struct Tolerances {
    double position;     // m, or reaches
    double orientation;  // rad

    bool contain(PoseError error) const { return error.position <= position && error.orientation <= orientation; }
};

// A target (m) with its tolerances.
struct Target {
    Pose pose;
    Constraint constraint;
    Tolerances tolerances;
};

// Which starts a search may use. Start 0 is the given configuration, the others are random.
struct Starts {
    std::int64_t first;
    std::int64_t last;  // exclusive
    std::uint64_t seed;
};

struct SearchOutcome {
    bool solved;
    bool jumped;              // whether the result is far from q0 although the tip began near the target
    bool tip_is_known;        // whether the chain is placed at the result
    std::int64_t next_start;  // the start after the last one used
    std::int64_t steps;
};

struct Descent {
    bool solved;
    double squared_error;        // of the best configuration met
    double first_squared_error;  // at the start
    int steps;
};

// Everything that one thread needs for a search. It does not own the chain.
class IkSolver {
public:
    explicit IkSolver(const Chain& chain);

    const Chain& chain() const { return model_.chain(); }
    ErrorModel& model() { return model_; }
    ChainKinematics& kinematics() { return model_.kinematics(); }

    // Descends from one start after another until one is solved; beyond the reach one start is enough.
    //
    // Whole turns are counted from q0. Fills q with the solution, or else the best configuration met.
    SearchOutcome search(const Target& target, Vector q0, const Starts& starts, Result q);

    // One descent from q within bounds; q becomes the best configuration met.
    Descent descend(BoundsOf bounds_of, const Goal& goal, const Tolerances& tolerances, Result q);

    // Moves q to a minimum of the squared error plus `pull` times its squared distance from q0; every step decreases that.
    //
    // Without a pull it ends where the tip is nearest to a target it cannot reach. Returns what is left, in squared reaches.
    double refine(const Pose& target, Constraint constraint, double rotation_weight, Vector q0, double pull, Result q);

    // The random start of a number: within half a turn of q0 and inside the bounds, `bounds` or `one_turn`, or at one.
    void random_start(BoundsOf bounds_of, Vector q0, std::int64_t start, std::uint64_t seed, Result q) const;

    Tolerances in_reaches(const Tolerances& tolerances) const { return {tolerances.position / chain().reach(), tolerances.orientation}; }

    // The errors of the tip at q for a target in m. Places the chain.
    PoseError tip_error(const Target& target, Vector q);

private:
    bool is_beyond(const Goal& goal, double position_tolerance) const;
    void turn_inside(Result q) const;
    bool unwind(Vector q0, Result q) const;

    ErrorModel model_;
    std::vector<double> trial_;
};

}  // namespace armctl
