// The arm's model, what it does at many states, and poses.
#include "dynamics.hpp"

#include <nanobind/stl/shared_ptr.h>

#include <array>
#include <tuple>

#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

Polynomial polynomial(Vector terms) { return {terms[0], terms[1], terms[2]}; }

// Of each of the m joints: `rotations` (m, 3, 3) and `translations` (m, 3) in the parent's frame at position zero, `slides`,
// `parents` (-1 for the base), `masses`, `centers` (m, 3) of mass, `inertias` (m, 6) xx yy zz xy xz yz about the center of mass,
// `lifted_masses` and `lifted_moments` (m, 3) of what gravity compensation lifts, `stiffness` (m, 3) and `spring_rest` of a
// spring; `ratio` (m, n) and `offsets`.
template <class Given>
std::vector<Joint> joints_of(Given& given, size_t m) {
    const Vector rotations = given.shaped({m, 3, 3}, "rotations");
    const Matrix translations = given.matrix(m, 3, "translations");
    const Integers slides = given.integers(m, "slides");
    const Integers parents = given.integers(m, "parents");
    const Vector masses = given.vector(m, "masses");
    const Matrix centers = given.matrix(m, 3, "centers");
    const Matrix inertias = given.matrix(m, 6, "inertias");
    const Vector lifted_masses = given.vector(m, "lifted_masses");
    const Matrix lifted_moments = given.matrix(m, 3, "lifted_moments");
    const Matrix stiffness = given.matrix(m, 3, "stiffness");
    const Vector spring_rest = given.vector(m, "spring_rest");
    const Vector offsets = given.vector(m, "offsets");
    std::vector<Joint> joints;
    for (size_t j = 0; j < m; ++j) {
        const Vector inertia = inertias.row(j);
        joints.push_back({
            .rotation = Rotation::from_rows(rotations.subspan(9 * j, 9)),
            .translation = vec3(translations.row(j)),
            .slides = slides[j] != 0,
            .parent =
                static_cast<int>(std::clamp<std::int64_t>(parents[j], -2, static_cast<std::int64_t>(m))),  // one that fits into an int
            .mass = masses[j],
            .center = vec3(centers.row(j)),
            .inertia = {inertia[0], inertia[1], inertia[2], inertia[3], inertia[4], inertia[5]},
            .lifted_mass = lifted_masses[j],
            .lifted_moment = vec3(lifted_moments.row(j)),
            .stiffness = polynomial(stiffness.row(j)),
            .spring_rest = spring_rest[j],
            .offset = offsets[j],
        });
    }
    return joints;
}

// Of each of the n that the motors drive: `armature`, `damping` (n, 3), `friction_loss`, `friction_gain`, `friction_rate`.
template <class Given>
std::vector<Drive> drives_of(Given& given, size_t n) {
    const Vector armature = given.vector(n, "armature");
    const Matrix damping = given.matrix(n, 3, "damping");
    const Vector loss = given.vector(n, "friction_loss");
    const Vector gain = given.vector(n, "friction_gain");
    const Vector rate = given.vector(n, "friction_rate");
    std::vector<Drive> drives;
    drives.reserve(n);
    for (size_t i = 0; i < n; ++i) {
        drives.push_back({.armature = armature[i], .damping = polynomial(damping.row(i)), .friction = {loss[i], gain[i], rate[i]}});
    }
    return drives;
}

template <class Given>
ArmDescription arm_description(Given& given) {
    const size_t m = given.length("masses");
    const size_t n = given.length("armature");
    ArmDescription arm{
        .joints = joints_of(given, m),
        .drives = drives_of(given, n),
        .ratio = {m, n},
        .chain_length = given.count("chain_length"),
        .gravity = vec3(given.vector(3, "gravity")),
        .T_last_tip = {Rotation::from_rows(given.shaped({3, 3}, "tip_rotation")), vec3(given.vector(3, "tip_translation"))},
        .implicit_damping = given.flag("implicit_damping"),
        .implicit_coriolis = given.flag("implicit_coriolis"),
    };
    arm.ratio.set(given.matrix(m, n, "ratio"));
    return arm;
}

void bind_model(nb::module_& module) {
    nb::class_<ArmModel> bound(module, "ArmModel", "The model of an arm: a tree of links. Immutable.");
    const auto make = [](ArmModel* self, ArmDescription arm) { new (self) ArmModel(std::move(arm)); };
    bind_constructor<>(
        bound, "__init__(self", [](auto& given) { return arm_description(given); }, make,
        "A model from arrays for each of the m joints, and for each of the arm's n; armctl/cpp/arm_model.hpp explains them.");
    bound.def_prop_ro("n", &ArmModel::n, "The number of joints that the arm's motors drive.")
        .def("for_period", &ArmModel::for_period, "dt"_a, "continuous"_a,
             "The model for a control period, s: one step of MuJoCo, or a continuous motion. dt = 0 is continuous time.")
        .def(
            "with_loops",
            [](const ArmModel& self, const Closure& loops, const In& damping, const In& friction, const In& armature) {
                const size_t m = self.joints.size();
                const Matrix rows = damping.matrix(m, 3, "damping");
                const Matrix laws = friction.matrix(m, 3, "friction");
                const Vector inertia = armature.vector(m, "armature");
                std::vector<PassiveJoint> each;
                each.reserve(m);
                for (size_t j = 0; j < m; ++j) {
                    each.push_back({
                        .armature = inertia[j],
                        .damping = polynomial(rows.row(j)),
                        .friction = {laws(j, 0), laws(j, 1), laws(j, 2)},
                    });
                }
                return self.with_loops(loops, std::move(each));
            },
            "loops"_a, "damping"_a, "friction"_a, "armature"_a,
            "The same arm with closed loops, and the damping (m, 3), dry friction (m, 3: loss, gain, rate) and armature (m,) of its\n"
            "passive joints, zero for others.");
}

// An array with rows for the states of an arm.
struct StateRows {
    const char* name;
    size_t per_joint;  // numbers of a row for each of the n joints
    size_t further = 0;
    size_t per_pair = 0;  // of joints
};

// Binds a function of one state for T of them. A call has its own scratch memory, and runs without the GIL.
template <class... Spans>
void bind_states(nb::module_& module, const char* function_name, void (*function)(Dynamics&, Spans...),
                 const std::array<StateRows, sizeof...(Spans)>& rows, const char* doc) {
    const auto at_all_states = [function, rows](const Model& model, const Array<typename Spans::element_type>&... arrays) {
        const size_t count = std::get<0>(std::tie(arrays...)).length(rows[0].name);
        auto matrix = [count, n = model->n(), next = rows.data()](const auto& array) mutable {
            const StateRows& expected = *next++;
            return array.matrix(count, expected.per_joint * n + expected.further + expected.per_pair * n * n, expected.name);
        };
        const std::tuple matrices{matrix(arrays)...};
        Dynamics dynamics(model);
        for (size_t k = 0; k < count; ++k) {
            std::apply([&](const auto&... each) { function(dynamics, each.row(k)...); }, matrices);
        }
    };
    const auto bind = [&](const auto&... each) {
        module.def(function_name, at_all_states, "model"_a, nb::arg(each.name)..., nb::call_guard<nb::gil_scoped_release>(), doc);
    };
    std::apply(bind, rows);
}

void tip_pose(Dynamics& dynamics, Vector q, Result position, Result rotation) {
    dynamics.locate(q);
    dynamics.tip().translation.store(position);
    dynamics.tip().rotation.to_rows(rotation);
}

void tip_jacobian(Dynamics& dynamics, Vector q, Result J) {
    dynamics.locate(q);
    copy(dynamics.tip_jacobian().numbers(), J);
}

void tip_twist(Dynamics& dynamics, Vector q, Vector v, Result twist) {
    dynamics.locate(q);
    const Matrix J = dynamics.tip_jacobian();
    for (size_t r = 0; r < J.rows; ++r) { twist[r] = dot(J.row(r), v); }
}

void bind_all_states(nb::module_& module) {
    bind_states(
        module, "inverse_dynamics", +[](Dynamics& arm, Vector q, Vector v, Vector a, Result tau) { arm.inverse_dynamics(q, v, a, tau); },
        {{{"q", 1}, {"v", 1}, {"a", 1}, {"tau", 1}}},
        "The torques that change the velocity by a dt over the period, without dry friction: (T, n) N m.");
    bind_states(
        module, "gravity", +[](Dynamics& arm, Vector q, Result tau) { arm.gravity(q, tau); }, {{{"q", 1}, {"tau", 1}}},
        "The torques that hold the arm still: (T, n) N m.");
    bind_states(module, "tips", tip_pose, {{{"q", 1}, {"positions", 0, 3}, {"rotations", 0, 9}}},
                "Positions (T, 3) m and rotation matrices (T, 9), row by row, of the tip in the world at each row of q (T, n).");
    module.def(
        "frames",
        [](const Model& model, const In& q, std::int64_t joint, const In& placement, const Out& positions, const Out& rotations) {
            const size_t count = q.length("q");
            const Matrix rows = q.matrix(count, model->n(), "q");
            const Pose T_joint_frame = pose_of(placement.vector(12, "placement"));
            const MatrixResult position_rows = positions.matrix(count, 3, "positions");
            const MatrixResult rotation_rows = rotations.matrix(count, 9, "rotations");
            checked_index(joint + 1, model->joints.size() + 1, "joint");
            const nb::gil_scoped_release release;
            Dynamics dynamics(model);
            for (size_t k = 0; k < count; ++k) {
                dynamics.locate(rows.row(k));
                const Pose pose = dynamics.joint_frame(static_cast<int>(joint)) * T_joint_frame;
                pose.translation.store(position_rows.row(k));
                pose.rotation.to_rows(rotation_rows.row(k));
            }
        },
        "model"_a, "q"_a, "joint"_a, "placement"_a, "positions"_a, "rotations"_a,
        "As `tips`, of a frame that a joint carries (-1: the world) at a placement (12,) in it: rotation row by row, position.");
    bind_states(
        module, "mass_matrices",
        +[](Dynamics& arm, Vector q, Result M) {
            arm.place(q);
            arm.mass_matrix({M.data(), q.size(), q.size()});
        },
        {{{"q", 1}, {"M", 0, 0, 1}}}, "The mass matrices with armature, (T, n n) kg m^2, row by row.");
    bind_states(module, "tip_jacobians", tip_jacobian, {{{"q", 1}, {"J", 6}}},
                "The Jacobians of the tip, (T, 6 n), row by row: linear first, world axes.");
    bind_states(module, "tip_twists", tip_twist, {{{"q", 1}, {"v", 1}, {"twists", 0, 6}}},
                "The twists (T, 6) of the tip, linear first, world axes.");
    bind_states(
        module, "tip_forces", +[](Dynamics& arm, Vector q, Vector wrench, Result tau) { arm.tip_force(q, wrench, tau); },
        {{{"q", 1}, {"wrenches", 0, 6}, {"tau", 1}}},
        "J(q)^T wrench, (T, n) N m, for wrenches (T, 6) on the tip: force first, world axes.");
}

}  // namespace

void bind_dynamics(nb::module_& module) {
    bind_model(module);
    bind_all_states(module);
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

}  // namespace armctl
