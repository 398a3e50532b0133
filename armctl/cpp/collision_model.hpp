// What an arm could touch, or touch something with: shapes, the joints that move them, and the pairs that may meet.
//
// Every frame maps the world at the reference configuration to the world now. Frame 0 is the world itself; every other frame
// belongs to a joint that moves. Shapes are given in the world at the reference configuration.
#pragma once
#include "convex.hpp"
#include "errors.hpp"
#include "linear_algebra.hpp"
#include "loop_closure.hpp"
#include "vectors.hpp"

namespace armctl {

// A joint and the frame that it moves.
struct MovingFrame {
    Vec3 axis;
    Vec3 anchor;
    bool slides = false;
    double reference = 0.0;
    size_t parent = 0;
    size_t joint = 0;
};

struct CollisionPair {
    size_t a = 0;
    size_t b = 0;
    size_t common = 0;    // the last frame above both
    double margin = 0.0;  // m, of its contacts, which MuJoCo makes as soon as the shapes are so near: it counts as touching
};

struct CollisionDescription {
    Mat ratio;                        // (m, n): the positions of the m joints that move are ratio q + their offsets
    Numbers joint_offset;             // (m,)
    std::vector<MovingFrame> joints;  // each moves the frame of its own number + 1; parents come before children
    Vertices vertices;
    std::vector<Geom> geoms;
    std::vector<CollisionPair> pairs;  // a plane comes first, else the geom that has fewer joints above it; `common` is found here
    std::vector<Vec3> directions;      // in which the depth of an overlap is measured first
};

// Immutable after its construction: threads share it.
class CollisionModel {
public:
    explicit CollisionModel(CollisionDescription given)
        : vertices(std::move(given.vertices)), geoms(std::move(given.geoms)), pairs(std::move(given.pairs)),
          directions(std::move(given.directions)), ratio_(std::move(given.ratio)), joint_offset_(std::move(given.joint_offset)) {
        const size_t m = given.joints.size();
        if (ratio_.rows() != m) { throw InputError("ratio: need a row for each joint"); }
        require_size(joint_offset_, m, "joint_offset");
        frames.resize(1);
        for (size_t i = 0; i < m; ++i) {
            require_index(given.joints[i].parent, i + 1, "parents");
            require_index(given.joints[i].joint, m, "joints");
            frames.push_back(given.joints[i]);
        }
        check_vertices();
        for (Geom& geom : geoms) { complete(geom); }
        for (CollisionPair& pair : pairs) {
            require_index(pair.a, geoms.size(), "first_geoms");
            require_index(pair.b, geoms.size(), "second_geoms");
            pair.common = common_frame(geoms[pair.a].frame, geoms[pair.b].frame);
        }
    }

    // The same of an arm with closed loops.
    CollisionModel with_loops(Closure loops) const {
        if (loops->m() != joints() || loops->n() != n()) { throw InputError("loops: they are those of another arm"); }
        CollisionModel model = *this;
        model.closure = std::move(loops);
        return model;
    }

    size_t joints() const { return frames.size() - 1; }
    size_t n() const { return ratio_.columns(); }

    // The positions of all joints that move, (m,), at q (n,), in a tree.
    void positions(Vector q, Result all) const {
        for (size_t i = 0; i < all.size(); ++i) {
            double position = joint_offset_[i];
            for (size_t j = 0; j < q.size(); ++j) { position += ratio_(i, j) * q[j]; }
            all[i] = position;
        }
    }

    // The positions of the joints per position of the n, (m, n), in a tree.
    const Mat& ratio() const { return ratio_; }

    std::vector<MovingFrame> frames;
    Vertices vertices;
    std::vector<Geom> geoms;
    std::vector<CollisionPair> pairs;
    std::vector<Vec3> directions;  // in which the depth of an overlap is measured first
    Closure closure;               // of closed loops; none in a tree

private:
    void check_vertices() const {
        const std::vector<size_t>& starts = vertices.first_neighbors;
        const size_t count = vertices.positions.size();
        const size_t end = vertices.neighbors.size();
        require_size(starts, count + 1, "first_neighbor");
        for (const size_t start : starts) { require_index(start, end + 1, "first_neighbor"); }
        if (!std::ranges::is_sorted(starts) || starts.front() != 0 || starts.back() != end) {
            throw InputError("first_neighbor: not in order");
        }
        for (const size_t neighbor : vertices.neighbors) { require_index(neighbor, count, "neighbors"); }
    }

    void complete(Geom& geom) const {
        require_index(geom.frame, frames.size(), "frames");
        require_index(geom.last_vertex, vertices.positions.size() + 1, "first_vertex");
        if (geom.first_vertex > geom.last_vertex) { throw InputError("first_vertex: not in order"); }
        if (geom.has_vertices() && geom.first_vertex == geom.last_vertex) { throw InputError("first_vertex: a hull without vertices"); }
        geom.semi_axes = {geom.size.x * geom.axes.x, geom.size.y * geom.axes.y, geom.size.z * geom.axes.z};
        geom.offset = dot(geom.normal(), geom.position);
    }

    size_t common_frame(size_t a, size_t b) const {
        while (a != b) {
            size_t& later = a > b ? a : b;  // parents come before children
            later = frames[later].parent;
        }
        return a;
    }

    Mat ratio_;
    Numbers joint_offset_;
};

}  // namespace armctl
