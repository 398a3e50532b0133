// What an arm could touch, or touch something with: shapes, the joints that move them, and the pairs that may meet.
//
// Every frame maps the world at the reference configuration to the world now. Frame 0 is the world itself; every other frame
// belongs to a joint that moves. Shapes are given in the world at the reference configuration.
#pragma once
#include "box_tree.hpp"
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

// What is added to a model: geoms, with their vertices, and pairs of all geoms, whose numbers go on behind those of the model.
struct CollisionAdditions {
    Vertices vertices;
    std::vector<Geom> geoms;
    std::vector<CollisionPair> pairs;
    std::vector<bool> kept_pairs{};  // which pairs of the model stay, (K,)
};

constexpr size_t MANY_STANDING = 64;  // geoms that stand, from which on a tree over them saves time

// A tree over the geoms that stand in the world, planes and points excepted, and the pairs that each other geom has with them.
struct StandingGeoms {
    static constexpr std::uint32_t NO_PAIR = static_cast<std::uint32_t>(-1);

    BoxTree tree;
    std::vector<std::vector<std::uint32_t>> pairs;  // of each geom, by the position in the tree's order; empty for a geom without any
    std::vector<size_t> other_pairs;                // of geoms that are not in the tree, in ascending order
    double max_margin = 0.0;                        // m, of the pairs
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
        complete_all();
    }

    // The same with further geoms, such as those of a world that changes.
    CollisionModel with(const CollisionAdditions& added) const {
        CollisionModel model = *this;
        if (added.kept_pairs.size() != pairs.size()) { throw InputError("kept_pairs: need one for each pair"); }
        model.pairs.clear();
        for (size_t p = 0; p < pairs.size(); ++p) {
            if (added.kept_pairs[p]) { model.pairs.push_back(pairs[p]); }
        }
        model.pairs.insert(model.pairs.end(), added.pairs.begin(), added.pairs.end());
        const size_t vertex = vertices.positions.size();
        for (Geom geom : added.geoms) {
            geom.first_vertex += vertex;
            geom.last_vertex += vertex;
            model.geoms.push_back(std::move(geom));
        }
        model.vertices.append(added.vertices);
        model.complete_all();
        return model;
    }

    // The same of an arm with closed loops.
    CollisionModel with_loops(Closure loops) const {
        if (loops->m() != joints() || loops->n() != n()) { throw InputError("loops: they are those of another arm"); }
        CollisionModel model = *this;
        model.closure = std::move(loops);
        return model;
    }

    // The same with other margins of the pairs, (K,) m.
    CollisionModel with_margins(Vector margins) const {
        require_size(margins, pairs.size(), "margins");
        CollisionModel model = *this;
        for (size_t p = 0; p < margins.size(); ++p) { model.pairs[p].margin = margins[p]; }
        model.standing = model.find_standing();
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
    std::vector<Vec3> directions;                   // in which the depth of an overlap is measured first
    Closure closure;                                // of closed loops; none in a tree
    std::vector<size_t> moving;                     // the geoms that move, in ascending order
    std::shared_ptr<const StandingGeoms> standing;  // none where there are few

private:
    void complete_all() {
        check_vertices();
        for (Geom& geom : geoms) { complete(geom); }
        for (CollisionPair& pair : pairs) {
            require_index(pair.a, geoms.size(), "first_geoms");
            require_index(pair.b, geoms.size(), "second_geoms");
            if (geoms[pair.b].kind == ShapeKind::points) { throw InputError("second_geoms: points come first"); }
            pair.common = common_frame(geoms[pair.a].frame, geoms[pair.b].frame);
        }
        moving.clear();
        for (size_t g = 0; g < geoms.size(); ++g) {
            if (geoms[g].frame != 0) { moving.push_back(g); }
        }
        standing = find_standing();
    }

    std::shared_ptr<const StandingGeoms> find_standing() const {
        std::vector<size_t> standing_geoms;
        std::vector<AlignedBox> items;
        for (size_t g = 0; g < geoms.size(); ++g) {
            if (geoms[g].frame != 0 || geoms[g].kind == ShapeKind::plane || geoms[g].kind == ShapeKind::points) { continue; }
            standing_geoms.push_back(g);
            items.push_back(standing_bounds(geoms[g]));
        }
        if (items.size() < MANY_STANDING) { return nullptr; }
        auto found = std::make_shared<StandingGeoms>();
        found->tree = BoxTree(items.size(), [&](size_t i) { return items[i].center(); }, [&](size_t i) { return items[i]; });
        std::vector<size_t> positions(geoms.size(), geoms.size());
        for (size_t i = 0; i < items.size(); ++i) { positions[standing_geoms[found->tree.order()[i]]] = i; }
        found->pairs.resize(geoms.size());
        for (size_t p = 0; p < pairs.size(); ++p) {
            const CollisionPair& pair = pairs[p];
            if (positions[pair.a] == geoms.size() || geoms[pair.b].frame == 0) {
                found->other_pairs.push_back(p);
                continue;
            }
            std::vector<std::uint32_t>& of_geom = found->pairs[pair.b];
            if (of_geom.empty()) { of_geom.assign(items.size(), StandingGeoms::NO_PAIR); }
            std::uint32_t& place = of_geom[positions[pair.a]];
            if (place == StandingGeoms::NO_PAIR) {
                place = static_cast<std::uint32_t>(p);
            } else {
                found->other_pairs.push_back(p);
            }
            found->max_margin = std::max(found->max_margin, pair.margin);
        }
        return found;
    }

    // A box around a geom that stands, or around its bounding sphere.
    AlignedBox standing_bounds(const Geom& geom) const {
        if (geom.kind != ShapeKind::box) { return AlignedBox::around(geom.center, geom.radius); }
        const Vec3 first = vertices.positions[geom.first_vertex];
        AlignedBox bounds = {first, first};
        for (size_t i = geom.first_vertex; i < geom.last_vertex; ++i) { bounds.include({vertices.positions[i], vertices.positions[i]}); }
        return bounds;
    }

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
        if ((geom.kind == ShapeKind::points) != (geom.cloud != nullptr)) { throw InputError("kinds: points need a cloud"); }
        if (geom.cloud && geom.frame != 0) { throw InputError("frames: points stand still"); }
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
