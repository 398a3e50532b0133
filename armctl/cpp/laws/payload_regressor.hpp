// The regressor of a rigid body at the tip.
//
// The ten parameters are the mass m, the first moment m c (3,) and the second moments S, xx yy zz xy xz yz, kg m^2, of the body
// in the tip's frame. Its inertia about the tip is tr(S) 1 - S. The torque is linear in them.
//
// Source: Atkeson, An, Hollerbach, "Estimation of inertial parameters of manipulator loads and links" (1986).
#pragma once
#include "../dynamics.hpp"

namespace armctl {

constexpr size_t body_parameters = 10;

// The torques of a body at the tip per parameter, the first ten columns of Y (n, 10 or more), at a motion of the arm.
//
// A point x of the body has the acceleration a + A x with A = [alpha] + [omega]^2 and a that of the tip minus gravity. Its
// force and moment about the tip are therefore m a + A h and h x a + sum over i, j of S_ij e_i x A e_j.
inline void payload_regressor(Dynamics& dynamics, Vector q, Vector v, Vector a, MatrixResult Y) {
    const BodyMotion motion = dynamics.tip_motion(q, v, a);
    const Rotation rotation = dynamics.tip().rotation;
    const Matrix J = dynamics.tip_jacobian();
    const Vec3 w = motion.omega;
    const Vec3 alpha = motion.alpha;
    const double square = dot(w, w);
    const std::array<Vec3, 3> A{{
        // its columns
        {w.x * w.x - square, w.y * w.x + alpha.z, w.z * w.x - alpha.y},
        {w.x * w.y - alpha.z, w.y * w.y - square, w.z * w.y + alpha.x},
        {w.x * w.z + alpha.y, w.y * w.z - alpha.x, w.z * w.z - square},
    }};
    for (size_t i = 0; i < Y.rows; ++i) {
        const Vec3 linear = rotation.inverse_times({J(0, i), J(1, i), J(2, i)});
        const Vec3 angular = rotation.inverse_times({J(3, i), J(4, i), J(5, i)});
        // angular . (e_k x a) = e_k . (a x angular)
        const Vec3 moment = cross(motion.linear, angular);
        // Component i of vector k is angular . (e_i x A e_k).
        const Vec3 x = cross(A[0], angular);
        const Vec3 y = cross(A[1], angular);
        const Vec3 z = cross(A[2], angular);
        const std::array<double, body_parameters> torques{
            dot(linear, motion.linear),
            moment.x + dot(linear, A[0]),
            moment.y + dot(linear, A[1]),
            moment.z + dot(linear, A[2]),
            x.x,
            y.y,
            z.z,
            y.x + x.y,
            z.x + x.z,
            z.y + y.z,
        };
        copy(torques, Y.row(i));
    }
}

}  // namespace armctl
