#include "collision_model.hpp"

#include <algorithm>

#include "errors.hpp"

namespace armctl {

namespace {

// Rows where the lists of each element start, and the end of the last one.
std::vector<size_t> checked_starts(Integers starts, size_t count, const char* what) {
    std::vector<size_t> checked;
    for (const std::int64_t start : starts) { checked.push_back(checked_index(start, count + 1, what)); }
    if (!std::is_sorted(checked.begin(), checked.end()) || checked.front() != 0 || checked.back() != count) {
        throw InputError(std::string(what) + ": not in order");
    }
    return checked;
}

}  // namespace

CollisionModel::CollisionModel(const CollisionArrays& arrays) {
    add_frames(arrays);
    add_geoms(arrays);
    add_pairs(arrays);
    for (size_t i = 0; i < arrays.directions.rows; ++i) { directions.push_back(vec3(arrays.directions.row(i))); }
}

void CollisionModel::add_frames(const CollisionArrays& arrays) {
    const size_t m = arrays.references.size();
    frames.resize(m + 1);
    for (size_t i = 0; i < m; ++i) {
        MovingFrame& frame = frames[i + 1];
        frame.axis = vec3(arrays.axes.row(i));
        frame.anchor = vec3(arrays.anchors.row(i));
        frame.slides = arrays.slides[i] != 0;
        frame.reference = arrays.references[i];
        frame.parent = checked_index(arrays.parents[i], i + 1, "parents");
        frame.joint = checked_index(arrays.joints[i], m, "joints");
        frame.depth = 1 + frames[frame.parent].depth;
        depth = std::max(depth, 1 + frame.depth);
    }
    ratio_.assign(arrays.ratio.data, arrays.ratio.data + arrays.ratio.rows * arrays.ratio.columns);
    ratio_columns_ = arrays.ratio.columns;
    joint_offset_.assign(arrays.joint_offset.begin(), arrays.joint_offset.end());
}

void CollisionModel::add_geoms(const CollisionArrays& arrays) {
    const size_t count = arrays.kinds.size();
    const size_t vertex_count = arrays.vertices.rows;
    const std::vector<size_t> starts = checked_starts(arrays.first_vertex, vertex_count, "first_vertex");
    for (size_t i = 0; i < vertex_count; ++i) { vertices.positions.push_back(vec3(arrays.vertices.row(i))); }
    vertices.first_neighbors = checked_starts(arrays.first_neighbor, arrays.neighbors.size(), "first_neighbor");
    for (const std::int64_t neighbor : arrays.neighbors) {
        vertices.neighbors.push_back(checked_index(neighbor, vertex_count, "neighbors"));
    }
    for (size_t g = 0; g < count; ++g) {
        Geom geom;
        geom.kind = static_cast<ShapeKind>(checked_index(arrays.kinds[g], 5, "kinds"));
        geom.frame = checked_index(arrays.frames[g], frames.size(), "frames");
        geom.inflation = arrays.inflations[g];
        geom.position = vec3(arrays.positions.row(g));
        geom.axes = Rotation::from_rows(arrays.rotations.row(g));
        geom.size = vec3(arrays.sizes.row(g));
        geom.first_vertex = starts[g];
        geom.last_vertex = starts[g + 1];
        geom.semi_axes = {geom.size.x * geom.axes.x, geom.size.y * geom.axes.y, geom.size.z * geom.axes.z};
        geom.offset = dot(geom.normal(), geom.position);
        if (geom.has_vertices() && geom.first_vertex == geom.last_vertex) { throw InputError("first_vertex: a hull without vertices"); }
        geoms.push_back(geom);
    }
    if (arrays.radii.size() < count) { throw InputError("radii: need a sphere for each geom"); }
    for (size_t i = 0; i < arrays.radii.size(); ++i) {
        spheres.push_back({vec3(arrays.centers.row(i)), arrays.radii[i]});
        sphere_frames.push_back(checked_index(arrays.sphere_frames[i], frames.size(), "sphere_frames"));
    }
}

void CollisionModel::add_pairs(const CollisionArrays& arrays) {
    for (size_t p = 0; p < arrays.pairs.rows; ++p) {
        const size_t a = checked_index(arrays.pairs(p, 0), geoms.size(), "pairs");
        const size_t b = checked_index(arrays.pairs(p, 1), geoms.size(), "pairs");
        pairs.push_back({a, b, common_frame(geoms[a].frame, geoms[b].frame)});
    }
    size_t first = 0;
    for (size_t r = 0; r < arrays.group_pairs.rows; ++r) {
        const size_t a = checked_index(arrays.group_pairs(r, 0), spheres.size(), "group_pairs");
        const size_t b = checked_index(arrays.group_pairs(r, 1), spheres.size(), "group_pairs");
        const size_t last = checked_index(arrays.last_pairs[r], pairs.size() + 1, "last_pairs");
        groups.push_back({a, b, first, last, common_frame(sphere_frames[a], sphere_frames[b])});
        first = last;
    }
}

size_t CollisionModel::common_frame(size_t a, size_t b) const {
    while (a != b) {
        // Parents come before children.
        if (a > b) {
            a = frames[a].parent;
        } else {
            b = frames[b].parent;
        }
    }
    return a;
}

void CollisionModel::positions(Vector q, Result all) const {
    for (size_t i = 0; i < all.size(); ++i) {
        double position = joint_offset_[i];
        for (size_t j = 0; j < q.size(); ++j) { position += ratio(i, j) * q[j]; }
        all[i] = position;
    }
}

void CollisionModel::reduce_gradient(Vector all, Result gradient) const {
    for (size_t j = 0; j < gradient.size(); ++j) {
        gradient[j] = 0.0;
        for (size_t i = 0; i < all.size(); ++i) { gradient[j] += all[i] * ratio(i, j); }
    }
}

}  // namespace armctl
