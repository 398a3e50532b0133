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
        .def(
            "applied", [](Law& self, const In& tau) { self.applied(tau.vector(self.joints(), "tau")); }, "tau"_a,
            "Tells that the motors got torques (n,) N m that are not those of the last call of `torque`.")
        .def_prop_ro("memory", &shared<Law, &Law::memory>,
                     "What the law keeps from tick to tick; an array that shares the memory of the law.")
        .def("reset", &Law::reset, "Begins a new run.")
        .def("clone", &Law::clone, "The same law and gains with memory of its own, at the start of a run.");
}

template <class ConcreteLaw>
nb::class_<ConcreteLaw, Law> law_class(nb::module_& module, const char* name, const char* doc) {
    return nb::class_<ConcreteLaw, Law>(module, name, doc);
}

// The class of a law of an arm, from the gains that `read` reads.
template <class ConcreteLaw, class Reader>
nb::class_<ConcreteLaw, Law> bind_law_of_arm(nb::module_& module, const char* name, const char* doc, const Reader& read) {
    auto bound = law_class<ConcreteLaw>(module, name, doc);
    const auto make = [](ConcreteLaw* self, const Model& of, auto gains) { new (self) ConcreteLaw(of, std::move(gains)); };
    bind_constructor<Model>(bound, "__init__(self, of: ArmModel", read, make, "of"_a, "gains"_a);
    return bound;
}

template <class Given>
PDGains pd_gains(Given& given) {
    return {.stiffness = given.numbers("stiffness"), .damping = given.numbers("damping")};
}

void bind_pd(nb::module_& module) {
    const auto read = [](auto& given) { return pd_gains(given); };
    auto pd = law_class<PD>(module, "PD", "tau = stiffness (q_ref - q) + damping (v_ref - v)");
    bind_constructor<>(pd, "__init__(self", read, [](PD* self, PDGains gains) { new (self) PD(std::move(gains)); });
    bind_law_of_arm<PDFeedforward>(module, "PDFeedforward", "PD with the torque of the reference motion.", read);
    bind_law_of_arm<PDGravity>(module, "PDGravity", "PD with gravity compensation.", read);
}

struct RateLimit {
    Numbers tau_rate_max;
    double dt;
};

void bind_around_laws(nb::module_& module) {
    using Inner = std::shared_ptr<Law>;
    const auto read_limit = [](auto& given) { return RateLimit{given.numbers("tau_rate_max"), given.number("dt")}; };
    const auto make_limit = [](TorqueRateLimit* self, const Inner& of, RateLimit limit) {
        new (self) TorqueRateLimit(of, std::move(limit.tau_rate_max), limit.dt);
    };
    auto limit = law_class<TorqueRateLimit>(module, "TorqueRateLimit", "A law whose torques change at limited rates.");
    bind_constructor<Inner>(limit, "__init__(self, of: Law", read_limit, make_limit, "of"_a, "gains"_a);

    const auto read_sections = [](auto& given) {
        const Matrix rows = given.matrix(given.length("sections"), 6, "sections");
        std::vector<Biquad> sections;
        sections.reserve(rows.rows);
        for (size_t k = 0; k < rows.rows; ++k) {
            sections.push_back({.b0 = rows(k, 0), .b1 = rows(k, 1), .b2 = rows(k, 2), .a1 = rows(k, 4), .a2 = rows(k, 5)});
        }
        return sections;
    };
    const auto make_filter = [](TorqueFilter* self, const Inner& of, std::vector<Biquad> sections) {
        new (self) TorqueFilter(of, std::move(sections));
    };
    auto filter =
        law_class<TorqueFilter>(module, "TorqueFilter",
                                "A law whose torques go through filters of second-order sections: rows of b0, b1, b2, a0 = 1, a1, "
                                "a2, as in SciPy.");
    bind_constructor<Inner>(filter, "__init__(self, of: Law", read_sections, make_filter, "of"_a, "gains"_a);
}

void bind_c_function(nb::module_& module) {
    const auto read = [](auto& given) {
        return CFunctionOptions{
            .n = given.count("n"),
            .parameters = given.numbers("parameters"),
            .memory_size = given.count("memory_size"),
            .needs_wrench = given.flag("needs_wrench"),
        };
    };
    const auto make = [](CFunctionLaw* self, std::uintptr_t address, CFunctionOptions options) {
        const auto function = reinterpret_cast<LawFunction>(address);  // NOLINT(performance-no-int-to-ptr): Python has it as a number
        new (self) CFunctionLaw(function, std::move(options));
    };
    auto bound = law_class<CFunctionLaw>(module, "CFunctionLaw",
                                         "A compiled C function as a law; armctl/cpp/laws/c_function.hpp has its signature.");
    bind_constructor<std::uintptr_t>(bound, "__init__(self, address: int", read, make, "address"_a, "gains"_a);
}

template <class Given>
EstimateGains estimate_gains(Given& given) {
    return {
        .position_weight = given.number("position_weight"),
        .velocity_weight = given.number("velocity_weight"),
        .dt = given.number("dt"),
        .continuous = given.flag("continuous"),
    };
}

template <class Given>
ComputedTorqueGains computed_torque_gains(Given& given) {
    return {
        .stiffness = given.number("stiffness"),
        .damping = given.number("damping"),
        .added_damping = given.numbers("added_damping"),
        .decay_rate = given.number("decay_rate"),
        .textbook = given.flag("textbook"),
        .torque_limit = given.numbers("torque_limit"),
        .estimate = estimate_gains(given),
    };
}

template <class Given>
LQRGains lqr_gains(Given& given) {
    return {
        .nodes = given.matrix("nodes"),
        .feedback = given.matrix("feedback"),
        .torque_limit = given.numbers("torque_limit"),
        .estimate = estimate_gains(given),
    };
}

template <class Given>
ComputedTorqueObserverGains observer_gains(Given& given) {
    return {
        .stiffness = given.number("stiffness"),
        .damping = given.number("damping"),
        .disturbance_weight = given.number("disturbance_weight"),
        .torque_limit = given.numbers("torque_limit"),
        .estimate = estimate_gains(given),
    };
}

template <class Given>
ComputedTorqueLearningGains learning_gains(Given& given) {
    return {
        .observer = observer_gains(given),
        .filter_weight = given.number("filter_weight"),
        .information_weight = given.number("information_weight"),
        .forgetting = given.number("forgetting"),
        .torque_precision = given.numbers("torque_precision"),
        .prior_deviations = given.numbers("prior_deviations"),
    };
}

template <class Given>
ComputedTorqueQPGains qp_gains(Given& given) {
    return {
        .stiffness = given.number("stiffness"),
        .damping = given.number("damping"),
        .added_damping = given.numbers("added_damping"),
        .decay_rate = given.number("decay_rate"),
        .torque_limit = given.numbers("torque_limit"),
        .q_min = given.numbers("q_min"),
        .q_max = given.numbers("q_max"),
        .v_max = given.numbers("v_max"),
        .a_max = given.numbers("a_max"),
        .length = given.number("length"),
        .dt = given.number("dt"),
        .continuous = given.flag("continuous"),
    };
}

template <class Given>
MPCGains mpc_gains(Given& given) {
    const Integers blocks = given.integers("blocks");
    return {
        .limits = qp_gains(given),
        .blocks = {blocks.begin(), blocks.end()},
        .torque_rate = given.numbers("torque_rate"),
    };
}

void bind_computed_torque(nb::module_& module) {
    module.attr("BODY_PARAMETERS") = body_parameters;
    bind_law_of_arm<ComputedTorque>(module, "ComputedTorque",
                                    "Computed torque; with weights of an estimate, at estimated positions and velocities.",
                                    [](auto& given) { return computed_torque_gains(given); });
    bind_law_of_arm<LQR>(module, "LQR", "Linear quadratic regulator with integral action, at estimated positions and velocities.",
                         [](auto& given) { return lqr_gains(given); });
    constexpr const char* disturbance = "The estimated disturbance, (n,) N m; a part of the memory.";
    bind_law_of_arm<ComputedTorqueObserver>(module, "ComputedTorqueObserver",
                                            "Computed torque with a disturbance observer that estimates velocities.",
                                            [](auto& given) { return observer_gains(given); })
        .def_prop_ro("disturbance", &shared<ComputedTorqueObserver, &ComputedTorqueObserver::disturbance>, disturbance);
    bind_law_of_arm<ComputedTorqueLearning>(module, "ComputedTorqueLearning",
                                            "Computed torque with an observer, which learns payload, friction and delay.",
                                            [](auto& given) { return learning_gains(given); })
        .def_prop_ro("disturbance", &shared<ComputedTorqueLearning, &ComputedTorqueLearning::disturbance>, disturbance)
        .def_prop_ro("estimate", &shared<ComputedTorqueLearning, &ComputedTorqueLearning::estimate>,
                     "The ten parameters of the payload, the delay, s, and the dry friction of the joints, N m; a part of the memory.");
}

void bind_qp(nb::module_& module) {
    bind_law_of_arm<ComputedTorqueQP>(module, "ComputedTorqueQP", "Computed torque within limits of torque, velocity and position.",
                                      [](auto& given) { return qp_gains(given); });
    bind_law_of_arm<MPC>(module, "MPC", "Model predictive control within limits of torque, velocity and position.",
                         [](auto& given) { return mpc_gains(given); })
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

void bind_operational_space(nb::module_& module) {
    module.attr("SINGULARITY_DAMPING") = singularity_damping;
    const auto read = [](auto& given) {
        return OperationalSpaceGains{
            .stiffness = given.number("stiffness"),
            .damping = given.number("damping"),
            .posture_stiffness = given.number("posture_stiffness"),
            .posture_damping = given.number("posture_damping"),
        };
    };
    bind_law_of_arm<OperationalSpace>(module, "OperationalSpace", "Operational space control with a posture in the null space.", read);
}

void bind_impedance(nb::module_& module) {
    const auto read = [](auto& given) {
        return ImpedanceGains{
            .stiffness = given.numbers("stiffness"),
            .max_error = given.numbers("max_error"),
            .posture_stiffness = given.numbers("posture_stiffness"),
            .damping_ratio = given.number("damping_ratio"),
        };
    };
    bind_law_of_arm<Impedance>(module, "Impedance", "Cartesian impedance control without inertia shaping.", read)
        .def(
            "set_stiffness",
            [](Impedance& self, const In& stiffness) {
                const Vector numbers = stiffness.vector(stiffness.length("stiffness"), "stiffness");
                self.set_stiffness({numbers.begin(), numbers.end()});
            },
            "stiffness"_a, "Replaces the stiffness of the tip, (6,) N/m and N m/rad.");
}

void bind_admittance(nb::module_& module) {
    const auto read = [](auto& given) {
        return AdmittanceGains{
            .mass = given.numbers("mass"),
            .damping = given.numbers("damping"),
            .stiffness = given.numbers("stiffness"),
            .bandwidth = given.number("bandwidth"),
            .dt = given.number("dt"),
        };
    };
    bind_law_of_arm<Admittance>(module, "Admittance", "Admittance control: a position loop follows a compliant reference.", read)
        .def_prop_ro("offset", &shared<Admittance, &Admittance::offset>,
                     "The displacement of the reference, (6,) m and rad; a part of the memory.");
}

ForceAxes force_axes(Integers is_force, Vector targets) {
    ForceAxes axes;
    for (size_t k = 0; k < 6; ++k) {
        axes.is_force[k] = is_force[k] != 0;
        axes.targets[k] = targets[k];
    }
    return axes;
}

void bind_hybrid_force(nb::module_& module) {
    const auto read = [](auto& given) {
        return HybridForceGains{
            .bandwidth = given.number("bandwidth"),
            .damping_ratio = given.number("damping_ratio"),
            .in_tip_frame = given.flag("in_tip_frame"),
            .approach_speed = given.number("approach_speed"),
            .contact_force = given.number("contact_force"),
            .dt = given.number("dt"),
            .axes = force_axes(given.integers(6, "is_force"), given.vector(6, "targets")),
        };
    };
    bind_law_of_arm<HybridForce>(module, "HybridForce", "Hybrid force/motion control with contact transition.", read)
        .def(
            "set_axes",
            [](HybridForce& self, const IntegersIn& is_force, const In& targets) {
                self.set_axes(force_axes(is_force.vector(6, "is_force"), targets.vector(6, "targets")));
            },
            "is_force"_a, "targets"_a,
            "Replaces the force axes, `is_force` and `targets` (6,). One that comes back later begins with an approach.")
        .def_prop_ro("in_contact", &HybridForce::in_contact, "Whether every force axis with a target is in contact.");
}

}  // namespace

void bind_laws(nb::module_& module) {
    bind_law(module);
    bind_pd(module);
    bind_around_laws(module);
    bind_c_function(module);
    bind_computed_torque(module);
    bind_qp(module);
    bind_operational_space(module);
    bind_impedance(module);
    bind_admittance(module);
    bind_hybrid_force(module);
}

}  // namespace armctl
