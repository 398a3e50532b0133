// Collision-free paths in joint space: two trees of proved lines grow towards random configurations until they meet.
//
// Sources: J. J. Kuffner, S. M. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000; with
// the dynamic domain of A. Yershova et al., "Dynamic-domain RRTs", ICRA 2005.
#pragma once
#include "free_space.hpp"
#include "spans.hpp"

namespace armctl {

constexpr double STEP = 1.0;            // the longest edge of a tree, rad (m)
constexpr double DOMAIN_RAD = 4.0;      // A node whose extension failed takes samples from this distance only, rad
constexpr double MIN_DOMAIN_RAD = 1.0;  // smaller domains starve a tree of few nodes
constexpr double DOMAIN_RATE = 1e-4;    // by which a domain shrinks with each failure and grows with each success
constexpr double SAME_CONFIGURATION_RAD = 1e-10;
constexpr double MIN_PROGRESS = 0.2;  // of a step, towards a target: with less, the projection on the kept axis leads away from it
constexpr double ROUNDING = 1e-9;

class RrtConnect {
public:
    // From a start (n,) to any of some goals (g, n), all of them free; `low` and `high` (n,) bound what is tried. No tree gets
    // more nodes than `capacity`.
    RrtConnect(FreeSpace space, Vector start, Matrix goals, Vector low, Vector high, size_t capacity)
        : space_(std::move(space)), low_(low.begin(), low.end()), high_(high.begin(), high.end()), capacity_(capacity),
          step_(space_.keeps_axis() ? std::min(STEP, 2.0 * std::sqrt(space_.kept_within())) : STEP),
          trees_{Tree(start.size()), Tree(start.size())}, trial_(start.size()) {
        trees_[FROM_START].add(start, std::nullopt);
        for (size_t goal = 0; goal < goals.rows; ++goal) { trees_[FROM_GOALS].add(goals.row(goal), std::nullopt); }
    }

    size_t n() const { return low_.size(); }

    // Grows the trees towards random configurations, (k, n), until they meet. Returns how many of these it took.
    size_t grow(Matrix samples) {
        for (size_t taken = 0; taken < samples.rows; ++taken) {
            if (trees_[side_].size() > trees_[1 - side_].size()) { side_ = 1 - side_; }
            const std::optional<size_t> added = extend(trees_[side_], samples.row(taken));
            if (!added) { continue; }
            const Vector added_q = trees_[side_].configuration(*added);
            const std::optional<size_t> met = connect(trees_[1 - side_], added_q);
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
        const auto append_branch = [this, &path](Side side) {
            std::optional<size_t> node = (*meeting_)[side];
            while (node) {
                const Vector q = trees_[side].configuration(*node);
                path.emplace_back(q.begin(), q.end());
                node = trees_[side][*node].parent;
            }
        };
        append_branch(FROM_START);
        std::reverse(path.begin(), path.end());
        path.pop_back();  // both branches end at the meeting point
        append_branch(FROM_GOALS);
        return path;
    }

private:
    struct Node {
        std::optional<size_t> parent;  // none for a root
        double domain;                 // rad, from how far it takes samples
    };

    class Tree {
    public:
        explicit Tree(size_t n) : n_(n) {}

        size_t size() const { return nodes_.size(); }
        Vector configuration(size_t node) const { return {configurations_.data() + node * n_, n_}; }
        Node& operator[](size_t node) { return nodes_[node]; }
        const Node& operator[](size_t node) const { return nodes_[node]; }

        size_t add(Vector q, std::optional<size_t> parent) {
            configurations_.insert(configurations_.end(), q.begin(), q.end());
            nodes_.push_back({parent, std::numeric_limits<double>::infinity()});
            return nodes_.size() - 1;
        }

        // The node nearest to a configuration.
        size_t nearest(Vector q) const {
            size_t best = 0;
            double least = std::numeric_limits<double>::infinity();
            for (size_t node = 0; node < nodes_.size(); ++node) {
                const double* own = configurations_.data() + node * n_;
                double square = 0.0;
                for (size_t i = 0; i < n_; ++i) {
                    const double offset = own[i] - q[i];
                    square += offset * offset;
                    if (square >= least) { break; }
                }
                if (square < least) {
                    least = square;
                    best = node;
                }
            }
            return best;
        }

    private:
        size_t n_;
        std::vector<double> configurations_;  // (size, n)
        std::vector<Node> nodes_;
    };

    enum Side { FROM_START, FROM_GOALS };

    // A new node on the way from the nearest node to a sample, or none.
    std::optional<size_t> extend(Tree& tree, Vector sample) {
        const size_t near = tree.nearest(sample);
        const double distance = joint_distance(sample, tree.configuration(near));
        const double domain = tree[near].domain;
        const bool is_full = std::max(trees_[FROM_START].size(), trees_[FROM_GOALS].size()) >= capacity_;
        if (distance > domain || distance < SAME_CONFIGURATION_RAD || is_full) { return std::nullopt; }
        const bool is_level = step_towards(tree.configuration(near), sample, std::min(1.0, step_ / distance));
        if (!is_level || !space_.edge_is_free(tree.configuration(near), trial_)) {
            tree[near].domain = std::isinf(domain) ? DOMAIN_RAD : std::max(MIN_DOMAIN_RAD, domain * (1.0 - DOMAIN_RATE));
            return std::nullopt;
        }
        tree[near].domain = domain * (1.0 + DOMAIN_RATE);
        return tree.add(trial_, near);
    }

    // Grows a tree step by step to a configuration. Returns its node there, or none if something is in the way.
    std::optional<size_t> connect(Tree& tree, Vector goal) {
        size_t node = tree.nearest(goal);
        double distance = joint_distance(goal, tree.configuration(node));
        while (tree.size() < capacity_) {
            const double steps = std::max(1.0, std::ceil(distance / step_ - ROUNDING));
            const bool is_last = steps == 1.0;
            if (is_last) {
                trial_.assign(goal.begin(), goal.end());
            } else if (!step_towards(tree.configuration(node), goal, 1.0 / steps)) {
                return std::nullopt;
            }
            const double remaining = joint_distance(trial_, goal);
            if (!is_last && remaining > distance - MIN_PROGRESS * step_) { return std::nullopt; }
            if (!space_.edge_is_free(tree.configuration(node), trial_)) { return std::nullopt; }
            distance = remaining;
            node = tree.add(trial_, node);
            if (is_last) { return node; }
        }
        return std::nullopt;
    }

    // Writes a configuration on the way to another into `trial_`, projected where an axis keeps its direction. Returns if it could.
    bool step_towards(Vector start, Vector goal, double share) {
        for (size_t i = 0; i < trial_.size(); ++i) { trial_[i] = start[i] + share * (goal[i] - start[i]); }
        return !space_.keeps_axis() || space_.level(trial_, low_, high_);
    }

    FreeSpace space_;
    std::vector<double> low_;
    std::vector<double> high_;
    size_t capacity_;
    double step_;  // rad
    std::array<Tree, 2> trees_;
    size_t side_ = FROM_START;  // whose turn it is
    std::optional<std::array<size_t, 2>> meeting_;
    std::vector<double> trial_;  // (n,)
};

}  // namespace armctl
