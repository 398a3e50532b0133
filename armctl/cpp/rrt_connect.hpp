// Collision-free paths in joint space: two trees of proved lines grow towards random configurations until they meet.
//
// Sources: J. J. Kuffner, S. M. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000; with
// the dynamic domain of A. Yershova et al., "Dynamic-domain RRTs", ICRA 2005.
#pragma once
#include <array>
#include <memory>
#include <optional>
#include <vector>

#include "free_space.hpp"
#include "spans.hpp"

namespace armctl {

class RrtConnect {
public:
    // From a start (n,) to any of some goals (g, n), all of them free; `low` and `high` (n,) bound what is tried. No tree gets
    // more nodes than `capacity`.
    RrtConnect(FreeSpace space, Vector start, Matrix goals, Vector low, Vector high, size_t capacity);

    size_t n() const { return low_.size(); }

    // Grows the trees towards random configurations, (k, n), until they meet. Returns how many of these it took.
    size_t grow(Matrix samples);

    // The path from the start to a goal; empty as long as the trees have not met.
    Path path() const;

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

        size_t add(Vector q, std::optional<size_t> parent);
        // The node nearest to a configuration.
        size_t nearest(Vector q) const;

    private:
        size_t n_;
        std::vector<double> configurations_;  // (size, n)
        std::vector<Node> nodes_;
    };

    enum Side { FROM_START, FROM_GOALS };

    std::optional<size_t> extend(Tree& tree, Vector sample);
    std::optional<size_t> connect(Tree& tree, Vector goal);
    bool step_towards(Vector start, Vector goal, double share);

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
