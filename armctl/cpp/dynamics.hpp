// Equations of motion of an arm.
//
//     tau = M(q) a + bias(q, v) + springs(q) + damping(v) + friction(v, a)
//
// Sources: Featherstone, Rigid Body Dynamics Algorithms (2008): recursive Newton-Euler (5.3), composite rigid bodies (6.2).
#pragma once
#include <optional>

#include "arm_model.hpp"

namespace armctl {

// How a body moves, in its own axes.
struct BodyMotion {
    Vec3 omega;   // angular velocity
    Vec3 alpha;   // angular acceleration
    Vec3 linear;  // acceleration of the origin minus gravity
};

// A frame that a joint carries; joint -1 is the world.
struct CarriedFrame {
    int joint = -1;
    Pose placement;  // in the joint's frame
};

// The functions of the dynamics with their scratch memory: one object for each thread. No call allocates memory.
//
// Some functions evaluate the arm where an earlier one has placed it: `place`, `gravity`, `inverse_dynamics` or `tip_motion`.
class Dynamics {
public:
    explicit Dynamics(Model model)
        : model_(std::move(model)), links_(model_->joints.size()), middle_position_(model_->n()), middle_velocity_(model_->n()),
          sum_(model_->n()), change_(model_->n()), inertia_(model_->n(), model_->n()), J_(6, model_->n()) {
        if (model_->closure) { closed_.emplace(model_->closure); }
    }

    const ArmModel& model() const { return *model_; }

    // Places the joints at q (n,) rad.
    void place(Vector q) {
        if (closed_) { closed_->close(q); }
        for (size_t j = 0; j < links_.size(); ++j) { place(j, q); }
    }

    // The torque that holds the arm at rest, (n,) N m, with gravity compensation and springs. Places the joints.
    void gravity(Vector q, Result tau) {
        place(q);
        std::ranges::fill(change_, 0.0);
        smooth_torque(change_, change_, tau);
    }

    // The torque that changes the velocity by a dt over the coming control period, (n,) N m, without dry friction. Places the
    // joints.
    void inverse_dynamics(Vector q, Vector v, Vector a, Result tau) {
        place_in_middle(q, v, a);
        smooth_torque(middle_velocity_, a, tau);
        if (model_->step == 0.0) { return; }
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] += model_->step_inertia(i) * a[i]; }
        if (model_->has_implicit_nonlinear) {
            implicit_change(v, a);
            for (size_t i = 0; i < tau.size(); ++i) { tau[i] += model_->step * change_[i]; }
        }
    }

    // Adds the torque against dry friction on the reference motion, where `inverse_dynamics` has placed the joints.
    void add_friction(Vector v_ref, Vector a_ref, Result tau) {
        if (!model_->has_friction) { return; }
        const double half = model_->half_step;
        std::ranges::fill(change_, 0.0);
        if (half == 0.0 && model_->step != 0.0) {
            // In a discrete step, the friction constraint acts on the acceleration before implicit forces.
            if (model_->has_implicit_nonlinear) { implicit_change(v_ref, a_ref); }
            for (size_t i = 0; i < tau.size(); ++i) {
                const double damping = model_->has_implicit_damping ? model_->drives[i].damping.linear : 0.0;
                change_[i] = model_->step * (damping * a_ref[i] + change_[i]);
            }
            mass_matrix(inertia_);
            factorize(inertia_);
            solve(inertia_, change_);
        }
        for (size_t i = 0; i < tau.size(); ++i) {
            tau[i] += model_->drives[i].friction.torque(v_ref[i] + half * a_ref[i], a_ref[i] + change_[i]);
        }
        if (closed_) { add_passive_friction(v_ref, a_ref, tau); }
    }

    // Adds the torque of the linear damping at the velocities v.
    void add_linear_damping(Vector v, Result tau) const {
        for (size_t i = 0; i < v.size(); ++i) { tau[i] += model_->drives[i].damping.linear * v[i]; }
    }

    // The (n, n) mass matrix with armature, kg m^2, where the joints are placed.
    void mass_matrix(MatrixResult M) {
        std::ranges::fill(M.numbers(), 0.0);
        for (size_t i = 0; i < M.rows; ++i) { M(i, i) = model_->drives[i].armature; }
        for (size_t j = 0; j < links_.size(); ++j) { links_[j].composite = own_inertia(model_->joints[j]); }
        for (size_t j = links_.size(); j-- > 0;) {
            add_inertia_row(j, M);
            const int parent = model_->joints[j].parent;
            if (parent >= 0) {
                CompositeInertia& sum = links_[static_cast<size_t>(parent)].composite;
                const CompositeInertia added = in_parent(links_[j].composite, links_[j].placement);
                sum.mass += added.mass;
                sum.moment += added.moment;
                sum.inertia += added.inertia;
            }
        }
    }

    // Adds to a mass matrix what linear damping that is evaluated at the end of the period adds to the inertia.
    void add_step_inertia(MatrixResult M) const {
        for (size_t i = 0; i < M.rows; ++i) { M(i, i) += model_->step_inertia(i); }
    }

    // Replaces torques (n,) by the accelerations that they add over a control period, where the joints are placed.
    void accelerate(Result torques) {
        mass_matrix(inertia_);
        add_step_inertia(inertia_);
        factorize(inertia_);
        solve(inertia_, torques);
    }

    // Finds the frames of all joints in the world, where the joints are placed.
    void locate() {
        for (size_t j = 0; j < links_.size(); ++j) { locate(j); }
    }

    void locate(Vector q) {
        place(q);
        locate();
    }

    // The same for some joints only, parents before children; the frames of the others are not valid.
    void locate(Vector q, std::span<const size_t> joints) {
        if (closed_) { closed_->close(q); }
        for (const size_t j : joints) {
            place(j, q);
            locate(j);
        }
    }

    // The pose of the tip in the world, after `locate`.
    Pose tip() const { return links_[model_->chain_length - 1].T_world_joint * model_->T_last_tip; }

    // The frame of a joint in the world, after `locate`; that of joint -1 is the world's.
    Pose joint_frame(int joint) const { return joint < 0 ? Pose{} : links_[static_cast<size_t>(joint)].T_world_joint; }

    // The pose of a frame in the world, after `locate`.
    Pose pose_of(const CarriedFrame& frame) const { return joint_frame(frame.joint) * frame.placement; }

    // The (6, n) Jacobian of the tip, linear first, world axes, after `locate`; valid until the next call.
    Matrix tip_jacobian() { return jacobian_of({static_cast<int>(model_->chain_length) - 1, model_->T_last_tip}); }

    // The same of any frame.
    Matrix jacobian_of(const CarriedFrame& frame) {
        std::ranges::fill(J_.numbers(), 0.0);
        add_twists_to(frame.joint, pose_of(frame).translation);
        return J_;
    }

    // Adds `sign` times the Jacobian, (n,) columns, of a point in the world that a joint carries, after `locate`.
    void add_jacobian(int joint, Vec3 point, double sign, std::span<Twist> J) const {
        for (; joint >= 0; joint = model_->joints[static_cast<size_t>(joint)].parent) {
            const size_t j = static_cast<size_t>(joint);
            const Twist caused = twist(j, point, sign);
            if (model_->is_plain) {
                J[j] += caused;
                continue;
            }
            for (size_t i = 0; i < J.size(); ++i) {
                if (ratio(j, i) != 0.0) { J[i] += ratio(j, i) * caused; }
            }
        }
    }

    // J(q)^T wrench, (n,) N m: what a wrench (6,) on the tip does to the joints. Places and locates the joints.
    void tip_force(Vector q, Vector wrench, Result tau) {
        locate(q);
        tip_jacobian();
        for (size_t i = 0; i < tau.size(); ++i) { tau[i] = dot(J_.column(i), wrench); }
    }

    // The motion of the tip in its own axes; in the middle of the control period where the arm moves continuously. Places and
    // locates the joints.
    BodyMotion tip_motion(Vector q, Vector v, Vector a) {
        place_in_middle(q, v, a);
        set(&Link::velocity, middle_velocity_);
        set(&Link::acceleration, a);
        if (closed_) { add_loop_acceleration(middle_velocity_); }
        for (size_t j = 0; j < model_->chain_length; ++j) { move_link(j); }
        locate();
        const BodyMotion& last = links_[model_->chain_length - 1].motion;
        const Vec3 t = model_->T_last_tip.translation;
        const Rotation& R = model_->T_last_tip.rotation;
        const Vec3 linear = last.linear + cross(last.omega, cross(last.omega, t)) + cross(last.alpha, t);
        return {R.inverse_times(last.omega), R.inverse_times(last.alpha), R.inverse_times(linear)};
    }

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

    // Adds to the scratch Jacobian the twists of a point in the world which the joints from the base to a joint cause, in this order:
    // where one of the arm's n moves several of them, the order decides the last bits.
    void add_twists_to(int joint, Vec3 point) {
        if (joint < 0) { return; }
        add_twists_to(model_->joints[static_cast<size_t>(joint)].parent, point);
        add_twist(static_cast<size_t>(joint), point, 1.0, J_);
    }

    // Places a joint at q (n,), after the loops have been closed.
    void place(size_t j, Vector q) {
        const Joint& joint = model_->joints[j];
        Link& link = links_[j];
        link.position = position(j, q);
        if (joint.slides) {
            link.placement = {joint.rotation, joint.translation + link.position * joint.rotation.z};
        } else {
            link.placement = {joint.rotation.turned_about_z(link.position), joint.translation};
        }
    }

    // Finds the frame of a joint in the world, where it is placed, after that of its parent.
    void locate(size_t j) {
        const int parent = model_->joints[j].parent;
        const Pose& placement = links_[j].placement;
        links_[j].T_world_joint = parent < 0 ? placement : links_[static_cast<size_t>(parent)].T_world_joint * placement;
    }

    // `sign` times the twist of a point in the world which a joint causes at a speed of 1.
    Twist twist(size_t j, Vec3 point, double sign) const {
        const Pose& T = links_[j].T_world_joint;
        const Vec3 z = sign * T.rotation.z;
        return model_->joints[j].slides ? Twist{z, {}} : Twist{cross(z, point - T.translation), z};
    }

    // Adds `sign` times the twists of a point in the world which a joint causes, to a Jacobian (6, n).
    void add_twist(size_t j, Vec3 point, double sign, MatrixResult J) const {
        const std::array<double, 6> twist = numbers(this->twist(j, point, sign));
        for (size_t i = 0; i < J.columns; ++i) {
            const double ratio = model_->is_plain ? (i == j ? 1.0 : 0.0) : this->ratio(j, i);
            if (ratio == 0.0) { continue; }
            for (size_t row = 0; row < 6; ++row) { J(row, i) += ratio * twist[row]; }
        }
    }

    // Places the joints where they are in the middle of a continuous control period, with velocities there.
    void place_in_middle(Vector q, Vector v, Vector a) {
        const double half = model_->half_step;
        for (size_t i = 0; i < q.size(); ++i) {
            middle_position_[i] = q[i] + half * v[i];
            middle_velocity_[i] = v[i] + half * a[i];
        }
        place(middle_position_);
    }

    // Sets the velocities or accelerations of all joints from those of the arm's n.
    void set(double Link::* value, Vector x) {
        for (size_t j = 0; j < links_.size(); ++j) { links_[j].*value = joint_value(j, x); }
    }

    // The torque in continuous time, at the placed positions.
    void smooth_torque(Vector v, Vector a, Result tau) {
        set(&Link::velocity, v);
        set(&Link::acceleration, a);
        if (closed_) { add_loop_acceleration(v); }
        newton_euler();
        if (model_->has_springs) { add_springs(); }
        if (closed_) { add_passive(); }
        torques_of_arm(tau);
        for (size_t i = 0; i < tau.size(); ++i) {
            const Drive& drive = model_->drives[i];
            tau[i] += drive.armature * a[i] + drive.damping.damping(v[i]) * v[i];
        }
    }

    // Torques of all joints at their positions, velocities and accelerations, without armature.
    void newton_euler() {
        for (size_t j = 0; j < links_.size(); ++j) {
            move_link(j);
            load_link(j);
        }
        for (size_t j = links_.size(); j-- > 0;) {
            const Joint& joint = model_->joints[j];
            Link& link = links_[j];
            link.torque = joint.slides ? link.force.z : link.moment.z;
            if (joint.parent >= 0) {
                Link& parent = links_[static_cast<size_t>(joint.parent)];
                const Vec3 force = link.placement.rotation * link.force;
                parent.force += force;
                parent.moment += link.placement.rotation * link.moment + cross(link.placement.translation, force);
            }
        }
    }

    // Velocity and acceleration of a link from those of its parent.
    void move_link(size_t j) {
        const Joint& joint = model_->joints[j];
        Link& link = links_[j];
        const Rotation& R = link.placement.rotation;
        BodyMotion motion;
        if (joint.parent >= 0) {
            const BodyMotion& parent = links_[static_cast<size_t>(joint.parent)].motion;
            const Vec3 t = link.placement.translation;
            motion.omega = R.inverse_times(parent.omega);
            motion.alpha = R.inverse_times(parent.alpha);
            motion.linear = R.inverse_times(parent.linear + cross(parent.omega, cross(parent.omega, t)) + cross(parent.alpha, t));
        } else {
            motion.linear = R.inverse_times(-model_->gravity);
        }
        const double v = link.velocity;
        if (joint.slides) {
            motion.linear.x += 2.0 * motion.omega.y * v;
            motion.linear.y -= 2.0 * motion.omega.x * v;
            motion.linear.z += link.acceleration;
        } else {
            motion.alpha.x += motion.omega.y * v;
            motion.alpha.y -= motion.omega.x * v;
            motion.alpha.z += link.acceleration;
            motion.omega.z += v;
        }
        link.motion = motion;
    }

    // Force and moment about the joint's origin that give a link its acceleration: the equations of Newton and Euler.
    void load_link(size_t j) {
        const Joint& joint = model_->joints[j];
        Link& link = links_[j];
        const Vec3 c = joint.center;
        const Vec3 w = link.motion.omega;
        const Vec3 d = link.motion.alpha;
        link.force = joint.mass * (link.motion.linear + cross(w, cross(w, c)) + cross(d, c));
        link.moment = joint.inertia * d + cross(w, joint.inertia * w) + cross(c, link.force);
        if (model_->has_lift) {
            const Vec3 above = joint.parent >= 0 ? links_[static_cast<size_t>(joint.parent)].gravity : model_->gravity;
            link.gravity = link.placement.rotation.inverse_times(above);
            link.force += joint.lifted_mass * link.gravity;
            link.moment += cross(joint.lifted_moment, link.gravity);
        }
    }

    void add_springs() {
        for (size_t j = 0; j < links_.size(); ++j) {
            const Joint& joint = model_->joints[j];
            links_[j].torque += joint.stiffness.spring(links_[j].position - joint.spring_rest);
        }
    }

    // Torques of all joints as those of the arm's n, by virtual work.
    void torques_of_arm(Result tau) const {
        for (size_t i = 0; i < tau.size(); ++i) {
            if (model_->is_plain) {
                tau[i] = links_[i].torque;
                continue;
            }
            tau[i] = 0.0;
            for (size_t j = 0; j < links_.size(); ++j) { tau[i] += ratio(j, i) * links_[j].torque; }
        }
    }

    // Rate at which implicit forces other than linear damping change during a step, d(force)/dv a, at the placed positions.
    void implicit_change(Vector v, Vector a) {
        std::ranges::fill(change_, 0.0);
        if (model_->has_implicit_coriolis) {
            // The Coriolis torque is C(q, v) v, and C(q, v) a, with the C of Christoffel's symbols, is symmetric in v and a. So its
            // derivative along a is 2 C(q, v) a, which follows by polarization: (v + a)^2 - (v - a)^2 = 4 v a.
            for (Link& link : links_) { link.acceleration = 0.0; }
            for (const double sign : {1.0, -1.0}) {
                for (size_t i = 0; i < v.size(); ++i) { sum_[i] = v[i] + sign * a[i]; }
                set(&Link::velocity, sum_);
                newton_euler();
                torques_of_arm(sum_);
                for (size_t i = 0; i < v.size(); ++i) { change_[i] += 0.5 * sign * sum_[i]; }
            }
        }
        for (size_t i = 0; i < v.size(); ++i) {
            const Polynomial& damping = model_->drives[i].damping;
            change_[i] += (2.0 * damping.quadratic * std::abs(v[i]) + 3.0 * damping.cubic * v[i] * v[i]) * a[i];
        }
    }

    // Adds to M the torques, on all joints from the base to joint j, of a unit acceleration of joint j.
    void add_inertia_row(size_t j, MatrixResult M) const {
        const CompositeInertia& composite = links_[j].composite;
        const Vec3 h = composite.moment;
        Vec3 force;
        Vec3 moment;
        if (model_->joints[j].slides) {
            force = {0.0, 0.0, composite.mass};
            moment = {h.y, -h.x, 0.0};
        } else {
            force = {-h.y, h.x, 0.0};
            moment = {composite.inertia.xz, composite.inertia.yz, composite.inertia.zz};
        }
        for (int above = static_cast<int>(j); above >= 0;) {
            const size_t other = static_cast<size_t>(above);
            const Joint& joint = model_->joints[other];
            const double inertia = joint.slides ? force.z : moment.z;
            if (!model_->is_plain) {
                add_coupling(j, other, other == j && closed_ ? inertia + model_->passive[j].armature : inertia, M);
            } else if (other == j) {
                M(j, j) += inertia;
            } else {
                M(j, other) = inertia;
                M(other, j) = inertia;
            }
            const Pose& placement = links_[other].placement;
            force = placement.rotation * force;
            moment = placement.rotation * moment + cross(placement.translation, force);
            above = joint.parent;
        }
    }

    // Adds the coupling inertia of two joints to the mass matrix of the arm's n, some of which move several joints.
    void add_coupling(size_t j, size_t other, double inertia, MatrixResult M) const {
        for (size_t i = 0; i < M.rows; ++i) {
            for (size_t k = 0; k < M.columns; ++k) {
                M(i, k) += ratio(j, i) * ratio(other, k) * inertia;
                if (other != j) { M(i, k) += ratio(other, i) * ratio(j, k) * inertia; }
            }
        }
    }

    // The velocity or acceleration of a joint, from those of the arm's n.
    double joint_value(size_t joint, Vector x) const {
        if (model_->is_plain) { return x[joint]; }
        return dot(closed_ ? closed_->ratio().row(joint) : model_->ratio.row(joint), x);
    }

    // The position of a joint, after the loops have been closed.
    double position(size_t joint, Vector q) const {
        if (model_->is_plain) { return q[joint]; }
        return closed_ ? closed_->positions()[joint] : joint_value(joint, q) + model_->joints[joint].offset;
    }

    // How a joint moves with one of the arm's n, where it is placed.
    double ratio(size_t joint, size_t i) const { return closed_ ? closed_->ratio()(joint, i) : model_->ratio(joint, i); }

    // Adds to the accelerations of the joints what closed loops add at the velocities v of the arm's n.
    void add_loop_acceleration(Vector v) {
        const Vector added = closed_->acceleration(v);
        for (size_t j = 0; j < links_.size(); ++j) { links_[j].acceleration += added[j]; }
    }

    // Adds the torque against dry friction of passive joints, whose speeds are those of the reference motion where it is placed.
    void add_passive_friction(Vector v_ref, Vector a_ref, Result tau) {
        const double half = model_->half_step;
        for (size_t i = 0; i < tau.size(); ++i) {
            sum_[i] = v_ref[i] + half * a_ref[i];
            change_[i] += a_ref[i];
        }
        for (const size_t j : model_->closure->passive) {
            const double torque = model_->passive[j].friction.torque(joint_value(j, sum_), joint_value(j, change_));
            for (size_t i = 0; i < tau.size(); ++i) { tau[i] += ratio(j, i) * torque; }
        }
    }

    // Adds the torques of passive joints.
    void add_passive() {
        for (const size_t j : model_->closure->passive) {
            const PassiveJoint& joint = model_->passive[j];
            Link& link = links_[j];
            link.torque += joint.armature * link.acceleration + joint.damping.damping(link.velocity) * link.velocity;
        }
    }

    // A link alone, without the links behind it.
    static CompositeInertia own_inertia(const Joint& joint) {
        const double m = joint.mass;
        const Vec3 c = joint.center;
        const Symmetric& I = joint.inertia;
        // The parallel axis theorem.
        return {m,
                m * c,
                {I.xx + m * (c.y * c.y + c.z * c.z), I.yy + m * (c.x * c.x + c.z * c.z), I.zz + m * (c.x * c.x + c.y * c.y),
                 I.xy - m * c.x * c.y, I.xz - m * c.x * c.z, I.yz - m * c.y * c.z}};
    }

    // A composite inertia about the origin of the parent's frame: I + 2 (h . t) 1 - h t^T - t h^T + m (t . t 1 - t t^T).
    static CompositeInertia in_parent(const CompositeInertia& composite, const Pose& placement) {
        const double m = composite.mass;
        const Vec3 t = placement.translation;
        const Vec3 h = placement.rotation * composite.moment;
        const Symmetric I = rotated(placement.rotation, composite.inertia);
        const double spread = 2.0 * dot(h, t) + m * dot(t, t);
        return {m,
                h + m * t,
                {I.xx + spread - 2.0 * h.x * t.x - m * t.x * t.x, I.yy + spread - 2.0 * h.y * t.y - m * t.y * t.y,
                 I.zz + spread - 2.0 * h.z * t.z - m * t.z * t.z, I.xy - h.x * t.y - h.y * t.x - m * t.x * t.y,
                 I.xz - h.x * t.z - h.z * t.x - m * t.x * t.z, I.yz - h.y * t.z - h.z * t.y - m * t.y * t.z}};
    }

    Model model_;
    std::vector<Link> links_;
    // Scratch memory, (n,) each and (n, n).
    Numbers middle_position_, middle_velocity_, sum_, change_;
    Mat inertia_, J_;
    std::optional<ClosedLoops> closed_;
};

}  // namespace armctl
