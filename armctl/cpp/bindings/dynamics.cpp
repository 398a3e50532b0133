// The arm's model, its dynamics, and poses.
#include "dynamics.hpp"

#include <nanobind/stl/shared_ptr.h>

#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

void bind_model(nb::module_& module) {
    nb::class_<ArmModel>(module, "ArmModel", "The model of an arm: a tree of links. Immutable.")
        .def(nb::new_([](const nb::kwargs& given) { return std::make_shared<ArmModel>(Arguments(given)); }), "given"_a,
             "A model from arrays for each of the m joints, and for each of the arm's n; armctl/cpp/arm_model.hpp explains them.")
        .def_prop_ro("n", &ArmModel::n, "The number of joints that the arm's motors drive.")
        .def("for_period", &ArmModel::for_period, "dt"_a, "continuous"_a,
             "The model for a control period, s: one step of MuJoCo, or a continuous motion. dt = 0 is continuous time.");
}

// An array (n,) with a number for each joint.
template <class Array>
auto joints(const Dynamics& dynamics, const Array& array, const char* name) {
    return array.vector(dynamics.model().n(), name);
}

// Calls that take less time than to release and to take the GIL keep it.
void bind_workspace(nb::module_& module) {
    nb::class_<Dynamics>(module, "Dynamics",
                         "The equations of motion of an arm, with scratch memory: use an object in one thread at a time.\n\n"
                         "Results are written into the last argument.")
        .def(nb::init<Model>(), "model"_a)
        .def(
            "locate", [](Dynamics& self, const In& q) { self.locate(joints(self, q, "q")); }, "q"_a,
            "Places the joints at q (n,) rad, and finds their frames in the world.")
        .def(
            "inverse_dynamics",
            [](Dynamics& self, const In& q, const In& v, const In& a, const Out& tau) {
                self.inverse_dynamics(joints(self, q, "q"), joints(self, v, "v"), joints(self, a, "a"), joints(self, tau, "tau"));
            },
            "q"_a, "v"_a, "a"_a, "tau"_a,
            "The torque that changes the velocity by a dt over the period, (n,) N m, without dry friction. Places the joints.")
        .def(
            "mass_matrix",
            [](Dynamics& self, const Out& M) {
                const size_t n = self.model().n();
                self.mass_matrix(M.matrix(n, n, "M"));
            },
            "M"_a, "The (n, n) mass matrix with armature, kg m^2, where the joints are placed.")
        .def(
            "tip_jacobian", [](Dynamics& self, const Out& J) { copy(self.tip_jacobian().numbers(), J.shaped({6, self.model().n()}, "J")); },
            "J"_a, "The (6, n) Jacobian of the tip, linear first, world axes, after `locate`.")
        .def(
            "tip_force",
            [](Dynamics& self, const In& q, const In& wrench, const Out& tau) {
                self.tip_force(joints(self, q, "q"), wrench.vector(6, "wrench"), joints(self, tau, "tau"));
            },
            "q"_a, "wrench"_a, "tau"_a, "J(q)^T wrench, (n,) N m, for a wrench (6,) on the tip: force first, world axes.");
}

void bind_poses(nb::module_& module) {
    module.def(
        "tips",
        [](const Model& model, const In& q, const Out& positions, const Out& rotations) {
            const size_t count = q.length("q");
            const Matrix rows = q.matrix(count, model->n(), "q");
            const MatrixResult position_rows = positions.matrix(count, 3, "positions");
            const MatrixResult rotation_rows{rotations.shaped({count, 3, 3}, "rotations").data(), count, 9};
            const nb::gil_scoped_release release;
            Dynamics dynamics(model);
            for (size_t k = 0; k < count; ++k) {
                dynamics.locate(rows.row(k));
                const Pose tip = dynamics.tip();
                tip.translation.store(position_rows.row(k));
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
                quat_rows(k, 0) = unit.w;
                Vec3{unit.x, unit.y, unit.z}.store(quat_rows.row(k).subspan(1));
            }
        },
        "rotations"_a, "quats"_a, "The unit quaternions wxyz (T, 4), w >= 0, of rotation matrices (T, 3, 3).");
}

}  // namespace

void bind_dynamics(nb::module_& module) {
    bind_model(module);
    bind_workspace(module);
    bind_poses(module);
}

}  // namespace armctl
