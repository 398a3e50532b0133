// Control laws.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
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
#include "../laws/operational_space.hpp"
#include "../laws/pd.hpp"
#include "../laws/pd_feedforward.hpp"
#include "../laws/pd_gravity.hpp"
#include "../laws/torque_filter.hpp"
#include "../laws/torque_rate_limit.hpp"
#include "arrays.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Model = std::shared_ptr<const ArmModel>;
using NumPyVector = nb::ndarray<nb::numpy, double, nb::ndim<1>>;
using NumPyMatrix = nb::ndarray<nb::numpy, double, nb::ndim<2>>;

std::vector<double> copied(const In& values, const char* name) {
    const Vector numbers = values.vector(values.length(name), name);
    return {numbers.begin(), numbers.end()};
}

// An array that shares the numbers of an object of Python.
NumPyVector view(std::span<double> numbers, nb::handle owner) { return {numbers.data(), {numbers.size()}, owner}; }

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
                const State state{
                    .q = q.vector(n, "q"),
                    .v = v.vector(n, "v"),
                    .wrench = self.needs_wrench() ? wrench.vector(6, "wrench") : Vector(),
                };
                self.torque(state, setpoint_of(reference.matrix(5, n, "reference")), tau.vector(n, "tau"));
            },
            "q"_a, "v"_a, "reference"_a, "wrench"_a, "tau"_a,
            "The torque for the coming control period, written into tau (n,) N m.\n\n"
            "`reference` has the (5, n) rows q, v, a, v_tick, a_tick of a setpoint.\n"
            "`wrench` (6,) is not read by a law that does not need it.")
        .def_prop_ro(
            "memory", [](nb::handle_t<Law> self) { return view(nb::cast<Law&>(self).memory(), self); },
            nb::for_getter(nb::sig("def memory(self) -> numpy.ndarray")),
            "What the law keeps from tick to tick; an array that shares the memory of the law.")
        .def("reset", &Law::reset, "Begins a new run.")
        .def("clone", &Law::clone, "The same law and gains with memory of its own, at the start of a run.");
}

PDGains pd_gains(const In& stiffness, const In& damping) {
    return {.stiffness = copied(stiffness, "stiffness"), .damping = copied(damping, "damping")};
}

void bind_pd(nb::module_& module) {
    nb::class_<PD, Law>(module, "PD", "tau = stiffness (q_ref - q) + damping (v_ref - v)")
        .def(nb::new_([](const In& stiffness, const In& damping) { return new PD(pd_gains(stiffness, damping)); }), nb::kw_only(),
             "stiffness"_a, "damping"_a);
    nb::class_<PDFeedforward, Law>(module, "PDFeedforward", "PD with the torque of the reference motion.")
        .def(nb::new_([](Model model, const In& stiffness, const In& damping) {
                 return new PDFeedforward(std::move(model), pd_gains(stiffness, damping));
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a);
    nb::class_<PDGravity, Law>(module, "PDGravity", "PD with gravity compensation.")
        .def(nb::new_([](Model model, const In& stiffness, const In& damping) {
                 return new PDGravity(std::move(model), pd_gains(stiffness, damping));
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a);
}

EstimateWeights estimate_weights(double position, double velocity) {
    return {.position = checked_gain(position, "position_weight"), .velocity = checked_gain(velocity, "velocity_weight")};
}

ComputedTorque* new_computed_torque(Model model, double stiffness, double damping, double position_weight, double velocity_weight,
                                    const In& added_inertia, const In& torque_limit, bool textbook, double dt, bool continuous) {
    ComputedTorque::Gains gains{
        .stiffness = stiffness,
        .damping = damping,
        .added_inertia = copied(added_inertia, "added_inertia"),
        .estimate = estimate_weights(position_weight, velocity_weight),
        .torque_limit = copied(torque_limit, "torque_limit"),
    };
    const auto form = textbook ? ComputedTorque::Form::textbook : ComputedTorque::Form::discrete;
    return new ComputedTorque(std::move(model), std::move(gains), form, dt, continuous);
}

void bind_computed_torque(nb::module_& module) {
    nb::class_<ComputedTorque, Law>(module, "ComputedTorque",
                                    "Computed torque; with weights of an estimate, at estimated positions and velocities.")
        .def(nb::new_(&new_computed_torque), "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a, "position_weight"_a, "velocity_weight"_a,
             "added_inertia"_a, "torque_limit"_a, "textbook"_a, "dt"_a, "continuous"_a);
}

ComputedTorqueObserver::Gains observer_gains(double stiffness, double damping, double position_weight, double velocity_weight,
                                             double disturbance_weight, const In& torque_limit) {
    return {
        .stiffness = stiffness,
        .damping = damping,
        .estimate = estimate_weights(position_weight, velocity_weight),
        .disturbance_weight = disturbance_weight,
        .torque_limit = copied(torque_limit, "torque_limit"),
    };
}

void bind_observer(nb::module_& module) {
    nb::class_<ComputedTorqueObserver, Law>(module, "ComputedTorqueObserver",
                                            "Computed torque with a disturbance observer that estimates velocities.")
        .def(nb::new_([](Model model, double stiffness, double damping, double position_weight, double velocity_weight,
                         double disturbance_weight, const In& torque_limit, double dt, bool continuous) {
                 return new ComputedTorqueObserver(
                     std::move(model),
                     observer_gains(stiffness, damping, position_weight, velocity_weight, disturbance_weight, torque_limit), dt,
                     continuous);
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a, "position_weight"_a, "velocity_weight"_a, "disturbance_weight"_a,
             "torque_limit"_a, "dt"_a, "continuous"_a)
        .def_prop_ro(
            "disturbance",
            [](nb::handle_t<ComputedTorqueObserver> self) { return view(nb::cast<ComputedTorqueObserver&>(self).disturbance(), self); },
            nb::for_getter(nb::sig("def disturbance(self) -> numpy.ndarray")),
            "The estimated disturbance, (n,) N m; a part of the memory.");
    nb::class_<ComputedTorqueLearning, ComputedTorqueObserver>(
        module, "ComputedTorqueLearning", "Computed torque with an observer, which learns payload, friction and delay.")
        .def(nb::new_([](Model model, double stiffness, double damping, double position_weight, double velocity_weight,
                         double disturbance_weight, const In& torque_limit, double filter_weight, double information_weight,
                         double forgetting, const In& torque_precision, const In& prior_deviations, double dt, bool continuous) {
                 PayloadEstimator::Settings settings{
                     .filter_weight = filter_weight,
                     .information_weight = information_weight,
                     .forgetting = forgetting,
                     .torque_precision = copied(torque_precision, "torque_precision"),
                     .prior_deviations = copied(prior_deviations, "prior_deviations"),
                 };
                 return new ComputedTorqueLearning(
                     std::move(model),
                     observer_gains(stiffness, damping, position_weight, velocity_weight, disturbance_weight, torque_limit),
                     std::move(settings), dt, continuous);
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a, "position_weight"_a, "velocity_weight"_a, "disturbance_weight"_a,
             "torque_limit"_a, "filter_weight"_a, "information_weight"_a, "forgetting"_a, "torque_precision"_a, "prior_deviations"_a,
             "dt"_a, "continuous"_a)
        .def_prop_ro(
            "estimate",
            [](nb::handle_t<ComputedTorqueLearning> self) { return view(nb::cast<ComputedTorqueLearning&>(self).estimate(), self); },
            nb::for_getter(nb::sig("def estimate(self) -> numpy.ndarray")),
            "The ten parameters of the payload, the delay, s, and the dry friction of the joints, N m; a part of the memory.");
    module.def(
        "payload_regressor",
        [](Dynamics& dynamics, const In& q, const In& v, const In& a, const Out& Y) {
            const size_t n = dynamics.model().n();
            DenseMatrix J(6, n);
            payload_regressor(dynamics, q.vector(n, "q"), v.vector(n, "v"), a.vector(n, "a"), J, Y.matrix(n, body_parameters, "Y"));
        },
        "dynamics"_a, "q"_a, "v"_a, "a"_a, "Y"_a,
        "The torques per inertial parameter of a body at the tip, written into Y (n, 10): mass, first moment, second moments.");
}

// The program of a tick, which outlives the tick.
struct TickProgram {
    explicit TickProgram(const ComputedTorqueQP::Program& program)
        : H(copied(program.H)), M(copied(program.M)), lower(program.lower.begin(), program.lower.end()),
          upper(program.upper.begin(), program.upper.end()), torque(program.torque.begin(), program.torque.end()) {}

    static DenseMatrix copied(Matrix matrix) {
        DenseMatrix copy(matrix.rows, matrix.columns);
        std::copy_n(matrix.data, matrix.rows * matrix.columns, copy.numbers().begin());
        return copy;
    }

    DenseMatrix H;
    DenseMatrix M;
    std::vector<double> lower;
    std::vector<double> upper;
    std::vector<double> torque;
};

NumPyMatrix view(DenseMatrix& matrix, nb::handle owner) { return {matrix.numbers().data(), {matrix.rows(), matrix.columns()}, owner}; }

// A vector or matrix of the program, as an array that keeps the program.
template <auto member>
auto program_array(nb::handle_t<TickProgram> self) {
    return view(nb::cast<TickProgram&>(self).*member, self);
}

void bind_qp(nb::module_& module) {
    nb::class_<TickProgram>(module, "TickProgram", "The program of a tick: minimize x H x / 2, lower <= (x, M x) <= upper.")
        .def_prop_ro("H", &program_array<&TickProgram::H>, nb::for_getter(nb::sig("def H(self) -> numpy.ndarray")), "(n, n)")
        .def_prop_ro("M", &program_array<&TickProgram::M>, nb::for_getter(nb::sig("def M(self) -> numpy.ndarray")),
                     "(n, n) inertia of one control period: the torque of a deviation x is M x.")
        .def_prop_ro("lower", &program_array<&TickProgram::lower>, nb::for_getter(nb::sig("def lower(self) -> numpy.ndarray")),
                     "(2n,) bounds of x and M x.")
        .def_prop_ro("upper", &program_array<&TickProgram::upper>, nb::for_getter(nb::sig("def upper(self) -> numpy.ndarray")), "(2n,)")
        .def_prop_ro("torque", &program_array<&TickProgram::torque>, nb::for_getter(nb::sig("def torque(self) -> numpy.ndarray")),
                     "(n,) N m, without limits.");
    nb::class_<ComputedTorqueQP, Law>(module, "ComputedTorqueQP", "Computed torque within limits of torque, velocity and position.")
        .def(nb::new_([](Model model, double stiffness, double damping, const In& added_inertia, const In& q_min, const In& q_max,
                         const In& v_max, const In& a_max, const In& tau_max, double length, double dt, bool continuous) {
                 ComputedTorqueQP::Gains gains{
                     .stiffness = stiffness,
                     .damping = damping,
                     .added_inertia = copied(added_inertia, "added_inertia"),
                 };
                 ComputedTorqueQP::Limits limits{
                     .q_min = copied(q_min, "q_min"),
                     .q_max = copied(q_max, "q_max"),
                     .v_max = copied(v_max, "v_max"),
                     .a_max = copied(a_max, "a_max"),
                     .tau_max = copied(tau_max, "tau_max"),
                 };
                 return new ComputedTorqueQP(std::move(model), std::move(gains), std::move(limits), length, dt, continuous);
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a, "added_inertia"_a, "q_min"_a, "q_max"_a, "v_max"_a, "a_max"_a,
             "tau_max"_a, "length"_a, "dt"_a, "continuous"_a)
        .def(
            "last_program",
            [](const ComputedTorqueQP& self) -> std::optional<TickProgram> {
                const std::optional<ComputedTorqueQP::Program> program = self.last_program();
                return program ? std::optional<TickProgram>(*program) : std::nullopt;
            },
            "The program of the last tick; None if the torque was not limited.");
    module.attr("UNBOUNDED") = unbounded;
    module.def(
        "solve_program",
        [](const In& H, const In& f, const In& M, const In& lower, const In& upper, const Out& x) {
            const size_t n = x.length("x");
            const QuadraticProgram program{
                .H = H.matrix(n, n, "H"),
                .f = f.vector(n, "f"),
                .M = M.matrix(n, n, "M"),
                .lower = lower.vector(2 * n, "lower"),
                .upper = upper.vector(2 * n, "upper"),
            };
            return ActiveSetSolver(n).solve(program, x.vector(n, "x"));
        },
        "H"_a, "f"_a, "M"_a, "lower"_a, "upper"_a, "x"_a,
        "Minimizes x H x / 2 + f x subject to lower <= (x, M x) <= upper; whether there is a solution, which is written into "
        "x.");
}

void bind_task_space(nb::module_& module) {
    nb::class_<OperationalSpace, Law>(module, "OperationalSpace", "Operational space control with a posture in the null space.")
        .def(nb::new_([](Model model, double stiffness, double damping, double posture_stiffness, double posture_damping) {
                 const OperationalSpace::Gains gains{
                     .stiffness = stiffness,
                     .damping = damping,
                     .posture_stiffness = posture_stiffness,
                     .posture_damping = posture_damping,
                 };
                 return new OperationalSpace(std::move(model), gains);
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "damping"_a, "posture_stiffness"_a, "posture_damping"_a);
    nb::class_<Impedance, Law>(module, "Impedance", "Cartesian impedance control without inertia shaping.")
        .def(nb::new_([](Model model, const In& stiffness, const In& max_error, const In& posture_stiffness, double damping_ratio) {
                 Impedance::Gains gains{
                     .stiffness = copied(stiffness, "stiffness"),
                     .max_error = copied(max_error, "max_error"),
                     .posture_stiffness = copied(posture_stiffness, "posture_stiffness"),
                     .damping_ratio = damping_ratio,
                 };
                 return new Impedance(std::move(model), std::move(gains));
             }),
             "model"_a, nb::kw_only(), "stiffness"_a, "max_error"_a, "posture_stiffness"_a, "damping_ratio"_a)
        .def(
            "set_stiffness", [](Impedance& self, const In& stiffness) { self.set_stiffness(copied(stiffness, "stiffness")); },
            "stiffness"_a, "Replaces the stiffness of the tip, (6,) N/m and N m/rad.");
    nb::class_<Admittance, Law>(module, "Admittance", "Admittance control: a position loop follows a compliant reference.")
        .def(nb::new_([](Model model, const In& mass, const In& damping, const In& stiffness, double bandwidth, double dt) {
                 Admittance::Gains gains{
                     .mass = copied(mass, "mass"),
                     .damping = copied(damping, "damping"),
                     .stiffness = copied(stiffness, "stiffness"),
                     .bandwidth = bandwidth,
                 };
                 return new Admittance(std::move(model), std::move(gains), dt);
             }),
             "model"_a, nb::kw_only(), "mass"_a, "damping"_a, "stiffness"_a, "bandwidth"_a, "dt"_a)
        .def_prop_ro(
            "offset", [](nb::handle_t<Admittance> self) { return view(nb::cast<Admittance&>(self).offset(), self); },
            nb::for_getter(nb::sig("def offset(self) -> numpy.ndarray")),
            "The displacement of the reference, (6,) m and rad; a part of the memory.");
}

HybridForce::Axes force_axes(const IntegersIn& is_force, const In& targets) {
    const std::span<const std::int64_t> flags = is_force.vector(6, "is_force");
    const Vector forces = targets.vector(6, "targets");
    HybridForce::Axes axes;
    for (size_t k = 0; k < axes.size(); ++k) { axes[k] = {.is_force = flags[k] != 0, .target = forces[k]}; }
    return axes;
}

void bind_hybrid_force(nb::module_& module) {
    nb::class_<HybridForce, Law>(module, "HybridForce", "Hybrid force/motion control with contact transition.")
        .def(nb::new_([](Model model, double bandwidth, double damping_ratio, bool in_tip_frame, double approach_speed,
                         double contact_force, const IntegersIn& is_force, const In& targets, double dt) {
                 const HybridForce::Gains gains{
                     .bandwidth = bandwidth,
                     .damping_ratio = damping_ratio,
                     .in_tip_frame = in_tip_frame,
                     .approach_speed = approach_speed,
                     .contact_force = contact_force,
                 };
                 return new HybridForce(std::move(model), gains, force_axes(is_force, targets), dt);
             }),
             "model"_a, nb::kw_only(), "bandwidth"_a, "damping_ratio"_a, "in_tip_frame"_a, "approach_speed"_a, "contact_force"_a,
             "is_force"_a, "targets"_a, "dt"_a)
        .def(
            "set_axes",
            [](HybridForce& self, const IntegersIn& is_force, const In& targets) { self.set_axes(force_axes(is_force, targets)); },
            "is_force"_a, "targets"_a, "Replaces the force axes. One that comes back later begins with an approach.")
        .def_prop_ro("in_contact", &HybridForce::in_contact, "Whether every force axis with a target is in contact.");
}

void bind_others(nb::module_& module) {
    nb::class_<TorqueRateLimit, Law>(module, "TorqueRateLimit", "A law whose torques change at limited rates.")
        .def(nb::new_([](std::shared_ptr<Law> limited, const In& tau_rate_max, double dt) {
                 return new TorqueRateLimit(std::move(limited), copied(tau_rate_max, "tau_rate_max"), dt);
             }),
             "limited"_a, nb::kw_only(), "tau_rate_max"_a, "dt"_a);
    nb::class_<TorqueFilter, Law>(module, "TorqueFilter", "A law whose torques go through filters of second-order sections.")
        .def(nb::new_([](std::shared_ptr<Law> filtered, const In& sections) {
                 return new TorqueFilter(std::move(filtered), sections.matrix(sections.length("sections"), 6, "sections"));
             }),
             "filtered"_a, nb::kw_only(), "sections"_a);
    nb::class_<CFunctionLaw, Law>(module, "CFunctionLaw",
                                  "A compiled C function as a law; armctl/cpp/laws/c_function.hpp has its signature.")
        .def(nb::new_([](std::uintptr_t address, size_t n, const In& parameters, size_t memory_size, bool needs_wrench) {
                 return new CFunctionLaw(reinterpret_cast<LawFunction>(address), n, copied(parameters, "parameters"), memory_size,
                                         needs_wrench);
             }),
             "address"_a, nb::kw_only(), "n"_a, "parameters"_a, "memory_size"_a = 0, "needs_wrench"_a = false,
             "A law from the address of its function, which has to exist as long as the law.");
}

}  // namespace

void bind_laws(nb::module_& module) {
    bind_law(module);
    bind_pd(module);
    bind_computed_torque(module);
    bind_observer(module);
    bind_qp(module);
    bind_task_space(module);
    bind_hybrid_force(module);
    bind_others(module);
}

}  // namespace armctl
