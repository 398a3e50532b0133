// Collision-free paths in joint space: two trees of proved lines grow towards random configurations until they meet.
//
// Source: J. J. Kuffner, S. M. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000.
#pragma once
#include "clearance_proof.hpp"

namespace armctl {

constexpr double STEP = 1.0;  // the longest edge of a tree, rad (m)
constexpr double SAME_CONFIGURATION_RAD = 1e-10;
constexpr double MIN_PROGRESS = 0.2;  // of a step, towards a target: with less, the projection into the region leads away from it
constexpr double ROUNDING = 1e-9;
constexpr double LEVEL_SHARE = 0.5;  // of the permitted tilt, or of a region, which nodes keep: the lines between them need the rest
constexpr double MAX_MARGIN = 0.01;  // m or rad, at a limit of a wide region: a line that leaves it there is not taken
constexpr double LEVEL_TOLERANCE_RAD = 1e-6;
constexpr int LEVEL_STEPS = 8;
constexpr int REGION_STEPS = 24;   // the same into a region with several limits, which may come and go on the way
constexpr double AIM_SHARE = 0.2;  // of the margin at such a limit: a step aims farther inside by it, or would end at its edge
constexpr double LEVEL_DAMPING = 1e-6;

using Configuration = std::vector<double>;  // (n,) rad
using Path = std::vector<Configuration>;

// Distance of two configurations, rad.
inline double joint_distance(Vector first, Vector second) {
    double square = 0.0;
    for (size_t i = 0; i < first.size(); ++i) {
        const double difference = second[i] - first[i];
        square += difference * difference;
    }
    return std::sqrt(square);
}

// Paths keep a clearance from everything and, if asked, the tip in a region. Uses the proof's scratch memory and its region.
class RrtConnect {
public:
    // From a start (n,) to any of some goals (g, n), all of them free; `low` and `high` (n,) bound what is tried. No tree gets
    // more nodes than `capacity`.
    RrtConnect(std::shared_ptr<ClearanceProof> proof, double clearance, Vector start, Matrix goals, Vector low, Vector high,
               size_t capacity)
        : proof_(std::move(proof)), clearance_(clearance), low_(low.begin(), low.end()), high_(high.begin(), high.end()),
          capacity_(capacity), end_(model().joints()) {
        if (keep()) { step_ = std::min(STEP, 2.0 * std::sqrt(0.5 * keep()->thickness())); }
        add(trees_[FROM_START], start, std::nullopt);
        for (size_t goal = 0; goal < goals.rows; ++goal) { add(trees_[FROM_GOALS], goals.row(goal), std::nullopt); }
    }

    size_t n() const { return low_.size(); }

    // Grows the trees towards random configurations, (k, n), until they meet. Returns how many of these it took.
    size_t grow(Matrix samples) {
        for (size_t taken = 0; taken < samples.rows; ++taken) {
            if (trees_[side_].size() > trees_[1 - side_].size()) { side_ = 1 - side_; }
            const std::optional<size_t> added = extend(trees_[side_], nearest(trees_[side_], samples.row(taken)), samples.row(taken));
            if (!added) { continue; }
            const std::optional<size_t> met = connect(trees_[1 - side_], trees_[side_][*added].q);
            if (met) {
                meeting_.emplace();
                (*meeting_)[side_] = *added;
                (*meeting_)[1 - side_] = *met;
                return taken + 1;
            }
            side_ = 1 - side_;
        }
        return samples.rows;
    }

    // The path from the start to a goal; empty as long as the trees have not met.
    Path path() const {
        Path path;
        if (!meeting_) { return path; }
        for (std::optional<size_t> node = (*meeting_)[FROM_START]; node; node = trees_[FROM_START][*node].parent) {
            path.push_back(trees_[FROM_START][*node].q);
        }
        std::reverse(path.begin(), path.end());
        path.pop_back();  // both branches end at the meeting point
        for (std::optional<size_t> node = (*meeting_)[FROM_GOALS]; node; node = trees_[FROM_GOALS][*node].parent) {
            path.push_back(trees_[FROM_GOALS][*node].q);
        }
        return path;
    }

    // The way from a configuration (n,) to another in steps, as a tree grows; empty if something is in the way.
    Path way(Vector start, Vector goal) {
        Tree tree;
        add(tree, start, std::nullopt);
        Path path;
        if (!connect(tree, goal)) { return path; }
        for (const Node& node : tree) { path.push_back(node.q); }
        return path;
    }

    // Brings the tip at configurations (k, n) into the inner part of its region. Returns whether it could at all of them.
    bool project(MatrixResult q) {
        if (!keep()) { return true; }
        for (size_t row = 0; row < q.rows; ++row) {
            if (!level(q.row(row))) { return false; }
        }
        return true;
    }

    // The longest edge, rad (m).
    double step() const { return step_; }

private:
    struct Node {
        Configuration q;
        std::optional<size_t> parent;  // none for a root
    };

    using Tree = std::vector<Node>;

    enum Side { FROM_START, FROM_GOALS };

    const CollisionModel& model() const { return proof_->scene().model(); }
    const std::optional<KeptRegion>& keep() const { return proof_->kept(); }

    static size_t add(Tree& tree, Vector q, std::optional<size_t> parent) {
        tree.push_back({.q = Configuration(q.begin(), q.end()), .parent = parent});
        return tree.size() - 1;
    }

    // The node nearest to a configuration.
    static size_t nearest(const Tree& tree, Vector q) {
        size_t best = 0;
        double least = std::numeric_limits<double>::infinity();
        for (size_t node = 0; node < tree.size(); ++node) {
            const double distance = joint_distance(tree[node].q, q);
            if (distance < least) {
                least = distance;
                best = node;
            }
        }
        return best;
    }

    // A new node on the way from a node to a configuration, at most a step away, or none. Nodes before the
    // configuration are projected where the tip stays in a region.
    std::optional<size_t> extend(Tree& tree, size_t node, Vector goal) {
        const Configuration& start = tree[node].q;
        const double distance = joint_distance(goal, start);
        const bool is_full = std::max(trees_[FROM_START].size(), trees_[FROM_GOALS].size()) >= capacity_;
        if (distance < SAME_CONFIGURATION_RAD || is_full) { return std::nullopt; }
        trial_.assign(goal.begin(), goal.end());
        if (distance > step_ * (1.0 + ROUNDING)) {
            for (size_t i = 0; i < n(); ++i) { trial_[i] = start[i] + step_ / distance * (goal[i] - start[i]); }
            if (keep() && !level(trial_)) { return std::nullopt; }
        }
        if (!edge_is_free(start, trial_)) { return std::nullopt; }
        return add(tree, trial_, node);
    }

    // Grows a tree step by step to a configuration. Returns its node there, or none if something is in the way.
    std::optional<size_t> connect(Tree& tree, Vector goal) {
        std::optional<size_t> node = nearest(tree, goal);
        double distance = joint_distance(goal, tree[*node].q);
        while (distance >= SAME_CONFIGURATION_RAD) {
            node = extend(tree, *node, goal);
            if (!node) { return std::nullopt; }
            const double remaining = joint_distance(goal, tree[*node].q);
            if (remaining > 0.0 && remaining > distance - MIN_PROGRESS * step_) { return std::nullopt; }
            distance = remaining;
        }
        return node;
    }

    // Whether the straight line between two configurations, (n,), is proved. To check its end first decides most of them at a tenth
    // of the cost.
    bool edge_is_free(Vector start, Vector end) {
        CollisionScene& scene = proof_->scene();
        scene.find_positions(end, end_);
        if (scene.first_hit(end_, clearance_) != scene.no_pair()) { return false; }
        if (keep() && !keep()->contains_tip(scene)) { return false; }
        proof_->set_line(start, end);
        return !proof_->hit(clearance_);
    }

    // Brings the tip of a configuration into the inner part of its region, by the least motion of the joints, between bounds. Returns
    // whether it could. Newton steps on the limits that the tip is beyond.
    bool level(Result q) {
        CollisionScene& scene = proof_->scene();
        const int steps = keep()->limits().empty() ? LEVEL_STEPS : REGION_STEPS;
        for (int step = 0; step < steps; ++step) {
            scene.find_positions(q, end_);
            scene.place_frames(end_);
            const std::vector<Excess> beyond = excesses();
            if (beyond.empty()) { return true; }
            const Numbers move = least_move(beyond);
            for (size_t j = 0; j < q.size(); ++j) { q[j] = std::min(std::max(q[j] + move[j], low_[j]), high_[j]); }
        }
        return false;
    }

    // How far the tip is outside the inner part of its region in one direction, and how fast each joint (n,) decreases it.
    struct Excess {
        double aim;  // m or rad, by which it should decrease
        Numbers decrease;
    };

    std::vector<Excess> excesses() const {
        const CollisionScene& scene = proof_->scene();
        const KeptRegion& region = *keep();
        std::vector<Excess> found;
        if (region.axis()) {
            const double excess = region.tilt(scene) - LEVEL_SHARE * region.axis()->within;
            if (excess > LEVEL_TOLERANCE_RAD) {
                found.push_back({excess + LEVEL_TOLERANCE_RAD, scene.reduced_gradient(region.tilt_decrease(scene))});
            }
        }
        for (const RegionLimit& limit : region.limits()) {
            const HalfSpace& space = region.best_of(scene, limit);
            const double margin = std::min(0.5 * LEVEL_SHARE * limit.thickness, MAX_MARGIN);
            const double excess = margin - region.inside(scene, space);
            if (excess > LEVEL_TOLERANCE_RAD) {
                found.push_back({excess + AIM_SHARE * margin, scene.reduced_gradient(region.gradient(scene, space))});
            }
        }
        return found;
    }

    // The least motion of the joints (n,) that takes back some excesses: a damped Newton step, J^T (J J^T + damping)^-1 excess.
    static Numbers least_move(const std::vector<Excess>& beyond) {
        const size_t count = beyond.size();
        Mat square(count, count);
        Numbers scales(count);
        for (size_t i = 0; i < count; ++i) {
            scales[i] = beyond[i].aim;
            for (size_t k = 0; k <= i; ++k) { square(i, k) = dot(beyond[i].decrease, beyond[k].decrease); }
            square(i, i) += LEVEL_DAMPING;
        }
        if (count == 1) {
            scales[0] /= square(0, 0);
        } else {
            factorize(square);
            solve(square, scales);
        }
        Numbers move(beyond.front().decrease.size());
        for (size_t i = 0; i < count; ++i) {
            for (size_t j = 0; j < move.size(); ++j) { move[j] += scales[i] * beyond[i].decrease[j]; }
        }
        return move;
    }

    std::shared_ptr<ClearanceProof> proof_;
    double clearance_;
    Configuration low_;
    Configuration high_;
    size_t capacity_;
    double step_ = STEP;  // rad
    std::array<Tree, 2> trees_;
    size_t side_ = FROM_START;  // whose turn it is
    std::optional<std::array<size_t, 2>> meeting_;
    Configuration trial_;
    std::vector<double> end_;  // (m,) of an edge
};

}  // namespace armctl
