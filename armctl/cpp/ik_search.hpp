// Inverse kinematics: Levenberg-Marquardt on a serial chain, joint bounds as an active set, counted random restarts.
//
// The damping follows the error as proposed by Sugihara ("Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
// method", IEEE Trans. Robotics 27(5), 2011).
#pragma once
#include "error_model.hpp"

namespace armctl {

constexpr double INF = std::numeric_limits<double>::infinity();
// A solution that moves a joint by more than 0.3 rad although the tip started within half a reach of the target may be a
// needless change of posture. The caller then looks for a nearer one.
constexpr double NEAR_TARGET_REACHES = 0.5;
constexpr double JUMP_RAD = 0.3;
constexpr int MAX_DESCENT_STEPS = 60;
constexpr int STALL_STEPS = 3;       // a descent ends after so many steps ...
constexpr double STALL_RATIO = 0.7;  // ... in which the squared error stays above this share of what it was
constexpr double DAMPING = 2e-2;
// Every other random start lies beyond the bounds by up to this share of their range and is clamped to them: solutions at bounds
// are found faster from there. The others begin with a descent without bounds, turned back into them by whole turns: it passes
// local minima at the bounds. Of 5 000 targets on six-joint chains with narrow bounds, the slowest needs 270 starts, not 3 000.
constexpr double START_STRETCH = 0.2;
// The search gives up if no descent without bounds has solved the target by then: then no configuration does. Of 90 000 targets
// with joints at their bounds, on 16 arms, the slowest needed 54 starts.
constexpr std::int64_t MAX_STARTS_WITHOUT_FREE_SOLUTION = 110;
// It also gives up if the best error is still this large. Of 760 000 such targets on 38 arms, those that needed more than 280
// starts were nearer by then.
constexpr std::int64_t MAX_STARTS_FAR = 300;
constexpr double FAR_ERROR = 0.03;       // reaches
constexpr double REACH_ROUNDING = 1e-9;  // reaches
constexpr int MAX_REFINE_STEPS = 200;
constexpr double REFINE_DAMPING = 0.1;          // initial, relative to the error
constexpr double REFINE_CONVEX_DAMPING = 1e-2;  // smallest that makes the Hessian definite, relative to the error
constexpr double REFINE_MIN_MOVE = 1e-7;        // rad, or reaches: a smaller step ends the refinement

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
    std::int64_t next_start;  // the start after the last one used
    std::int64_t steps;
};

// When a refinement ends.
struct Refinement {
    int max_steps = MAX_REFINE_STEPS;
    double min_move = REFINE_MIN_MOVE;
};

struct Descent {
    bool solved;
    double squared_error;        // of the best configuration met
    double first_squared_error;  // at the start
    int steps;
};

// Whether a search goes on after so many starts, with the best squared error so far.
inline bool is_promising(std::int64_t starts, bool free_solved, double squared_error) {
    if (starts >= MAX_STARTS_WITHOUT_FREE_SOLUTION && !free_solved) { return false; }
    return starts < MAX_STARTS_FAR || squared_error < FAR_ERROR * FAR_ERROR;
}

// The next number of splitmix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number generators", 2014), in [0, 1).
inline double next_fraction(std::uint64_t& state) {
    state += 0x9E3779B97F4A7C15u;
    std::uint64_t x = (state ^ (state >> 30)) * 0xBF58476D1CE4E5B9u;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
    return static_cast<double>((x ^ (x >> 31)) >> 11) / 9007199254740992.0;
}

// Everything that one thread needs for a search. It does not own the chain.
class IkSolver {
public:
    explicit IkSolver(const Chain& chain) : model_(chain), trial_(chain.n()) {}

    const Chain& chain() const { return model_.chain(); }
    ErrorModel& model() { return model_; }
    ChainKinematics& kinematics() { return model_.kinematics(); }

    // Descends from one start after another until one is solved; beyond the reach one start is enough.
    //
    // Whole turns are counted from q0. Fills q with the solution, or else the best configuration met.
    SearchOutcome search(const Target& target, Vector q0, const Starts& starts, Result q) {
        const Goal goal = model_.goal(target.pose, target.constraint);
        const Tolerances tolerances = in_reaches(target.tolerances);
        const std::int64_t last = is_beyond(goal, tolerances.position) ? starts.first + 1 : starts.last;
        double best = INF;
        SearchOutcome outcome{.solved = false, .jumped = false, .next_start = starts.first, .steps = 0};
        bool began_near = false;
        bool free_solved = false;
        while (outcome.next_start < last && !outcome.solved && is_promising(outcome.next_start - starts.first, free_solved, best)) {
            const std::int64_t start = outcome.next_start;
            if (start == 0) {
                std::ranges::copy(q, trial_.begin());
            } else {
                random_start(&Unknown::bounds, q0, start, starts.seed, trial_);
            }
            if (start > 0 && start % 2 == 0) {
                const Descent free_descent = descend(&Unknown::free_bounds, goal, tolerances, trial_);
                outcome.steps += free_descent.steps;
                free_solved = free_solved || free_descent.solved;
                turn_inside(trial_);
            }
            const Descent descent = descend(&Unknown::bounds, goal, tolerances, trial_);
            outcome.solved = descent.solved;
            outcome.steps += descent.steps;
            began_near = began_near || (start == 0 && descent.first_squared_error < NEAR_TARGET_REACHES * NEAR_TARGET_REACHES);
            ++outcome.next_start;
            if (descent.solved || descent.squared_error < best) {
                best = descent.squared_error;
                std::ranges::copy(trial_, q.begin());
            }
        }
        chain().wind_inside(q0, 0.0, q);
        double farthest = 0.0;
        for (size_t i = 0; i < q.size(); ++i) { farthest = std::max(farthest, std::abs(q[i] - q0[i])); }
        outcome.jumped = began_near && farthest > JUMP_RAD;
        return outcome;
    }

    // One descent from q within bounds to a goal, or into a region in reaches; q becomes the best configuration met.
    template <class Aim>
    Descent descend(BoundsOf bounds_of, const Aim& goal, const Tolerances& tolerances, Result q) {
        Descent descent{.solved = false, .squared_error = INF, .first_squared_error = INF, .steps = 0};
        double reference = INF;
        int stalled = 0;
        while (descent.steps < MAX_DESCENT_STEPS && stalled < STALL_STEPS && !descent.solved) {
            ++descent.steps;
            const PoseError error = model_.linearize(goal, q);
            const double size = squared(error, ROTATION_WEIGHT);
            if (descent.steps == 1) { descent.first_squared_error = size; }
            descent.solved = tolerances.contain(error);
            if (descent.solved || size < descent.squared_error) {
                descent.squared_error = size;
                model_.keep_best(q);
            }
            ++stalled;
            if (size < STALL_RATIO * reference) {
                reference = size;
                stalled = 0;
            }
            if (!descent.solved) { model_.step(bounds_of, DAMPING * std::min(size, std::sqrt(size)) + MIN_DAMPING, q); }
        }
        model_.take_best(q);
        return descent;
    }

    // Moves q to a minimum of the squared error plus `pull` times its squared distance from q0; every step decreases that.
    //
    // Without a pull it ends where the tip is nearest to a target it cannot reach. Returns what is left, in squared reaches.
    double refine(const Pose& target, Constraint constraint, double rotation_weight, Vector q0, double pull, Result q) {
        return refine(model_.goal(target, constraint), rotation_weight, q0, pull, q);
    }

    // The same for a goal, or a region in reaches.
    template <class Aim>
    double refine(const Aim& goal, double rotation_weight, Vector q0, double pull, Result q, Refinement until = {}) {
        double best = INF;
        double damping = 0.0;
        double moved = INF;
        for (int steps = 0; moved > until.min_move && steps < until.max_steps; ++steps) {
            double size = squared(model_.linearize(goal, q, rotation_weight), rotation_weight);
            for (size_t i = 0; i < q.size(); ++i) {
                const double away = q0[i] - q[i];
                size += pull * (away * away);
            }
            if (!(size <= best)) {
                damping *= 4.0;
                model_.take_best(q);
                continue;
            }
            if (best == INF) {
                damping = REFINE_DAMPING * std::sqrt(size);
            } else if (size < best) {
                damping *= 0.25;
            }
            best = size;
            model_.keep_best(q);
            model_.add_pull(pull, q0, q);
            if constexpr (std::is_same_v<Aim, Goal>) { model_.add_curvature(goal.constraint); }
            moved = model_.step(&Unknown::bounds, damping + MIN_DAMPING, q);
            while (moved < 0.0) {
                damping = std::max(4.0 * damping, REFINE_CONVEX_DAMPING * std::sqrt(size));
                moved = model_.step(&Unknown::bounds, damping + MIN_DAMPING, q);
            }
        }
        model_.take_best(q);
        return best;
    }

    // The random start of a number: within half a turn of q0 and inside the bounds, `bounds` or `one_turn`, or at one.
    //
    // A hinge that turns farther than half a turn would offer every direction twice, and meet its bounds more often. Not so one
    // that other joints follow at a ratio: a turn of it is another configuration.
    void random_start(BoundsOf bounds_of, Vector q0, std::int64_t start, std::uint64_t seed, Result q) const {
        std::uint64_t state = seed ^ (static_cast<std::uint64_t>(start) * 0xD1B54A32D192ED03u);
        const double stretch = START_STRETCH * static_cast<double>(start % 2);
        for (size_t i = 0; i < q.size(); ++i) {
            const double fraction = next_fraction(state);
            const Unknown& unknown = chain().unknowns()[i];
            auto [low, high] = unknown.*bounds_of;
            const bool is_endless = high - low == INF;
            if (high - low > 2 * std::numbers::pi && (unknown.period > 0.0 || is_endless)) {
                const double middle = std::min(std::max(q0[i], low + std::numbers::pi), high - std::numbers::pi);
                low = middle - std::numbers::pi;
                high = middle + std::numbers::pi;
            }
            const double drawn = low + ((1 + 2 * stretch) * fraction - stretch) * (high - low);
            q[i] = Bounds{low, high}.clamp(drawn);
        }
    }

    Tolerances in_reaches(const Tolerances& tolerances) const { return {tolerances.position / chain().reach(), tolerances.orientation}; }

    // The errors of the tip at q for a target in m. Places the chain.
    PoseError tip_error(const Target& target, Vector q) {
        kinematics().place(q);
        return residual(target.constraint, target.pose, kinematics().metric_tip());
    }

private:
    // Whether the goal is farther from the first joint than the arm stretched out, which is one reach.
    bool is_beyond(const Goal& goal, double position_tolerance) const {
        for (const ChainJoint& joint : chain().joints()) {
            const Bounds& bounds = chain().unknowns()[joint.unknown].bounds;
            if (joint.slides && !(bounds.high - bounds.low < INF)) { return false; }
        }
        return norm(goal.pose.translation - chain().base()) > 1.0 + REACH_ROUNDING + position_tolerance;
    }

    // Turns the hinges by whole turns towards the middle of their bounds, and clamps what is still outside.
    void turn_inside(Result q) const {
        for (size_t i = 0; i < q.size(); ++i) {
            const auto& [bounds, free_bounds, one_turn, period] = chain().unknowns()[i];
            const double middle = 0.5 * (bounds.low + bounds.high);
            q[i] = bounds.clamp(std::isfinite(middle) ? wound(q[i], middle, free_bounds, period) : q[i]);
        }
    }

    ErrorModel model_;
    std::vector<double> trial_;
};

}  // namespace armctl
