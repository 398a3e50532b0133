// The part of the GJK algorithm that does not depend on the shapes: the point of a simplex that is closest to the origin.
//
// Source: E. G. Gilbert, D. W. Johnson, S. S. Keerthi, "A fast procedure for computing the distance between complex objects in
// three-dimensional space", IEEE J. Robotics and Automation 4 (1988).
#pragma once
#include <algorithm>
#include <limits>
#include <optional>

#include "vectors.hpp"

namespace armctl {

constexpr double SAME_POINT_M2 = 1e-22;  // the square of a distance, m^2: nearer points are the same
constexpr int MAX_GJK_STEPS = 60;
constexpr double OVERLAP_M2 = 1e-18;  // the square of a distance between hulls that overlap, m^2

// A support point of the difference of two shapes.
struct SupportPoint {
    Vec3 difference;
    Vec3 on_first;  // the point of the first shape that belongs to it
};

class Simplex {
public:
    size_t size() const { return size_; }

    // Whether a point is one of the vertices.
    bool contains(Vec3 point) const {
        for (size_t k = 0; k < size_; ++k) {
            const Vec3 offset = vertices_[k].difference - point;
            if (dot(offset, offset) < SAME_POINT_M2) { return true; }
        }
        return false;
    }

    // At most four vertices.
    void add(const SupportPoint& vertex) { vertices_[size_++] = vertex; }

    // The point closest to the origin; the simplex is reduced to the vertices of the face that contains it. Nothing if the
    // origin is inside.
    std::optional<Vec3> reduce_to_closest_point() {
        switch (size_) {
            case 1:
                return keep_vertex(0);
            case 2:
                return closest_on_segment();
            case 3:
                return closest_on_triangle();
            default:
                return closest_on_tetrahedron();
        }
    }

    // The point of the first shape that belongs to the point closest to the origin, after the simplex has been reduced.
    Vec3 witness_on_first() const {
        Vec3 point;
        for (size_t k = 0; k < size_; ++k) { point += weights_[k] * vertices_[k].on_first; }
        return point;
    }

private:
    Vec3 closest_on_segment() {
        const Vec3 a = vertices_[0].difference;
        const Vec3 edge = vertices_[1].difference - a;
        const double along = -dot(a, edge);
        const double square = dot(edge, edge);
        if (along <= 0.0) { return keep_vertex(0); }
        if (along >= square) { return keep_vertex(1); }
        return keep_edge(0, 1, along / square);
    }

    // By the regions of C. Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    Vec3 closest_on_triangle() {
        const Vec3 a = vertices_[0].difference;
        const Vec3 b = vertices_[1].difference;
        const Vec3 c = vertices_[2].difference;
        const Vec3 ab = b - a;
        const Vec3 ac = c - a;
        const double d1 = -dot(ab, a);
        const double d2 = -dot(ac, a);
        if (d1 <= 0.0 && d2 <= 0.0) { return keep_vertex(0); }
        const double d3 = -dot(ab, b);
        const double d4 = -dot(ac, b);
        if (d3 >= 0.0 && d4 <= d3) { return keep_vertex(1); }
        const double vc = d1 * d4 - d3 * d2;
        if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0) { return keep_edge(0, 1, d1 / (d1 - d3)); }
        const double d5 = -dot(ab, c);
        const double d6 = -dot(ac, c);
        if (d6 >= 0.0 && d5 <= d6) { return keep_vertex(2); }
        const double vb = d5 * d2 - d1 * d6;
        if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0) { return keep_edge(0, 2, d2 / (d2 - d6)); }
        const double va = d3 * d6 - d5 * d4;
        if (va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0) { return keep_edge(1, 2, (d4 - d3) / ((d4 - d3) + (d5 - d6))); }
        const double scale = 1.0 / (va + vb + vc);
        const double v = vb * scale;
        const double w = vc * scale;
        weights_ = {1.0 - v - w, v, w};
        return a + v * ab + w * ac;
    }

    std::optional<Vec3> closest_on_tetrahedron() {
        constexpr size_t FACES[4][3] = {{1, 2, 3}, {0, 2, 3}, {0, 1, 3}, {0, 1, 2}};  // by the vertex opposite to the face
        Simplex nearest;
        Vec3 closest;
        double least = std::numeric_limits<double>::max();
        bool is_inside = true;
        for (size_t opposite = 0; opposite < 4; ++opposite) {
            Simplex face;
            for (const size_t vertex : FACES[opposite]) { face.add(vertices_[vertex]); }
            const Vec3 corner = face.vertices_[0].difference;
            const Vec3 normal = cross(face.vertices_[1].difference - corner, face.vertices_[2].difference - corner);
            const double side = dot(normal, vertices_[opposite].difference - corner);
            const double origin_side = -dot(normal, corner);
            const bool sees_origin = origin_side * side < 0.0;
            const bool is_flat = side == 0.0;
            if (!sees_origin && !is_flat) { continue; }
            is_inside = false;
            const Vec3 point = face.closest_on_triangle();
            const double square = dot(point, point);
            if (square < least) {
                least = square;
                closest = point;
                nearest = face;
            }
        }
        if (is_inside) { return std::nullopt; }
        *this = nearest;
        return closest;
    }

    Vec3 keep_vertex(size_t i) {
        vertices_[0] = vertices_[i];
        weights_[0] = 1.0;
        size_ = 1;
        return vertices_[0].difference;
    }

    Vec3 keep_edge(size_t i, size_t j, double share) {
        vertices_[0] = vertices_[i];
        vertices_[1] = vertices_[j];
        weights_ = {1.0 - share, share};
        size_ = 2;
        const Vec3 start = vertices_[0].difference;
        return start + share * (vertices_[1].difference - start);
    }

    std::array<SupportPoint, 4> vertices_;
    std::array<double, 3> weights_{};  // of the vertices in the closest point
    size_t size_ = 0;
};

}  // namespace armctl
