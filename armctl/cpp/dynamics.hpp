// Equations of motion of an arm.
//
//     tau = M(q) a + bias(q, v) + springs(q) + damping(v) + friction(v, a)
//
// Sources: Featherstone, Rigid Body Dynamics Algorithms (2008): recursive Newton-Euler (5.3), composite rigid bodies (6.2).
#pragma once
#include "arm_model.hpp"

namespace armctl {

// How a body moves, in its own axes.
struct BodyMotion {
    Vec3 omega;   // angular velocity
    Vec3 alpha;   // angular acceleration
    Vec3 linear;  // acceleration of the origin minus gravity
};

// The functions of the dynamics with their scratch memory: one object for each thread. No call allocates memory.
//
// Some functions evaluate the arm where an earlier one has placed it: `place`, `gravity`, `inverse_dynamics` or `tip_motion`.
class Dynamics {
public:
    explicit Dynamics(Model model);

    const ArmModel& model() const { return *model_; }

    // Places the joints at q (n,) rad.
    void place(Vector q);

    // The torque that holds the arm at rest, (n,) N m, with gravity compensation and springs. Places the joints.
    void gravity(Vector q, Result tau);

    // The torque that changes the velocity by a dt over the coming control period, (n,) N m, without dry friction. Places the
    // joints.
    void inverse_dynamics(Vector q, Vector v, Vector a, Result tau);

    // Adds the torque against dry friction on the reference motion, where `inverse_dynamics` has placed the joints.
    void add_friction(Vector v_ref, Vector a_ref, Result tau);

    // Adds the torque of the linear damping at the velocities v.
    void add_linear_damping(Vector v, Result tau) const;

    // C(q, v) w (n,), with the C of Christoffel's symbols, where the joints are placed.
    void coriolis_product(Vector v, Vector w, Result tau);

    // The (n, n) mass matrix with armature, kg m^2, where the joints are placed.
    void mass_matrix(MatrixResult M);

    // Adds to a mass matrix what linear damping that is implicit in velocity adds to the inertia in one step.
    void add_step_inertia(MatrixResult M) const;

    // Finds the frames of all joints in the world, where the joints are placed, or at q (n,).
    void locate();
    void locate(Vector q) {
        place(q);
        locate();
    }

    // The pose of the tip in the world, after `locate`.
    Pose tip() const;

    // The (6, n) Jacobian of the tip, linear first, world axes, after `locate`; valid until the next call.
    Matrix tip_jacobian();

    // J(q)^T wrench, (n,) N m: what a wrench (6,) on the tip does to the joints. Places and locates the joints.
    void tip_force(Vector q, Vector wrench, Result tau);

    // The motion of the tip in its own axes; in the middle of the control period where the arm moves continuously. Places and
    // locates the joints.
    BodyMotion tip_motion(Vector q, Vector v, Vector a);

private:
    // Mass, first moment and inertia about the origin of a joint's frame, of the link and all links behind it.
    struct CompositeInertia {
        double mass;
        Vec3 moment;
        Symmetric inertia;
    };

    struct Link {
        Pose placement;  // in the parent's frame
        Pose T_world_joint;
        double position;
        double velocity;
        double acceleration;
        BodyMotion motion;
        Vec3 gravity;  // in the joint's frame
        Vec3 force;
        Vec3 moment;
        double torque;
        CompositeInertia composite;
    };

    void set_velocities(Vector v);
    void set_accelerations(Vector a);
    void smooth_torque(Vector v, Vector a, Result tau);
    void newton_euler();
    void move_link(size_t j);
    void load_link(size_t j);
    void add_springs();
    void torques_of_arm(Result tau) const;
    void implicit_change(Vector v, Vector a, Result change);
    void add_inertia_row(size_t j, MatrixResult M) const;
    void add_coupling(size_t j, size_t other, double inertia, MatrixResult M) const;
    double joint_value(size_t joint, Vector x) const;
    static CompositeInertia own_inertia(const Joint& joint);
    static CompositeInertia in_parent(const CompositeInertia& inertia, const Pose& placement);

    Model model_;
    std::vector<Link> links_;
    // Scratch memory, (n,) each and (n, n).
    Numbers middle_position_, middle_velocity_, sum_, difference_, change_;
    DenseMatrix inertia_, J_;
};

}  // namespace armctl
