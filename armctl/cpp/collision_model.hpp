// What an arm could touch, or touch something with: shapes, the joints that move them, and the pairs that may meet.
//
// Every frame maps the world at the reference configuration to the world now. Frame 0 is the world itself; every other frame
// belongs to a joint that moves. Shapes are given in the world at the reference configuration.
#pragma once
#include "arguments.hpp"
#include "convex.hpp"
#include "errors.hpp"
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

// Rows where the lists of `elements` start, and behind them the `end` of the last one.
inline std::vector<size_t> checked_starts(const Arguments& arguments, const char* name, size_t elements, size_t end) {
    std::vector<size_t> starts;
    for (const std::int64_t start : arguments.integers(elements + 1, name)) { starts.push_back(checked_index(start, end + 1, name)); }
    if (!std::is_sorted(starts.begin(), starts.end()) || starts.front() != 0 || starts.back() != end) {
        throw InputError(std::string(name) + ": not in order");
    }
    return starts;
}

// Immutable after its construction: threads share it.
class CollisionModel {
public:
    // From arrays for each of the m joints that move, parents before children, which are hinges or slides with an axis and an
    // anchor on it and a reference position, and move the frame of their own number + 1; for each of the G geoms and P vertices;
    // and for the K pairs with the margins of their contacts. In a pair, a plane comes first, else the geom that has fewer joints
    // above it. The positions of all joints are `ratio` (m, n) q + `joint_offset`.
    explicit CollisionModel(const Arguments& arguments)
        : ratio_(arguments.length("references"), arguments.count("n")), joint_offset_(ratio_.rows()) {
        const size_t m = ratio_.rows();
        ratio_.set(arguments.matrix(m, n(), "ratio"));
        copy(arguments.vector(m, "joint_offset"), joint_offset_);
        add_frames(arguments);
        add_vertices(arguments);
        add_geoms(arguments);
        add_pairs(arguments);
        const Matrix given = arguments.matrix(arguments.length("directions"), 3, "directions");
        for (size_t i = 0; i < given.rows; ++i) { directions.push_back(vec3(given.row(i))); }
    }

    size_t joints() const { return frames.size() - 1; }
    size_t n() const { return ratio_.columns(); }

    // The positions of all joints that move, (m,), at q (n,).
    void positions(Vector q, Result all) const {
        for (size_t i = 0; i < all.size(); ++i) {
            double position = joint_offset_[i];
            for (size_t j = 0; j < q.size(); ++j) { position += ratio(i, j) * q[j]; }
            all[i] = position;
        }
    }

    // The derivatives by the n of what has derivatives (m,) by all joints.
    Numbers reduced_gradient(Vector all) const {
        Numbers gradient(n());
        for (size_t j = 0; j < n(); ++j) {
            for (size_t i = 0; i < all.size(); ++i) { gradient[j] += all[i] * ratio(i, j); }
        }
        return gradient;
    }

    double ratio(size_t joint, size_t i) const { return ratio_(joint, i); }

    std::vector<MovingFrame> frames;
    std::vector<Geom> geoms;
    Vertices vertices;
    std::vector<CollisionPair> pairs;
    std::vector<Vec3> directions;  // in which the depth of an overlap is measured first

private:
    void add_frames(const Arguments& given) {
        const size_t m = ratio_.rows();
        frames.resize(1);
        for (size_t i = 0; i < m; ++i) {
            frames.push_back({
                .axis = vec3(given.matrix(m, 3, "axes").row(i)),
                .anchor = vec3(given.matrix(m, 3, "anchors").row(i)),
                .slides = given.integers(m, "slides")[i] != 0,
                .reference = given.vector(m, "references")[i],
                .parent = checked_index(given.integers(m, "parents")[i], i + 1, "parents"),
                .joint = checked_index(given.integers(m, "joints")[i], m, "joints"),  // its row of the ratio
            });
        }
    }

    void add_vertices(const Arguments& arguments) {
        const Matrix positions = arguments.matrix(arguments.length("vertices"), 3, "vertices");
        for (size_t i = 0; i < positions.rows; ++i) { vertices.positions.push_back(vec3(positions.row(i))); }
        // The vertices that share an edge with each, of large hulls.
        const Integers neighbors = arguments.integers(arguments.length("neighbors"), "neighbors");
        vertices.first_neighbors = checked_starts(arguments, "first_neighbor", positions.rows, neighbors.size());
        for (const std::int64_t neighbor : neighbors) {
            vertices.neighbors.push_back(checked_index(neighbor, positions.rows, "neighbors"));
        }
    }

    void add_geoms(const Arguments& given) {
        const size_t G = given.length("kinds");
        const std::vector<size_t> starts = checked_starts(given, "first_vertex", G, vertices.positions.size());
        for (size_t g = 0; g < G; ++g) {
            Geom geom{
                .kind = static_cast<ShapeKind>(checked_index(given.integers(G, "kinds")[g], 5, "kinds")),
                .frame = checked_index(given.integers(G, "frames")[g], frames.size(), "frames"),
                .inflation = given.vector(G, "inflations")[g],
                .position = vec3(given.matrix(G, 3, "positions").row(g)),
                .axes = Rotation::from_rows(given.shaped({G, 3, 3}, "rotations").subspan(9 * g, 9)),
                .size = vec3(given.matrix(G, 3, "sizes").row(g)),
                .center = vec3(given.matrix(G, 3, "centers").row(g)),
                .radius = given.vector(G, "radii")[g],
                .first_vertex = starts[g],
                .last_vertex = starts[g + 1],
            };
            geom.semi_axes = {geom.size.x * geom.axes.x, geom.size.y * geom.axes.y, geom.size.z * geom.axes.z};
            geom.offset = dot(geom.normal(), geom.position);
            if (geom.has_vertices() && geom.first_vertex == geom.last_vertex) { throw InputError("first_vertex: a hull without vertices"); }
            geoms.push_back(geom);
        }
    }

    void add_pairs(const Arguments& arguments) {
        const size_t K = arguments.length("first_geoms");
        const Integers first_geoms = arguments.integers(K, "first_geoms");
        const Integers second_geoms = arguments.integers(K, "second_geoms");
        const Vector margins = arguments.vector(K, "margins");
        for (size_t p = 0; p < K; ++p) {
            const size_t a = checked_index(first_geoms[p], geoms.size(), "first_geoms");
            const size_t b = checked_index(second_geoms[p], geoms.size(), "second_geoms");
            pairs.push_back({a, b, common_frame(geoms[a].frame, geoms[b].frame), margins[p]});
        }
    }

    size_t common_frame(size_t a, size_t b) const {
        while (a != b) {
            size_t& later = a > b ? a : b;  // parents come before children
            later = frames[later].parent;
        }
        return a;
    }

    DenseMatrix ratio_;
    Numbers joint_offset_;
};

}  // namespace armctl
