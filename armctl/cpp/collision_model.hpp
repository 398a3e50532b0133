// What an arm could touch, or touch something with: shapes, the joints that move them, and the pairs that may meet.
//
// Every frame maps the world at the reference configuration to the world now. Frame 0 is the world itself; every other frame
// belongs to a joint that moves. Shapes are given in the world at the reference configuration.
#pragma once
#include <cstdint>
#include <vector>

#include "convex.hpp"
#include "arguments.hpp"
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
    // From arrays for each of the m joints that move, parents before children, which are hinges or slides with an axis and an
    // anchor on it and a reference position, and move the frame of their own number + 1; for each of the G geoms and P vertices;
    // for each of the S bounding spheres, of the geoms and of groups; and for the K pairs, in the order of the R pairs of groups to
    // which they belong. All geoms of a moving frame are one group, each geom that stands is its own. In a pair, a plane comes
    // first, else the geom that has fewer joints above it. The positions of all joints are `ratio` (m, n) q + `joint_offset`.
    explicit CollisionModel(const Arguments& arguments);

    size_t joints() const { return frames.size() - 1; }
    size_t n() const { return ratio_.columns(); }

    // The positions of all joints that move, (m,), at q (n,).
    void positions(Vector q, Result all) const;
    // The derivatives by the n of what has derivatives (m,) by all joints.
    void reduce_gradient(Vector all, Result gradient) const;
    double ratio(size_t joint, size_t i) const { return ratio_(joint, i); }

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
    void add_frames(const Arguments& arguments);
    void add_vertices(const Arguments& arguments);
    void add_geoms(const Arguments& arguments);
    void add_spheres(const Arguments& arguments);
    void add_pairs(const Arguments& arguments);
    size_t common_frame(size_t a, size_t b) const;

    DenseMatrix ratio_;
    Numbers joint_offset_;
};

}  // namespace armctl
