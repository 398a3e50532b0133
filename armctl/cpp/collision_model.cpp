#include "collision_model.hpp"

#include <algorithm>
#include <cmath>
#include <map>

#include "errors.hpp"

namespace armctl {

namespace {

// Bounding spheres are computed with rounding errors.
constexpr double ROUNDING = 1.0 + 1e-12;

size_t checked_index(std::int64_t index, size_t count, const char* message) {
    if (index < 0 || static_cast<size_t>(index) >= count) { throw InputError(message); }
    return static_cast<size_t>(index);
}

// Rows where the lists of each element start, and the end of the last one.
std::vector<size_t> checked_starts(Integers starts, size_t count, const char* message) {
    std::vector<size_t> checked;
    checked.reserve(starts.size());
    for (const std::int64_t start : starts) { checked.push_back(checked_index(start, count + 1, message)); }
    if (!std::is_sorted(checked.begin(), checked.end()) || checked.front() != 0 || checked.back() != count) { throw InputError(message); }
    return checked;
}

}  // namespace

CollisionModel::CollisionModel(const CollisionArrays& arrays) {
    add_frames(arrays);
    add_geoms(arrays);
    add_groups();
    std::vector<GeomPair> given(arrays.pairs.rows);
    for (size_t p = 0; p < given.size(); ++p) {
        given[p].a = checked_index(arrays.pairs(p, 0), geoms.size(), "pairs: a row of geoms does not exist");
        given[p].b = checked_index(arrays.pairs(p, 1), geoms.size(), "pairs: a row of geoms does not exist");
    }
    set_pairs(std::move(given));
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
        frame.parent = checked_index(arrays.parents[i], i + 1, "parents: a joint comes before its parent");
        frame.joint = checked_index(arrays.joints[i], m, "joints: a row of the ratio does not exist");
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
    const std::vector<size_t> starts = checked_starts(arrays.first_vertex, vertex_count, "first_vertex: no rows of vertices");
    for (size_t i = 0; i < vertex_count; ++i) { vertices.positions.push_back(vec3(arrays.vertices.row(i))); }
    vertices.first_neighbors = checked_starts(arrays.first_neighbor, arrays.neighbors.size(), "first_neighbor: no rows of neighbors");
    for (const std::int64_t neighbor : arrays.neighbors) {
        vertices.neighbors.push_back(checked_index(neighbor, vertex_count, "neighbors: a vertex does not exist"));
    }
    for (size_t g = 0; g < count; ++g) {
        Geom geom;
        geom.kind = static_cast<ShapeKind>(checked_index(arrays.kinds[g], 5, "kinds: a shape does not exist"));
        geom.frame = checked_index(arrays.frames[g], frames.size(), "frames: a frame does not exist");
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
        spheres.push_back({vec3(arrays.centers.row(g)), arrays.bounds[g] * ROUNDING});
        sphere_frames.push_back(geom.frame);
        group_of_geom_.push_back(g);
    }
}

void CollisionModel::add_groups() {
    std::map<size_t, std::vector<size_t>> members;
    for (size_t g = 0; g < geoms.size(); ++g) {
        if (geoms[g].frame > 0) { members[geoms[g].frame].push_back(g); }
    }
    for (const auto& [frame, moving] : members) {
        std::vector<BoundingSphere> inside;
        for (const size_t g : moving) {
            inside.push_back(spheres[g]);
            group_of_geom_[g] = spheres.size();
        }
        BoundingSphere around = bounding_sphere(inside);
        around.radius *= ROUNDING;
        spheres.push_back(around);
        sphere_frames.push_back(frame);
    }
}

void CollisionModel::set_pairs(std::vector<GeomPair> given) {
    const auto groups_of = [this](const GeomPair& pair) { return std::pair(group_of_geom_[pair.a], group_of_geom_[pair.b]); };
    std::stable_sort(given.begin(), given.end(),
                     [&groups_of](const GeomPair& p, const GeomPair& q) { return groups_of(p) < groups_of(q); });
    pairs = std::move(given);
    groups.clear();
    for (size_t p = 0; p < pairs.size(); ++p) {
        pairs[p].common = common_frame(geoms[pairs[p].a].frame, geoms[pairs[p].b].frame);
        const auto [a, b] = groups_of(pairs[p]);
        if (groups.empty() || groups.back().a != a || groups.back().b != b) { groups.push_back({a, b, p, p, pairs[p].common}); }
        groups.back().last_pair = p + 1;
    }
}

std::shared_ptr<const CollisionModel> CollisionModel::with_pairs(Integers keep) const {
    auto fewer = std::make_shared<CollisionModel>(*this);
    std::vector<GeomPair> kept;
    for (size_t p = 0; p < pairs.size(); ++p) {
        if (keep[p] != 0) { kept.push_back(pairs[p]); }
    }
    fewer->set_pairs(std::move(kept));
    return fewer;
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

size_t CollisionModel::frame_of(size_t joint) const {
    for (size_t i = 1; i < frames.size(); ++i) {
        if (frames[i].joint == joint) { return i; }
    }
    throw InputError("joint: there is no such joint");
}

std::vector<size_t> CollisionModel::joints_between(size_t pair) const {
    std::vector<size_t> between;
    for (size_t frame : {geoms[pairs[pair].a].frame, geoms[pairs[pair].b].frame}) {
        while (frame != pairs[pair].common) {
            between.push_back(frames[frame].joint);
            frame = frames[frame].parent;
        }
    }
    return between;
}

void CollisionModel::positions(Vector q, Result all) const {
    for (size_t i = 0; i < all.size(); ++i) {
        double position = joint_offset_[i];
        for (size_t j = 0; j < q.size(); ++j) { position += ratio(i, j) * q[j]; }
        all[i] = position;
    }
}

void CollisionModel::speeds(Vector v, Result all) const {
    for (size_t i = 0; i < all.size(); ++i) {
        all[i] = 0.0;
        for (size_t j = 0; j < v.size(); ++j) { all[i] += ratio(i, j) * v[j]; }
    }
}

void CollisionModel::bound_moves(Vector moves, Result all) const {
    for (size_t i = 0; i < all.size(); ++i) {
        all[i] = 0.0;
        for (size_t j = 0; j < moves.size(); ++j) { all[i] += std::abs(ratio(i, j)) * moves[j]; }
    }
}

void CollisionModel::reduce_gradient(Vector all, Result gradient) const {
    for (size_t j = 0; j < gradient.size(); ++j) {
        gradient[j] = 0.0;
        for (size_t i = 0; i < all.size(); ++i) { gradient[j] += all[i] * ratio(i, j); }
    }
}

}  // namespace armctl
