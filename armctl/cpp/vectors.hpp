// Vectors, rotations, poses and symmetric matrices of three dimensions, as values.
//
// Additions run from left to right, as written in the formulas. Together with -ffp-contract=off this gives the same bits on
// every compiler.
#pragma once
#include <array>
#include <cmath>

#include "spans.hpp"

namespace armctl {

struct Vec3 {
    double x = 0.0;
    double y = 0.0;
    double z = 0.0;

    void store(Result numbers) const {
        numbers[0] = x;
        numbers[1] = y;
        numbers[2] = z;
    }
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec3& operator+=(Vec3& a, Vec3 b) { return a = a + b; }
inline Vec3& operator-=(Vec3& a, Vec3 b) { return a = a - b; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline double norm(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// A vector from three numbers of the caller.
inline Vec3 vec3(Vector numbers) { return {numbers[0], numbers[1], numbers[2]}; }

// A symmetric 3x3 matrix.
struct Symmetric {
    double xx = 0.0;
    double yy = 0.0;
    double zz = 0.0;
    double xy = 0.0;
    double xz = 0.0;
    double yz = 0.0;
};

inline Vec3 operator*(const Symmetric& m, Vec3 a) {
    return {m.xx * a.x + m.xy * a.y + m.xz * a.z, m.xy * a.x + m.yy * a.y + m.yz * a.z, m.xz * a.x + m.yz * a.y + m.zz * a.z};
}

inline Symmetric& operator+=(Symmetric& a, const Symmetric& b) {
    return a = {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
}

// The orientation of a frame: its axes, in the frame around it. They are the columns of the rotation matrix.
struct Rotation {
    Vec3 x{1.0, 0.0, 0.0};
    Vec3 y{0.0, 1.0, 0.0};
    Vec3 z{0.0, 0.0, 1.0};

    // From the nine numbers of a rotation matrix, row by row.
    static Rotation from_rows(Vector m) { return {{m[0], m[3], m[6]}, {m[1], m[4], m[7]}, {m[2], m[5], m[8]}}; }

    Vec3 row_x() const { return {x.x, y.x, z.x}; }
    Vec3 row_y() const { return {x.y, y.y, z.y}; }
    Vec3 row_z() const { return {x.z, y.z, z.z}; }

    void to_rows(Result m) const {
        row_x().store(m);
        row_y().store(m.subspan(3));
        row_z().store(m.subspan(6));
    }

    // A vector of this frame, in the frame around it: R a.
    Vec3 operator*(Vec3 a) const { return {dot(row_x(), a), dot(row_y(), a), dot(row_z(), a)}; }

    // A vector of the frame around it, in this frame: R^T a.
    Vec3 inverse_times(Vec3 a) const { return {dot(x, a), dot(y, a), dot(z, a)}; }

    Rotation operator*(const Rotation& other) const { return {*this * other.x, *this * other.y, *this * other.z}; }

    // This rotation after a rotation about its own z axis.
    Rotation turned_about_z(double angle) const {
        const double cos = std::cos(angle);
        const double sin = std::sin(angle);
        return {cos * x + sin * y, cos * y - sin * x, z};
    }
};

// The rotation by an angle about a unit axis, by Rodrigues' formula.
inline Rotation rotation_about(Vec3 axis, double angle) {
    const double sine = std::sin(angle);
    const double cosine = std::cos(angle);
    const double u = 1.0 - cosine;
    const auto [x, y, z] = axis;
    return {{cosine + x * x * u, y * x * u + z * sine, z * x * u - y * sine},
            {x * y * u - z * sine, cosine + y * y * u, z * y * u + x * sine},
            {x * z * u + y * sine, y * z * u - x * sine, cosine + z * z * u}};
}

// R I R^T: a symmetric matrix of a frame, in the frame around it.
inline Symmetric rotated(const Rotation& R, const Symmetric& I) {
    // The columns of R^T are the rows of R.
    const Vec3 column_x = R * (I * R.row_x());
    const Vec3 column_y = R * (I * R.row_y());
    const Vec3 column_z = R * (I * R.row_z());
    return {column_x.x, column_y.y, column_z.z, column_x.y, column_x.z, column_y.z};
}

// The pose of a frame in the frame around it.
struct Pose {
    Rotation rotation;
    Vec3 translation;

    Vec3 operator*(Vec3 point) const { return translation + rotation * point; }
    Pose operator*(const Pose& other) const { return {rotation * other.rotation, *this * other.translation}; }

    // The same frame in another frame; both are given in the frame around them.
    Pose seen_from(const Pose& other) const {
        const Rotation& R = other.rotation;
        return {{R.inverse_times(rotation.x), R.inverse_times(rotation.y), R.inverse_times(rotation.z)},
                R.inverse_times(translation - other.translation)};
    }
};

// A pose from twelve numbers of the caller: the rotation row by row, and the position.
inline Pose pose_of(Vector numbers) { return {Rotation::from_rows(numbers.first(9)), vec3(numbers.subspan(9))}; }

// A velocity of a rigid body, or a column of a Jacobian: linear part first.
struct Twist {
    Vec3 linear;
    Vec3 angular;
};

inline Twist operator*(double s, const Twist& a) { return {s * a.linear, s * a.angular}; }
inline Twist& operator+=(Twist& a, const Twist& b) {
    a.linear += b.linear;
    a.angular += b.angular;
    return a;
}
inline double dot(const Twist& a, const Twist& b) {
    return dot(a.linear, b.linear) + a.angular.x * b.angular.x + a.angular.y * b.angular.y + a.angular.z * b.angular.z;
}

inline std::array<double, 6> numbers(const Twist& twist) {
    return {twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y, twist.angular.z};
}

struct Quaternion {
    double w = 1.0;
    double x = 0.0;
    double y = 0.0;
    double z = 0.0;
};

// The unit quaternion, w >= 0, of a rotation by Shepperd's method: the largest component is found first.
inline Quaternion quaternion(const Rotation& R) {
    const double trace = R.x.x + R.y.y + R.z.z;
    Quaternion quat;
    if (trace >= R.x.x && trace >= R.y.y && trace >= R.z.z) {
        quat = {1.0 + trace, R.y.z - R.z.y, R.z.x - R.x.z, R.x.y - R.y.x};
    } else if (R.x.x >= R.y.y && R.x.x >= R.z.z) {
        quat = {R.y.z - R.z.y, 1.0 + R.x.x - R.y.y - R.z.z, R.x.y + R.y.x, R.x.z + R.z.x};
    } else if (R.y.y >= R.z.z) {
        quat = {R.z.x - R.x.z, R.y.x + R.x.y, 1.0 + R.y.y - R.z.z - R.x.x, R.y.z + R.z.y};
    } else {
        quat = {R.x.y - R.y.x, R.z.x + R.x.z, R.z.y + R.y.z, 1.0 + R.z.z - R.x.x - R.y.y};
    }
    double scale = 1.0 / std::sqrt(quat.w * quat.w + quat.x * quat.x + quat.y * quat.y + quat.z * quat.z);
    if (quat.w < 0.0) { scale = -scale; }
    return {quat.w * scale, quat.x * scale, quat.y * scale, quat.z * scale};
}

// The rotation vector, rad, of at most half a turn, in the axes around them, that turns one orientation to another.
inline Vec3 rotation_vector(const Rotation& from, const Rotation& to) {
    const Quaternion turn = quaternion({to * from.row_x(), to * from.row_y(), to * from.row_z()});  // of to from^T
    const double sine = std::sqrt(turn.x * turn.x + turn.y * turn.y + turn.z * turn.z);
    const double scale = sine > 0.0 ? 2.0 * std::atan2(sine, turn.w) / sine : 2.0;
    return {scale * turn.x, scale * turn.y, scale * turn.z};
}

// The translation, m, and the rotation vector, rad, from a pose to another, in the axes around them.
inline Twist difference(const Pose& from, const Pose& to) {
    return {to.translation - from.translation, rotation_vector(from.rotation, to.rotation)};
}

}  // namespace armctl
