// What an arm could touch, or touch something with: shapes, the joints that move them, and the pairs that may meet.
//
// Every frame maps the world at the reference configuration to the world now. Frame 0 is the world itself; every other frame
// belongs to a joint that moves. Shapes are given in the world at the reference configuration.
#pragma once
#include <cstdint>
#include <vector>

#include "convex.hpp"
#include "spans.hpp"
#include "vectors.hpp"

namespace armctl {

using IntegerMatrix = MatrixSpan<const std::int64_t>;

// All are copied.
struct CollisionArrays {
    // Of each of the m joints that move, parents before children.
    Matrix axes;          // (m, 3)
    Matrix anchors;       // (m, 3) m, a point on the axis
    Integers slides;      // (m,) whether it slides
    Vector references;    // (m,) rad, its position at the reference configuration
    Integers parents;     // (m,) frames; the joint of row i moves frame i + 1
    Integers joints;      // (m,) its row in `ratio`
    Matrix ratio;         // (m, n): joint positions are ratio q + offset
    Vector joint_offset;  // (m,) rad
    // Of each of the G geoms.
    Integers kinds;         // (G,) ShapeKind
    Integers frames;        // (G,)
    Vector inflations;      // (G,) m, radii of spheres and capsules
    Matrix positions;       // (G, 3) m
    Matrix rotations;       // (G, 9) row by row
    Matrix sizes;           // (G, 3) m
    Integers first_vertex;  // (G + 1,)
    // Of each of the S bounding spheres: those of the geoms, then those of groups.
    Matrix centers;          // (S, 3) m
    Vector radii;            // (S,) m
    Integers sphere_frames;  // (S,)
    // Of each of the P vertices.
    Matrix vertices;          // (P, 3) m
    Integers first_neighbor;  // (P + 1,)
    Integers neighbors;       // rows of the vertices that share an edge with it, of large hulls
    // Unit vectors, (D, 3), in which the depth of an overlap is measured first.
    Matrix directions;
    // Of each of the K pairs, in the order of the R pairs of groups to which they belong. All geoms of a moving frame are one
    // group, each geom that stands is its own.
    IntegerMatrix pairs;        // (K, 2) rows of geoms; a plane comes first, then the geom that has fewer joints above it
    IntegerMatrix group_pairs;  // (R, 2) the spheres of two groups
    Integers last_pairs;        // (R,) behind the last pair of each
};

// A joint and the frame that it moves.
struct MovingFrame {
    Vec3 axis;
    Vec3 anchor;
    bool slides = false;
    double reference = 0.0;
    size_t parent = 0;
    size_t joint = 0;
    size_t depth = 0;  // frames above it, the world included
};

struct GeomPair {
    size_t a = 0;
    size_t b = 0;
    size_t common = 0;  // the last frame above both
};

// The pairs of two groups of geoms.
struct GroupPair {
    size_t a = 0;  // the sphere of the group
    size_t b = 0;
    size_t first_pair = 0;
    size_t last_pair = 0;
    size_t common = 0;
};

// Immutable after its construction: threads share it.
class CollisionModel {
public:
    explicit CollisionModel(const CollisionArrays& arrays);

    size_t joints() const { return frames.size() - 1; }
    size_t n() const { return ratio_columns_; }

    // The positions of all joints that move, (m,), at q (n,).
    void positions(Vector q, Result all) const;
    // The derivatives by the n of what has derivatives (m,) by all joints.
    void reduce_gradient(Vector all, Result gradient) const;
    double ratio(size_t joint, size_t i) const { return ratio_[joint * ratio_columns_ + i]; }

    std::vector<MovingFrame> frames;
    std::vector<Geom> geoms;
    Vertices vertices;
    // Of the geoms and, behind them, of the groups; the frame of each.
    std::vector<BoundingSphere> spheres;
    std::vector<size_t> sphere_frames;
    std::vector<GeomPair> pairs;  // in the order of their groups
    std::vector<GroupPair> groups;
    size_t depth = 1;              // frames above the deepest one, the world included
    std::vector<Vec3> directions;  // in which the depth of an overlap is measured first

private:
    void add_frames(const CollisionArrays& arrays);
    void add_geoms(const CollisionArrays& arrays);
    void add_pairs(const CollisionArrays& arrays);
    size_t common_frame(size_t a, size_t b) const;

    std::vector<double> ratio_;  // (m, n)
    size_t ratio_columns_ = 0;
    std::vector<double> joint_offset_;
};

}  // namespace armctl
