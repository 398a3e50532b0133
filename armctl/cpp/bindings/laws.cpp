// Control laws.
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/unique_ptr.h>

#include "../laws/admittance.hpp"
#include "../laws/c_function.hpp"
#include "../laws/computed_torque.hpp"
#include "../laws/computed_torque_learning.hpp"
#include "../laws/computed_torque_observer.hpp"
#include "../laws/computed_torque_qp.hpp"
#include "../laws/hybrid_force.hpp"
#include "../laws/impedance.hpp"
#include "../laws/lqr.hpp"
#include "../laws/mpc.hpp"
#include "../laws/operational_space.hpp"
#include "../laws/pd.hpp"
#include "../laws/torque_filter.hpp"
#include "arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using NumPyArray = nb::ndarray<nb::numpy, double>;

// Numbers of a law as an array that shares its memory.
template <class ConcreteLaw, Result (ConcreteLaw::*numbers)()>
NumPyArray shared(nb::handle_t<ConcreteLaw> self) {
    const Result found = (nb::cast<ConcreteLaw&>(self).*numbers)();
    return {found.data(), {found.size()}, self};
}

// Calls take a few microseconds and keep the GIL: so one object may be called by two threads.
void bind_law(nb::module_& module) {
    nb::class_<Law>(module, "Law",
                    "A control law with its memory and scratch memory: use an object for one arm at a time. "
                    "armctl/cpp/law.hpp explains it.")
        .def_prop_ro("n", &Law::joints, "The number of joints.")
        .def_prop_ro("needs_wrench", &Law::needs_wrench, "Whether `torque` reads the measured wrench.")
        .def(
            "torque",
            [](Law& self, const In& q, const In& v, const In& reference, const In& wrench, const Out& tau) {
                const size_t n = self.joints();
                const size_t count = reference.length("reference");
                const size_t known = count < 5 ? 0 : (count - 5) / 3;
                const Matrix rows = reference.matrix(5 + 3 * known, n, "reference");
                const State state{
                    .q = q.vector(n, "q"),
                    .v = v.vector(n, "v"),
                    .wrench = self.needs_wrench() ? wrench.vector(6, "wrench") : Vector(),
                };
                const Setpoint setpoint{
                    .q = rows.row(0),
                    .v = rows.row(1),
                    .a = rows.row(2),
                    .v_tick = rows.row(3),
                    .a_tick = rows.row(4),
                    .q_ahead = {rows.row(5).data(), known, n},
                    .v_ahead = {rows.row(5 + known).data(), known, n},
                    .a_ahead = {rows.row(5 + 2 * known).data(), known, n},
                };
                self.torque(state, setpoint, tau.vector(n, "tau"));
            },
            "q"_a, "v"_a, "reference"_a, "wrench"_a, "tau"_a,
            "The torque for the coming control period, written into tau (n,) N m.\n\n"
            "`reference` has the (5, n) rows q, v, a, v_tick, a_tick of a setpoint; k rows each of q, v_tick and a_tick of the ticks\n"
            "from this one on may follow, if they are known.\n"
            "`wrench` (6,) is not read by a law that does not need it.")
        .def_prop_ro("memory", &shared<Law, &Law::memory>,
                     "What the law keeps from tick to tick; an array that shares the memory of the law.")
        .def("reset", &Law::reset, "Begins a new run.")
        .def("clone", &Law::clone, "The same law and gains with memory of its own, at the start of a run.");
}

// The class of a law with a model, around another law, or of a function. Its keyword arguments have the names of its members.
template <class ConcreteLaw, class Base = Law, class Of = Model>
nb::class_<ConcreteLaw, Base> bind(nb::module_& module, const char* name, const char* doc, const char* of_name = "of") {
    const auto make = [](const Of& of, const nb::kwargs& gains) { return new ConcreteLaw(of, Arguments(gains)); };
    return nb::class_<ConcreteLaw, Base>(module, name, doc).def(nb::new_(make), nb::arg(of_name), "gains"_a);
}

void bind_without_model(nb::module_& module) {
    nb::class_<PD, Law>(module, "PD", "tau = stiffness (q_ref - q) + damping (v_ref - v)").def(nb::new_([](const nb::kwargs& gains) {
        return new PD(Arguments(gains));
    }));
    bind<TorqueRateLimit, Law, std::shared_ptr<Law>>(module, "TorqueRateLimit", "A law whose torques change at limited rates.");
    bind<TorqueFilter, Law, std::shared_ptr<Law>>(module, "TorqueFilter",
                                                  "A law whose torques go through filters of second-order sections.");
    bind<CFunctionLaw, Law, std::uintptr_t>(module, "CFunctionLaw",
                                            "A compiled C function as a law; armctl/cpp/laws/c_function.hpp has its signature.", "address");
}

void bind_computed_torque(nb::module_& module) {
    bind<ComputedTorque>(module, "ComputedTorque", "Computed torque; with weights of an estimate, at estimated positions and velocities.");
    bind<LQR>(module, "LQR", "Linear quadratic regulator with integral action, at estimated positions and velocities.");
    bind<ComputedTorqueObserver>(module, "ComputedTorqueObserver", "Computed torque with a disturbance observer that estimates velocities.")
        .def_prop_ro("disturbance", &shared<ComputedTorqueObserver, &ComputedTorqueObserver::disturbance>,
                     "The estimated disturbance, (n,) N m; a part of the memory.");
    bind<ComputedTorqueLearning, ComputedTorqueObserver>(module, "ComputedTorqueLearning",
                                                         "Computed torque with an observer, which learns payload, friction and delay.")
        .def_prop_ro("estimate", &shared<ComputedTorqueLearning, &ComputedTorqueLearning::estimate>,
                     "The ten parameters of the payload, the delay, s, and the dry friction of the joints, N m; a part of the memory.");
}

void bind_qp(nb::module_& module) {
    bind<ComputedTorqueQP>(module, "ComputedTorqueQP", "Computed torque within limits of torque, velocity and position.");
    bind<MPC, ComputedTorqueQP>(module, "MPC", "Model predictive control within limits of torque, velocity and position.")
        .def_prop_ro("counts", &shared<MPC, &MPC::counts>,
                     "Ticks: all, those that needed a plan, and those without one; a part of the memory.");
    module.attr("UNBOUNDED") = unbounded;
    module.def(
        "solve_program",
        [](const In& H, const In& f, const In& M, const In& lower, const In& upper, const Out& x) {
            const size_t n = x.length("x");
            const size_t m = M.length("M");
            const QuadraticProgram program{
                .H = H.matrix(n, n, "H"),
                .f = f.vector(n, "f"),
                .M = M.matrix(m, n, "M"),
                .lower = lower.vector(n + m, "lower"),
                .upper = upper.vector(n + m, "upper"),
            };
            return ActiveSetSolver(n, m).solve(program, x.vector(n, "x"));
        },
        "H"_a, "f"_a, "M"_a, "lower"_a, "upper"_a, "x"_a,
        "Minimizes x H x / 2 + f x subject to lower <= (x, M x) <= upper; whether there is a solution, which is written into x.");
}

void bind_task_space(nb::module_& module) {
    bind<OperationalSpace>(module, "OperationalSpace", "Operational space control with a posture in the null space.");
    bind<Impedance>(module, "Impedance", "Cartesian impedance control without inertia shaping.")
        .def(
            "set_stiffness", [](Impedance& self, const nb::kwargs& gains) { self.set_stiffness(Arguments(gains)); },
            "Replaces the stiffness of the tip, (6,) N/m and N m/rad.");
    bind<Admittance>(module, "Admittance", "Admittance control: a position loop follows a compliant reference.")
        .def_prop_ro("offset", &shared<Admittance, &Admittance::offset>,
                     "The displacement of the reference, (6,) m and rad; a part of the memory.");
    bind<HybridForce>(module, "HybridForce", "Hybrid force/motion control with contact transition.")
        .def(
            "set_axes", [](HybridForce& self, const nb::kwargs& axes) { self.set_axes(Arguments(axes)); },
            "Replaces the force axes, `is_force` and `targets` (6,). One that comes back later begins with an approach.")
        .def_prop_ro("in_contact", &HybridForce::in_contact, "Whether every force axis with a target is in contact.");
}

}  // namespace

void bind_laws(nb::module_& module) {
    bind_law(module);
    bind_without_model(module);
    bind<PDFeedforward>(module, "PDFeedforward", "PD with the torque of the reference motion.");
    bind<PDGravity>(module, "PDGravity", "PD with gravity compensation.");
    bind_computed_torque(module);
    bind_qp(module);
    bind_task_space(module);
}

}  // namespace armctl
