// The arm's model, its dynamics, and the factorization of symmetric matrices.
#include "dynamics.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/stl/shared_ptr.h>

#include "arrays.hpp"
#include "factorization.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

std::shared_ptr<ArmModel> make_model(const In& rotations, const In& translations, const IntegersIn& slides, const IntegersIn& parents,
                                     const In& masses, const In& centers, const In& inertias, const In& lifted_masses,
                                     const In& lifted_moments, const In& stiffness, const In& spring_rest, const In& offsets,
                                     const In& ratio, const In& armature, const In& damping, const In& friction_loss,
                                     const In& friction_gain, const In& friction_rate, size_t chain_length, const In& gravity,
                                     const In& tip_rotation, const In& tip_translation, bool implicit_damping, bool implicit_coriolis) {
    const size_t m = masses.length("masses");
    const size_t n = armature.length("armature");
    return std::make_shared<ArmModel>(ArmArrays{
        .rotations = {rotations.shaped({m, 3, 3}, "rotations").data(), m, 9},
        .translations = translations.matrix(m, 3, "translations"),
        .slides = slides.vector(m, "slides"),
        .parents = parents.vector(m, "parents"),
        .masses = masses.vector(m, "masses"),
        .centers = centers.matrix(m, 3, "centers"),
        .inertias = inertias.matrix(m, 6, "inertias"),
        .lifted_masses = lifted_masses.vector(m, "lifted_masses"),
        .lifted_moments = lifted_moments.matrix(m, 3, "lifted_moments"),
        .stiffness = stiffness.matrix(m, 3, "stiffness"),
        .spring_rest = spring_rest.vector(m, "spring_rest"),
        .offsets = offsets.vector(m, "offsets"),
        .ratio = ratio.matrix(m, n, "ratio"),
        .armature = armature.vector(n, "armature"),
        .damping = damping.matrix(n, 3, "damping"),
        .friction_loss = friction_loss.vector(n, "friction_loss"),
        .friction_gain = friction_gain.vector(n, "friction_gain"),
        .friction_rate = friction_rate.vector(n, "friction_rate"),
        .chain_length = chain_length,
        .gravity = gravity.vector(3, "gravity"),
        .tip_rotation = tip_rotation.shaped({3, 3}, "tip_rotation"),
        .tip_translation = tip_translation.vector(3, "tip_translation"),
        .implicit_damping = implicit_damping,
        .implicit_coriolis = implicit_coriolis,
    });
}

void store(Vec3 a, Result numbers) {
    numbers[0] = a.x;
    numbers[1] = a.y;
    numbers[2] = a.z;
}

void bind_model(nb::module_& module) {
    nb::class_<ArmModel>(module, "ArmModel", "The model of an arm: a tree of links. Immutable.")
        .def(nb::new_(&make_model), nb::kw_only(), "rotations"_a, "translations"_a, "slides"_a, "parents"_a, "masses"_a, "centers"_a,
             "inertias"_a, "lifted_masses"_a, "lifted_moments"_a, "stiffness"_a, "spring_rest"_a, "offsets"_a, "ratio"_a, "armature"_a,
             "damping"_a, "friction_loss"_a, "friction_gain"_a, "friction_rate"_a, "chain_length"_a, "gravity"_a, "tip_rotation"_a,
             "tip_translation"_a, "implicit_damping"_a, "implicit_coriolis"_a,
             "A model from arrays for each of the m joints, and for each of the arm's n; armctl/cpp/arm_model.hpp explains "
             "them.")
        .def_prop_ro("n", &ArmModel::n, "The number of joints that the arm's motors drive.")
        .def("for_period", &ArmModel::for_period, "dt"_a, "continuous"_a,
             "The model for a control period, s: one step of MuJoCo, or a continuous motion. dt = 0 is continuous time.");
}

// Calls that take less time than to release and to take the GIL keep it.
void bind_workspace(nb::module_& module) {
    nb::class_<Dynamics>(module, "Dynamics",
                         "The equations of motion of an arm, with scratch memory: use an object in one thread at a time.\n\n"
                         "Results are written into the last argument.")
        .def(nb::init<std::shared_ptr<const ArmModel>>(), "model"_a)
        .def(
            "place", [](Dynamics& self, const In& q) { self.place(q.vector(self.model().n(), "q")); }, "q"_a,
            "Places the joints at q (n,) rad.")
        .def(
            "gravity",
            [](Dynamics& self, const In& q, const Out& tau) {
                const size_t n = self.model().n();
                self.gravity(q.vector(n, "q"), tau.vector(n, "tau"));
            },
            "q"_a, "tau"_a, "The torque that holds the arm at rest, (n,) N m. Places the joints.")
        .def(
            "inverse_dynamics",
            [](Dynamics& self, const In& q, const In& v, const In& a, const Out& tau) {
                const size_t n = self.model().n();
                self.inverse_dynamics(q.vector(n, "q"), v.vector(n, "v"), a.vector(n, "a"), tau.vector(n, "tau"));
            },
            "q"_a, "v"_a, "a"_a, "tau"_a,
            "The torque that changes the velocity by a dt over the period, (n,) N m, without dry friction. Places the joints.")
        .def(
            "add_friction",
            [](Dynamics& self, const In& v_ref, const In& a_ref, const Out& tau) {
                const size_t n = self.model().n();
                self.add_friction(v_ref.vector(n, "v_ref"), a_ref.vector(n, "a_ref"), tau.vector(n, "tau"));
            },
            "v_ref"_a, "a_ref"_a, "tau"_a, "Adds the torque against dry friction on the reference motion, where the joints are placed.")
        .def(
            "add_linear_damping",
            [](const Dynamics& self, const In& v, const Out& tau) {
                const size_t n = self.model().n();
                self.add_linear_damping(v.vector(n, "v"), tau.vector(n, "tau"));
            },
            "v"_a, "tau"_a, "Adds the torque of the linear damping.")
        .def(
            "coriolis_product",
            [](Dynamics& self, const In& v, const In& w, const Out& tau) {
                const size_t n = self.model().n();
                self.coriolis_product(v.vector(n, "v"), w.vector(n, "w"), tau.vector(n, "tau"));
            },
            "v"_a, "w"_a, "tau"_a, "C(q, v) w (n,) N m, where the joints are placed.")
        .def(
            "mass_matrix",
            [](Dynamics& self, const Out& M) {
                const size_t n = self.model().n();
                self.mass_matrix(M.matrix(n, n, "M"));
            },
            "M"_a, "The (n, n) mass matrix with armature, kg m^2, where the joints are placed.")
        .def(
            "add_step_inertia",
            [](const Dynamics& self, const Out& M) {
                const size_t n = self.model().n();
                self.add_step_inertia(M.matrix(n, n, "M"));
            },
            "M"_a, "Adds to a mass matrix what implicit linear damping adds to the inertia in one step.")
        .def("locate", &Dynamics::locate, "Finds the frames of all joints in the world, where the joints are placed.")
        .def(
            "tip",
            [](const Dynamics& self, const Out& position, const Out& rotation) {
                const Pose tip = self.tip();
                store(tip.translation, position.vector(3, "position"));
                tip.rotation.to_rows(rotation.shaped({3, 3}, "rotation"));
            },
            "position"_a, "rotation"_a, "Position (3,) m and rotation matrix (3, 3) of the tip in the world, after `locate`.")
        .def(
            "tip_jacobian", [](const Dynamics& self, const Out& J) { self.tip_jacobian(J.matrix(6, self.model().n(), "J")); }, "J"_a,
            "The (6, n) Jacobian of the tip, linear first, world axes, after `locate`.")
        .def(
            "tip_motion",
            [](Dynamics& self, const In& q, const In& v, const In& a, const Out& motion) {
                const size_t n = self.model().n();
                const MatrixResult rows = motion.matrix(3, 3, "motion");
                const BodyMotion tip = self.tip_motion(q.vector(n, "q"), v.vector(n, "v"), a.vector(n, "a"));
                store(tip.omega, rows.row(0));
                store(tip.alpha, rows.row(1));
                store(tip.linear, rows.row(2));
            },
            "q"_a, "v"_a, "a"_a, "motion"_a,
            "Angular velocity, angular acceleration, and acceleration minus gravity of the tip in its own axes, (3, 3).");
}

void bind_factorization(nb::module_& module) {
    module.def(
        "factorize",
        [](const Out& M) {
            const size_t n = M.length("M");
            factorize(M.matrix(n, n, "M"));
        },
        "M"_a, "Factorizes a positive definite (n, n) matrix in place, as L D L^T, for `solve` and `multiply`.");
    module.def(
        "take_roots",
        [](const Out& factors) {
            const size_t n = factors.length("factors");
            take_roots(factors.matrix(n, n, "factors"));
        },
        "factors"_a, "Makes the lower triangle of what `factorize` leaves the Cholesky factor.");
    module.def(
        "solve",
        [](const In& factors, const Out& x) {
            const size_t n = x.length("x");
            solve(factors.matrix(n, n, "factors"), x.vector(n, "x"));
        },
        "factors"_a, "x"_a, "Replaces x (n,) by the solution of M solution = x, with M as `factorize` leaves it.");
    module.def(
        "multiply",
        [](const In& factors, const In& x, const Out& product) {
            const size_t n = x.length("x");
            multiply(factors.matrix(n, n, "factors"), x.vector(n, "x"), product.vector(n, "product"));
        },
        "factors"_a, "x"_a, "product"_a, "product = M x, (n,) each, with M as `factorize` leaves it.");
}

void bind_poses(nb::module_& module) {
    module.def(
        "tips",
        [](const std::shared_ptr<ArmModel>& model, const In& q, const Out& positions, const Out& rotations) {
            const size_t count = q.length("q");
            const Matrix rows = q.matrix(count, model->n(), "q");
            const MatrixResult position_rows = positions.matrix(count, 3, "positions");
            const MatrixResult rotation_rows{rotations.shaped({count, 3, 3}, "rotations").data(), count, 9};
            const nb::gil_scoped_release release;
            Dynamics dynamics(model);
            for (size_t k = 0; k < count; ++k) {
                dynamics.place(rows.row(k));
                dynamics.locate();
                const Pose tip = dynamics.tip();
                store(tip.translation, position_rows.row(k));
                tip.rotation.to_rows(rotation_rows.row(k));
            }
        },
        "model"_a, "q"_a, "positions"_a, "rotations"_a,
        "Positions (T, 3) m and rotation matrices (T, 3, 3) of the tip in the world at each row of q (T, n).");
    module.def(
        "quaternions",
        [](const In& rotations, const Out& quats) {
            const size_t count = rotations.length("rotations");
            const Matrix rotation_rows{rotations.shaped({count, 3, 3}, "rotations").data(), count, 9};
            const MatrixResult quat_rows = quats.matrix(count, 4, "quats");
            const nb::gil_scoped_release release;
            for (size_t k = 0; k < count; ++k) {
                const Quaternion unit = quaternion(Rotation::from_rows(rotation_rows.row(k)));
                const Result numbers = quat_rows.row(k);
                numbers[0] = unit.w;
                numbers[1] = unit.x;
                numbers[2] = unit.y;
                numbers[3] = unit.z;
            }
        },
        "rotations"_a, "quats"_a, "The unit quaternions wxyz (T, 4), w >= 0, of rotation matrices (T, 3, 3).");
}

}  // namespace

void bind_dynamics(nb::module_& module) {
    bind_model(module);
    bind_workspace(module);
    bind_factorization(module);
    bind_poses(module);
}

}  // namespace armctl
