// Regions: sets of poses of a tip, and how far a pose is from the nearest member.
//
// The coordinates of a pose in a region are three lengths and three angles of its displacement from the region's frame, each in
// bounds (D. Berenson, S. Srinivasa, J. Kuffner, "Task space regions", Int. J. Robotics Research 30(12), 2011), or three lengths and the
// tilt of one axis of the tip, about which the tip turns freely.
#pragma once
#include "chain_kinematics.hpp"

namespace armctl {

// Rotation matrix of fixed-axis roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll).
inline Rotation rotation_from_angles(double roll, double pitch, double yaw) {
    return rotation_about({0.0, 0.0, 1.0}, yaw) * (rotation_about({0.0, 1.0, 0.0}, pitch) * rotation_about({1.0, 0.0, 0.0}, roll));
}

inline Rotation transposed(const Rotation& R) { return {R.row_x(), R.row_y(), R.row_z()}; }

constexpr size_t REGION_NUMBERS = 38;

struct Region {
    Pose frame;                     // in the world
    Pose offset;                    // of the tip in the frame, where all coordinates are zero
    std::array<Bounds, 3> lengths;  // along the frame's axes
    std::array<Bounds, 3> angles;   // roll, pitch and yaw; not used with an axis
    int axis;                       // 0, 1 or 2: the axis of the tip about which it turns freely; less than 0: none
    double cone;                    // rad, by which this axis may tilt

    bool turns_freely() const { return axis >= 0; }

    // From its numbers: frame, offset, bounds of the lengths and angles, axis and cone.
    static Region from_numbers(Vector numbers) {
        const auto bounds = [&](size_t k) { return Bounds{numbers[24 + 2 * k], numbers[25 + 2 * k]}; };
        return {pose_of(numbers.first(12)),        pose_of(numbers.subspan(12, 12)), {bounds(0), bounds(1), bounds(2)},
                {bounds(3), bounds(4), bounds(5)}, static_cast<int>(numbers[36]),    numbers[37]};
    }

    // The same region in another unit of length.
    Region scaled(double factor) const {
        Region out = *this;
        out.frame.translation = factor * frame.translation;
        out.offset.translation = factor * offset.translation;
        for (Bounds& bounds : out.lengths) { bounds = {factor * bounds.low, factor * bounds.high}; }
        return out;
    }
};

// How a tip stands to a region: the way to the nearest member, and the directions in which nothing holds it.
struct RegionError {
    Vec3 lever;                      // world axes, from the tip to the point whose position is bounded
    Vec3 position;                   // in the frame's axes, from this point to its bounds
    std::array<bool, 3> is_bounded;  // whether each of these coordinates is at or outside its bounds
    Vec3 rotation;                   // rotation vector, world axes
    std::array<Vec3, 3> free;        // world axes, orthonormal: rotations that cost nothing
    int free_count;

    PoseError size() const { return {distance(position), distance(rotation)}; }

    // The part of a rotation that is held.
    Vec3 held(Vec3 omega) const {
        for (int k = 0; k < free_count; ++k) { omega -= dot(free[static_cast<size_t>(k)], omega) * free[static_cast<size_t>(k)]; }
        return omega;
    }

    // Adds a direction in which the tip may turn, unless the others contain it.
    void add_free(Vec3 direction) {
        constexpr double parallel = 1e-6;
        const Vec3 rest = held(direction);
        const double length = norm(rest);
        if (free_count < 3 && length > parallel) { free[static_cast<size_t>(free_count++)] = (1.0 / length) * rest; }
    }
};

// From a coordinate to its bounds; whether it is held there. Inside wide bounds it is free.
inline double to_bounds(Bounds bounds, double value, bool& is_held) {
    const double change = bounds.clamp(value) - value;
    is_held = change != 0.0 || bounds.low == bounds.high;
    return change;
}

// An angle, turned by whole turns to where it is nearest to the middle of its bounds.
inline double turned_near(Bounds bounds, double angle) {
    constexpr double turn = 2 * std::numbers::pi;
    return angle - turn * std::nearbyint((angle - 0.5 * (bounds.low + bounds.high)) / turn);
}

// The rotation error of a tip whose one axis may tilt by the cone.
inline void add_cone_error(const Region& region, const Rotation& tip, RegionError& error) {
    const Vec3 axis = axis_of(tip, region.axis);
    const Vec3 middle = region.frame.rotation * axis_of(region.offset.rotation, region.axis);
    const Vec3 normal = cross(axis, middle);
    const double sine = norm(normal);
    const double tilt = std::atan2(sine, dot(axis, middle));
    error.add_free(axis);
    if (tilt < region.cone) {
        for (const Vec3& each : {tip.x, tip.y, tip.z}) { error.add_free(each); }
        return;
    }
    // Turning about the middle keeps the tilt.
    if (region.cone > 0.0) { error.add_free(middle); }
    constexpr double lost_to_rounding = 1e-14;
    const Vec3 unit = sine > lost_to_rounding ? (1.0 / sine) * normal : axis_of(tip, (region.axis + 1) % 3);
    error.rotation = (tilt - region.cone) * unit;
}

// Roll, pitch and yaw of a displacement from the frame, rad.
inline Vec3 angles_in(const Region& region, const Rotation& displacement) {
    const auto& [x, y, z] = displacement;
    return {turned_near(region.angles[0], std::atan2(y.z, z.z)), std::atan2(-x.z, std::hypot(x.x, x.y)),
            turned_near(region.angles[2], std::atan2(x.y, x.x))};
}

// The angle between the axis of a tip and the middle of the cone in which it may tilt, rad.
inline double tilt_in(const Region& region, const Rotation& tip) {
    const Vec3 axis = axis_of(tip, region.axis);
    const Vec3 middle = region.frame.rotation * axis_of(region.offset.rotation, region.axis);
    return std::atan2(norm(cross(axis, middle)), dot(axis, middle));
}

// The rotation error of a tip whose roll, pitch and yaw are bounded. `displacement` is its orientation from the frame.
inline void add_angle_error(const Region& region, const Rotation& displacement, RegionError& error) {
    const Vec3& x = displacement.x;
    const auto [roll, pitch, yaw] = angles_in(region, displacement);
    std::array<bool, 3> is_held{};
    const double roll_change = to_bounds(region.angles[0], roll, is_held[0]);
    const double pitch_change = to_bounds(region.angles[1], pitch, is_held[1]);
    const double yaw_change = to_bounds(region.angles[2], yaw, is_held[2]);
    const Rotation nearest = rotation_from_angles(roll + roll_change, pitch + pitch_change, yaw + yaw_change);
    const Rotation& F = region.frame.rotation;
    // The angular velocities of the three angles: about the turned x axis, the y axis after the yaw, and the frame's z axis.
    if (!is_held[0]) { error.add_free(F * x); }
    if (!is_held[1]) { error.add_free(F * Vec3{-std::sin(yaw), std::cos(yaw), 0.0}); }
    if (!is_held[2]) { error.add_free(F.z); }
    error.rotation = F * rotation_vector(displacement, nearest);
}

inline RegionError region_error(const Region& region, const Pose& tip) {
    const Rotation& F = region.frame.rotation;
    RegionError error{};
    Rotation displacement;
    Vec3 origin;  // of the displacement, before the bounds: what coordinates of zero subtract
    if (region.turns_freely()) {
        origin = region.offset.translation;
        add_cone_error(region, tip.rotation, error);
    } else {
        const Rotation region_axes = tip.rotation * transposed(region.offset.rotation);
        error.lever = -(region_axes * region.offset.translation);
        displacement = transposed(F) * region_axes;
        add_angle_error(region, displacement, error);
    }
    const Vec3 p = F.inverse_times(tip.translation + error.lever - region.frame.translation) - origin;
    error.position = {to_bounds(region.lengths[0], p.x, error.is_bounded[0]), to_bounds(region.lengths[1], p.y, error.is_bounded[1]),
                      to_bounds(region.lengths[2], p.z, error.is_bounded[2])};
    return error;
}

// The six coordinates of a tip in a region: three lengths, m, and roll, pitch and yaw, rad; with a free axis its tilt and two zeros.
inline std::array<double, 6> coordinates_in(const Region& region, const Pose& tip) {
    const Rotation& F = region.frame.rotation;
    if (region.turns_freely()) {
        const Vec3 p = F.inverse_times(tip.translation - region.frame.translation) - region.offset.translation;
        return {p.x, p.y, p.z, tilt_in(region, tip.rotation), 0.0, 0.0};
    }
    const Rotation region_axes = tip.rotation * transposed(region.offset.rotation);
    const Vec3 p = F.inverse_times(tip.translation - region_axes * region.offset.translation - region.frame.translation);
    const auto [roll, pitch, yaw] = angles_in(region, transposed(F) * region_axes);
    return {p.x, p.y, p.z, roll, pitch, yaw};
}

// The member of a region that is nearest to a tip: first turned into the region, then moved.
inline Pose nearest_member(const Region& region, Pose tip) {
    for (int pass = 0; pass < 2; ++pass) {  // angles at their bounds within rounding after the first pass
        const RegionError error = region_error(region, tip);
        const double angle = norm(error.rotation);
        if (angle > 0.0) { tip.rotation = rotation_about((1.0 / angle) * error.rotation, angle) * tip.rotation; }
    }
    tip.translation += region.frame.rotation * region_error(region, tip).position;
    return tip;
}

}  // namespace armctl
