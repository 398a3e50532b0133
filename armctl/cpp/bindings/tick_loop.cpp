// MuJoCo's functions, the tick loop of simulations, and what it is made of.
#include "../tick_loop.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "../least_squares.hpp"
#include "arrays.hpp"
#include "mujoco_arguments.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Model = std::shared_ptr<const ArmModel>;
using Api = std::shared_ptr<const MujocoApi>;

// A function, or a struct, from its address.
template <class Pointer>
void set(Pointer& pointer, std::uintptr_t address) {
    pointer = reinterpret_cast<Pointer>(address);  // NOLINT(performance-no-int-to-ptr): Python has it as a number
}

std::shared_ptr<MujocoApi> make_api(std::uintptr_t step, std::uintptr_t rne_post_constraint, std::uintptr_t make_batch,
                                    std::uintptr_t delete_batch, std::uintptr_t apply, std::uintptr_t error, nb::handle empty_model,
                                    size_t contact_count, size_t contact_array, size_t contact_stride, size_t contact_geoms) {
    auto api = std::make_shared<MujocoApi>();
    set(api->step, step);
    set(api->rne_post_constraint, rne_post_constraint);
    set(api->make_batch, make_batch);
    set(api->delete_batch, delete_batch);
    set(api->apply, apply);
    set(api->error, error);
    api->empty_model = mujoco_model(empty_model);
    api->contacts = {
        .count = contact_count,
        .array = contact_array,
        .stride = contact_stride,
        .geoms = contact_geoms,
    };
    return api;
}

void bind_api(nb::module_& module) {
    nb::class_<MujocoApi>(module, "MujocoApi", "MuJoCo's functions by their addresses, and where mjData keeps contacts.")
        .def(nb::new_(&make_api), nb::kw_only(), "step"_a, "rne_post_constraint"_a, "make_batch"_a, "delete_batch"_a, "apply"_a, "error"_a,
             "empty_model"_a, "contact_count"_a, "contact_array"_a, "contact_stride"_a, "contact_geoms"_a, nb::keep_alive<0, 8>());
}

void bind_delay(nb::module_& module) {
    nb::class_<Delay>(module, "Delay", "Commands that reach the motors some ticks after they were given.")
        .def(nb::init<size_t, size_t>(), "n"_a, "max_ticks"_a)
        .def("restart", &Delay::restart, "ticks"_a, "Forgets all commands, and delays those to come by some ticks.")
        .def(
            "delayed",
            [](Delay& self, const In& tau, const Out& delayed) {
                const Result result = delayed.vector(self.joints(), "delayed");
                std::ranges::copy(self.delayed(tau.vector(self.joints(), "tau")), result.begin());
            },
            "tau"_a, "delayed"_a, "Takes the command of this tick, (n,) N m, and gives that of some ticks ago.");
}

void bind_tip_force(nb::module_& module) {
    nb::class_<TipForce>(module, "TipForce", "Joint torques of forces on the tip.")
        .def(nb::init<Model>(), "model"_a)
        .def(
            "torque",
            [](TipForce& self, const In& q, const In& wrench, const Out& tau) {
                const size_t n = self.joints();
                self.torque(q.vector(n, "q"), wrench.vector(6, "wrench"), tau.vector(n, "tau"));
            },
            "q"_a, "wrench"_a, "tau"_a, "J(q)^T wrench, (n,) N m, for a wrench (6,): force first, world axes.");
    module.def(
        "solve_least_squares",
        [](const Out& A, const In& b, const Out& x) {
            const size_t r = x.length("x");
            const size_t n = b.length("b");
            std::vector<double> rotations(r * r);
            solve_least_squares(A.matrix(r, n, "A"), b.vector(n, "b"), {rotations.data(), r, r}, x.vector(r, "x"));
        },
        "A"_a, "b"_a, "x"_a, "Adds to x (r,) the shortest vector that minimizes |A^T x - b|; A (r, n) is overwritten.");
}

WrenchSensor* new_wrench_sensor(Api api, nb::handle model, nb::handle data, Model arm, const IntegersIn& bodies, size_t root, size_t tip,
                                const In& offset, bool is_connected, double dt, size_t delay, bool is_sampled, size_t estimated) {
    WrenchSite site{
        .joints = arm->n(),
        .bodies = {},
        .root = root,
        .tip = tip,
        .offset = vec3(offset.vector(3, "offset")),
        .is_connected = is_connected,
    };
    for (const std::int64_t body : bodies.vector(bodies.length("bodies"), "bodies")) { site.bodies.push_back(address(body)); }
    if (estimated != 0 && estimated != 3 && estimated != 6) { throw InputError("estimated: need 0, 3 or 6"); }
    std::optional<WrenchEstimate> estimate;
    if (estimated > 0) { estimate.emplace(std::move(arm), dt, estimated); }
    return new WrenchSensor(std::move(api), mujoco_simulation(model, data), std::move(site),
                            {.dt = dt, .delay = delay, .is_sampled = is_sampled}, std::move(estimate));
}

void bind_wrench_sensor(nb::module_& module) {
    nb::class_<WrenchSensor>(module, "WrenchSensor", "The wrench of the environment on a tip, true or measured.")
        .def(nb::new_(&new_wrench_sensor), "api"_a, "model"_a, "data"_a, nb::kw_only(), "arm"_a, "bodies"_a, "root"_a, "tip"_a, "offset"_a,
             "is_connected"_a, "dt"_a, "delay"_a, "is_sampled"_a, "estimated"_a, nb::keep_alive<0, 3>(), nb::keep_alive<0, 4>(),
             "A sensor in a mujoco.MjModel and MjData; armctl/cpp/wrench_sensor.hpp explains the arguments.\n\n"
             "`estimated` numbers of the wrench follow from the torques of the motors; 0 if a flange sensor measures it.")
        .def("reset", &WrenchSensor::reset, "Forgets all measurements.")
        .def(
            "read",
            [](const WrenchSensor& self, nb::handle push, const Out& wrench) {
                self.read(OptionalIn(push).vector(6, "push")).store(wrench.vector(6, "wrench"));
            },
            "push"_a.none(), "wrench"_a, "The true wrench now, (6,), with that of the plant's pushes.")
        .def(
            "measure",
            [](WrenchSensor& self, const In& q, const In& v, const In& tau, double t, nb::handle noise, nb::handle push, const Out& wrench,
               const Out& truth) {
                const size_t n = self.joints();
                const OptionalIn noise_array(noise);
                const OptionalIn push_array(push);
                const WrenchSignals signals{
                    .t = t,
                    .q = q.vector(n, "q"),
                    .v = v.vector(n, "v"),
                    .tau = tau.vector(n, "tau"),
                    .noise = noise_array.vector(6, "noise"),
                    .push = push_array.vector(6, "push"),
                };
                Wrench true_wrench;
                self.measure(signals, true_wrench).store(wrench.vector(6, "wrench"));
                true_wrench.store(truth.vector(6, "truth"));
            },
            "q"_a, "v"_a, "tau"_a, "t"_a, "noise"_a.none(), "push"_a.none(), "wrench"_a, "truth"_a,
            "What the sensor gives at this tick, and the true wrench, (6,) each.\n\n"
            "The state and the torque of the motors in the last tick are measured, (n,) each.");
}

TickLoop* new_tick_loop(Api api, nb::handle model, nb::handle data, const IntegersIn& qpos_addresses, const IntegersIn& dof_addresses,
                        const IntegersIn& ctrl_addresses, const IntegersIn& torque_addresses, const In& gear, const In& torque_share,
                        Model pushed_arm, size_t substeps, double dt, double diverged_speed) {
    std::vector<Motor> motors = motors_of({.qpos = qpos_addresses, .dof = dof_addresses, .ctrl = ctrl_addresses, .gear = gear});
    const std::span<const std::int64_t> torques = torque_addresses.vector(motors.size(), "torque_addresses");
    const Vector shares = torque_share.vector(motors.size(), "torque_share");
    for (size_t i = 0; i < motors.size(); ++i) {
        motors[i].torque = address(torques[i]);
        motors[i].torque_share = shares[i];
    }
    return new TickLoop(std::move(api), mujoco_simulation(model, data), std::move(motors), std::move(pushed_arm),
                        {.substeps = substeps, .dt = dt, .diverged_speed = diverged_speed});
}

std::vector<GeomPair> geoms_of(const nb::bytes& geoms) {
    const GeomPair* first = static_cast<const GeomPair*>(geoms.data());
    const size_t count = geoms.size() / sizeof(GeomPair);
    return {first, first + count};
}

// The ticks of a call of `TickLoop.run`, as Python passes them.
struct TickArguments {
    const In& q;
    const In& v;
    const In& a;
    const In& v_tick;
    const In& a_tick;
    const Out& qpos_rows;
    const Out& v_rows;
    const Out& command_rows;
    const Out& torque_rows;
    OptionalOut wrench_rows;
    size_t first;
    size_t last;
    Delay* delay;
    OptionalIn noise;
    OptionalIn pushes;
    OptionalOut push;
    OptionalOut last_position;
    WrenchSensor* sensor;
    OptionalIn times;
    OptionalIn wrench_noise;
    const nb::bytes& touching;
};

void check_ticks(const TickLoop& loop, const Law& law, const TickArguments& given, const TickRows& rows, const Disturbances& disturbances,
                 const TickSensor& sensor) {
    if (given.first > given.last || given.last > rows.v.rows) { throw InputError("first, last: they are not rows of the reference"); }
    if (law.joints() != loop.joints()) {
        throw InputError("law: it is one for " + std::to_string(law.joints()) + " joints, and the simulation has " +
                         std::to_string(loop.joints()));
    }
    if (given.delay != nullptr && given.delay->joints() != loop.joints()) {
        throw InputError("delay: it is one for another number of joints");
    }
    if (disturbances.pushes.rows > 0 && (given.delay == nullptr || disturbances.push.empty())) {
        throw InputError("pushes: they need a delay, and `push`, where the last one is noted");
    }
    const bool has_ticks = given.first < given.last;
    const bool is_sensed = sensor.sensor != nullptr && !sensor.times.empty() && rows.wrench.rows > 0;
    if (has_ticks && (law.needs_wrench() || sensor.sensor != nullptr) && !is_sensed) {
        throw InputError("sensor: a law that needs the wrench needs a sensor, the times of the ticks, and wrench_rows");
    }
    if (sensor.sensor != nullptr && sensor.sensor->joints() != loop.joints()) {
        throw InputError("sensor: it is one for another number of joints");
    }
}

void run_ticks(TickLoop& loop, Law& law, TickEnd& end, const TickArguments& given) {
    const size_t n = loop.joints();
    const size_t ticks = given.v_rows.length("v_rows");
    const size_t coming = given.last > given.first ? given.last - given.first : 0;
    const TickReference reference{
        .q = given.q.matrix(ticks, n, "q"),
        .v = given.v.matrix(ticks, n, "v"),
        .a = given.a.matrix(ticks, n, "a"),
        .v_tick = given.v_tick.matrix(ticks, n, "v_tick"),
        .a_tick = given.a_tick.matrix(ticks, n, "a_tick"),
    };
    const TickRows rows{
        .qpos = given.qpos_rows.matrix(ticks, loop.simulation().qpos.size(), "qpos_rows"),
        .v = given.v_rows.matrix(ticks, n, "v_rows"),
        .command = given.command_rows.matrix(ticks, n, "command_rows"),
        .torque = given.torque_rows.matrix(ticks, n, "torque_rows"),
        .wrench = given.wrench_rows.matrix(ticks, 6, "wrench_rows"),
    };
    const Disturbances disturbances{
        .delay = given.delay,
        .noise = {given.noise.shaped({coming, 2, n}, "noise")},
        .pushes = given.pushes.matrix(coming, 6, "pushes"),
        .push = given.push.vector(6, "push"),
        .last_position = given.last_position.vector(n, "last_position"),
    };
    const TickSensor sensor{
        .sensor = given.sensor,
        .times = given.times.vector(coming, "times"),
        .noise = given.wrench_noise.matrix(coming, 6, "wrench_noise"),
    };
    check_ticks(loop, law, given, rows, disturbances, sensor);
    std::vector<GeomPair> touching = geoms_of(given.touching);
    // The ticks use a law of their own, so that another simulation may use this one at the same time.
    const std::unique_ptr<Law> own = law.clone();
    own->set_memory(law.memory());
    {
        nb::gil_scoped_release release;
        end = loop.run(*own, reference, rows, given.first, given.last, disturbances, sensor, std::move(touching));
    }
    law.set_memory(own->memory());
}

nb::list contact_changes(const TickEnd& end) {
    nb::list changes;
    for (const ContactChange& change : end.contacts) {
        changes.append(nb::make_tuple(change.row, nb::bytes(change.geoms.data(), change.geoms.size() * sizeof(GeomPair))));
    }
    return changes;
}

void bind_tick_end(nb::module_& module) {
    nb::enum_<TickStatus>(module, "TickStatus", "Why the ticks ended.")
        .value("complete", TickStatus::complete)
        .value("diverged", TickStatus::diverged)
        .value("not_finite", TickStatus::not_finite);
    nb::class_<TickEnd>(module, "TickEnd", "How some ticks ended.")
        .def(nb::new_([](size_t row) { return TickEnd{.row = row, .count = row}; }), "row"_a,
             "An object for `TickLoop.run`, which begins at a row.")
        .def_ro("status", &TickEnd::status)
        .def_ro("row", &TickEnd::row, "The last row that was begun.")
        .def_ro("count", &TickEnd::count, "Complete rows.")
        .def_ro("error", &TickEnd::error, "MuJoCo's message if it could not make a step; else empty.")
        .def_ro("q_seen", &TickEnd::q_seen, "The positions measured in the last row that was begun, rad.")
        .def_ro("v_seen", &TickEnd::v_seen, "The velocities measured there, rad/s.")
        .def_prop_ro("contacts", &contact_changes,
                     "(row, geoms) for each row at which the touching geoms change; `geoms` are pairs of int32.");
}

void bind_loop(nb::module_& module) {
    nb::class_<TickLoop>(module, "TickLoop", "The tick loop of one simulation: measure, control, step, record. One thread at a time.")
        .def(nb::new_(&new_tick_loop), "api"_a, "model"_a, "data"_a, nb::kw_only(), "qpos_addresses"_a, "dof_addresses"_a,
             "ctrl_addresses"_a, "torque_addresses"_a, "gear"_a, "torque_share"_a, "pushed_arm"_a, "substeps"_a, "dt"_a, "diverged_speed"_a,
             nb::keep_alive<0, 3>(), nb::keep_alive<0, 4>(),
             "The loop of a mujoco.MjModel and MjData.\n\n"
             "The addresses are those of the motors' joints in qpos and qvel, of the motors in ctrl and of their torques in\n"
             "qfrc_actuator; torques are ctrl times `gear`, and qfrc_actuator times `torque_share`. Pushes act on the tip of\n"
             "`pushed_arm`.")
        .def(
            "run",
            [](TickLoop& self, Law& law, TickEnd& end, const In& q, const In& v, const In& a, const In& v_tick, const In& a_tick,
               const Out& qpos_rows, const Out& v_rows, const Out& command_rows, const Out& torque_rows, nb::handle wrench_rows,
               size_t first, size_t last, Delay* delay, nb::handle noise, nb::handle pushes, nb::handle push, nb::handle last_position,
               WrenchSensor* sensor, nb::handle times, nb::handle wrench_noise, const nb::bytes& touching) {
                run_ticks(self, law, end,
                          {
                              .q = q,
                              .v = v,
                              .a = a,
                              .v_tick = v_tick,
                              .a_tick = a_tick,
                              .qpos_rows = qpos_rows,
                              .v_rows = v_rows,
                              .command_rows = command_rows,
                              .torque_rows = torque_rows,
                              .wrench_rows = OptionalOut(wrench_rows),
                              .first = first,
                              .last = last,
                              .delay = delay,
                              .noise = OptionalIn(noise),
                              .pushes = OptionalIn(pushes),
                              .push = OptionalOut(push),
                              .last_position = OptionalOut(last_position),
                              .sensor = sensor,
                              .times = OptionalIn(times),
                              .wrench_noise = OptionalIn(wrench_noise),
                              .touching = touching,
                          });
            },
            "law"_a, "end"_a, nb::kw_only(), "q"_a, "v"_a, "a"_a, "v_tick"_a, "a_tick"_a, "qpos_rows"_a, "v_rows"_a, "command_rows"_a,
            "torque_rows"_a, "wrench_rows"_a.none() = nb::none(), "first"_a, "last"_a, "delay"_a.none() = nb::none(),
            "noise"_a.none() = nb::none(), "pushes"_a.none() = nb::none(), "push"_a.none() = nb::none(),
            "last_position"_a.none() = nb::none(), "sensor"_a.none() = nb::none(), "times"_a.none() = nb::none(),
            "wrench_noise"_a.none() = nb::none(), "touching"_a,
            "Runs the ticks [first, last) of a reference, (ticks, n) each, and records them in the rows, (ticks, ...) each.\n\n"
            "How they ended is written into `end`: an interrupt, which raises when the call returns, would lose a result.\n"
            "Without a delay, the motors receive the command itself. Noise (last - first, 2, n), pushes (last - first, 6),\n"
            "times (last - first,) and wrench_noise (last - first, 6) begin at the first of the ticks. `push` (6,) gets the\n"
            "last of the pushes. With `last_position` (n,), NaN at the first tick, measured velocities are differences of "
            "positions.\n"
            "`touching` are the geoms that touch in the row before, as in `TickEnd.contacts`.");
}

}  // namespace

void bind_tick_loop(nb::module_& module) {
    bind_api(module);
    bind_delay(module);
    bind_tip_force(module);
    bind_wrench_sensor(module);
    bind_tick_end(module);
    bind_loop(module);
}

}  // namespace armctl
