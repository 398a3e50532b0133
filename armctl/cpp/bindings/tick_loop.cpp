// MuJoCo's functions, the tick loop of simulations, and what it is made of.
#include "../tick_loop.hpp"

#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "arguments.hpp"
#include "callback_law.hpp"
#include "topics.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace armctl {

namespace {

using Api = std::shared_ptr<const MujocoApi>;

// A function from its address.
template <class Function>
void set(Function& function, std::int64_t address) {
    function = reinterpret_cast<Function>(address);  // NOLINT(performance-no-int-to-ptr): Python has it as a number
}

void bind_api(nb::module_& module) {
    const auto read = [](auto& given) {
        MujocoApi api;
        set(api.step, given.integer("step"));
        set(api.rne_post_constraint, given.integer("rne_post_constraint"));
        set(api.make_batch, given.integer("make_batch"));
        set(api.delete_batch, given.integer("delete_batch"));
        set(api.apply, given.integer("apply"));
        set(api.error, given.integer("error"));
        api.contacts = {
            .count = given.count("contact_count"),
            .array = given.count("contact_array"),
            .stride = given.count("contact_stride"),
            .geoms = given.count("contact_geoms"),
            .exclude = given.count("contact_exclude"),
        };
        api.repairs = {.first = given.count("repair_first"), .stride = given.count("repair_stride")};
        return api;
    };
    const auto make = [](MujocoApi* self, nb::handle empty_model, MujocoApi api) {
        api.empty_model = mujoco_model(empty_model);
        new (self) MujocoApi(api);
    };
    nb::class_<MujocoApi> bound(module, "MujocoApi", "MuJoCo's functions by their addresses, and where mjData keeps contacts.");
    bind_constructor<nb::handle>(bound, "__init__(self, empty_model: object", read, make, "empty_model"_a, "given"_a,
                                 nb::keep_alive<1, 2>());
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

void bind_sensors(nb::module_& module) {
    const auto read = [](auto& given) {
        SensorsOptions options{
            .motors = motors_of(given, true),
            .dt = given.number("dt"),
            .steps = {},
            .is_at_motors = given.flag("is_at_motors"),
            .is_differenced = given.flag("is_differenced"),
            .max_age = given.count("max_age"),
        };
        if (given.has("steps")) { options.steps = given.numbers("steps"); }
        return options;
    };
    const auto make = [](Sensors* self, SensorsOptions options) { new (self) Sensors(std::move(options)); };
    nb::class_<Sensors> bound(module, "Sensors", "How the sensors of a plant measure its joints during a run.");
    bind_constructor<>(bound, "__init__(self", read, make, "given"_a,
                       "Sensors at the start of a run; armctl/cpp/sensors.hpp explains the arguments.");
    bound.def_prop_ro("has_measured", &Sensors::has_measured, "Whether this tick is measured already.")
        .def(
            "measure",
            [](Sensors& self, nb::handle model, nb::handle data, const In& noise, const IntegersIn& ages) {
                self.measure(mujoco_simulation(model, data), noise.shaped({2, self.joints()}, "noise"), ages.vector(self.joints(), "ages"));
            },
            "model"_a, "data"_a, "noise"_a, "ages"_a,
            "Measures, once in a tick, with noise (2, n) on positions and velocities; `ages`, (n,), is by how many ticks what is read is "
            "old.")
        .def(
            "read",
            [](const Sensors& self, const Out& q, const Out& v, const Out& deflection) {
                const size_t n = self.joints();
                copy(self.q(), q.vector(n, "q"));
                copy(self.v(), v.vector(n, "v"));
                copy(self.deflection(), deflection.shaped({2, n}, "deflection"));
            },
            "q"_a, "v"_a, "deflection"_a, "What was read at this tick: (n,) rad, (n,) rad/s, and (2, n) motors minus links.");
}

void bind_callback_law(nb::module_& module) {
    nb::class_<CallbackLaw, Law>(module, "CallbackLaw", "A law in Python, which is called at every tick.")
        .def(nb::init<nb::object, nb::object>(), "call"_a, "tau"_a,
             "`call()` writes the torque, (n,) N m, into the array `tau`. If it raises, the ticks end, and `TickLoop.run` raises it.");
}

template <class Given>
WrenchSensorOptions sensor_options(Given& given) {
    const Integers bodies = given.integers("bodies");
    return {
        .bodies = std::vector<size_t>(bodies.begin(), bodies.end()),
        .root = given.count("root"),
        .tip = given.count("tip"),
        .offset = vec3(given.vector(3, "offset")),
        .is_connected = given.flag("is_connected"),
        .is_sampled = given.flag("is_sampled"),
        .dt = given.number("dt"),
        .delay = given.count("delay"),
        .estimated = given.count("estimated"),
    };
}

void bind_wrench_sensor(nb::module_& module) {
    const auto read = [](auto& given) { return sensor_options(given); };
    const auto make = [](WrenchSensor* self, const Api& api, nb::handle model, nb::handle data, const Model& arm,
                         WrenchSensorOptions options) {
        new (self) WrenchSensor(api, mujoco_simulation(model, data), arm, std::move(options));
    };
    nb::class_<WrenchSensor> bound(module, "WrenchSensor", "The wrench of the environment on a tip, true or measured.");
    bind_constructor<Api, nb::handle, nb::handle, Model>(
        bound, "__init__(self, api: MujocoApi, model: object, data: object, arm: ArmModel", read, make, "api"_a, "model"_a, "data"_a,
        "arm"_a, "given"_a, nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(),
        "A sensor in a mujoco.MjModel and MjData; armctl/cpp/wrench_sensor.hpp explains the arguments.");
    bound.def("reset", &WrenchSensor::reset, "Forgets all measurements.")
        .def("has_measured", &WrenchSensor::has_measured, "t"_a, "Whether the measurement at a time, s, is made already.")
        .def(
            "read",
            [](const WrenchSensor& self, const In& push, const Out& wrench) {
                copy(self.read(push.optional_vector(6, "push")), wrench.vector(6, "wrench"));
            },
            "push"_a.none(), "wrench"_a, "The true wrench now, (6,), with that of the plant's pushes.")
        .def(
            "measure",
            [](WrenchSensor& self, const In& q, const In& v, const In& tau, double t, const In& noise, const In& push, const Out& wrench,
               const Out& truth) {
                const size_t n = self.joints();
                const WrenchSignals signals{
                    .t = t,
                    .q = q.vector(n, "q"),
                    .v = v.vector(n, "v"),
                    .tau = tau.vector(n, "tau"),
                    .noise = noise.optional_vector(6, "noise"),
                    .push = push.optional_vector(6, "push"),
                };
                Wrench true_wrench;
                copy(self.measure(signals, true_wrench), wrench.vector(6, "wrench"));
                copy(true_wrench, truth.vector(6, "truth"));
            },
            "q"_a, "v"_a, "tau"_a, "t"_a, "noise"_a.none(), "push"_a.none(), "wrench"_a, "truth"_a,
            "What the sensor gives at this tick, and the true wrench, (6,) each.\n\n"
            "The state and the torque of the motors in the last tick are measured, (n,) each.");
}

template <class Given>
Ticks ticks_of(Given& given, size_t n, size_t nq) {
    const size_t rows = given.length("v_rows");
    Ticks ticks{
        .first = given.count("first"),
        .last = given.count("last"),
        .q = given.matrix(rows, n, "q"),
        .v = given.matrix(rows, n, "v"),
        .a = given.matrix(rows, n, "a"),
        .v_tick = given.matrix(rows, n, "v_tick"),
        .a_tick = given.matrix(rows, n, "a_tick"),
        .qpos_rows = given.writable_matrix(rows, nq, "qpos_rows"),
        .v_rows = given.writable_matrix(rows, n, "v_rows"),
        .command_rows = given.writable_matrix(rows, n, "command_rows"),
        .torque_rows = given.writable_matrix(rows, n, "torque_rows"),
    };
    const size_t count = ticks.count();
    const size_t tips = given.count("tips");
    if (given.has("wrench_rows")) { ticks.wrench_rows = given.writable_matrix(rows, 6 * tips, "wrench_rows"); }
    if (given.has("noise")) { ticks.noise = given.shaped({count, 2, n}, "noise"); }
    if (given.has("ages")) { ticks.ages = given.template array<const std::int64_t>({count, n}, "ages"); }
    if (given.has("jitter")) { ticks.jitter = given.integers(count, "jitter"); }
    if (given.has("pushes")) { ticks.pushes = given.matrix(count, 6, "pushes"); }
    if (given.has("push")) { ticks.push = given.writable({6}, "push"); }
    if (given.has("times")) { ticks.times = given.vector(count, "times"); }
    if (given.has("wrench_noise")) { ticks.wrench_noise = given.matrix(count, 6 * tips, "wrench_noise"); }
    if (given.has("q_seen_rows")) {
        ticks.q_seen_rows = given.writable_matrix(count, n, "q_seen_rows");
        ticks.v_seen_rows = given.writable_matrix(count, n, "v_seen_rows");
    }
    if (given.has("wrench_seen_rows")) { ticks.wrench_seen_rows = given.writable_matrix(count, 6 * tips, "wrench_seen_rows"); }
    if (given.has("deflection_seen_rows")) {
        ticks.deflection_seen_rows = {given.writable({count, 2, n}, "deflection_seen_rows").data(), count, 2 * n};
    }
    return ticks;
}

// Raises the exception of a law in Python, if that ended the ticks.
void raise_from(Law* law) {
    if (auto* callback = dynamic_cast<CallbackLaw*>(law)) { callback->raise(); }
}

void run_ticks(TickLoop& loop, Law& law, TickEnd& end, Sensors* sensors, Delay* delay, Law* joint_torque,
               const std::vector<WrenchSensor*>& wrench_sensors, const nb::bytes& touching, const nb::kwargs& given) {
    const Arguments arguments(given);
    const Ticks ticks = ticks_of(arguments, loop.joints(), loop.simulation().qpos.size());
    const Signals signals{.sensors = sensors, .delay = delay, .joint_torque = joint_torque, .wrench_sensors = wrench_sensors};
    loop.check(ticks, law, signals);
    std::string geoms(touching.c_str(), touching.size());
    // The ticks use a law of their own, so that another simulation may use this one at the same time.
    const std::unique_ptr<Law> own = law.clone();
    own->set_memory(law.memory());
    {
        nb::gil_scoped_release release;
        end = loop.run(ticks, *own, signals, std::move(geoms));
    }
    law.set_memory(own->memory());
    raise_from(own.get());
    raise_from(joint_torque);
}

nb::list contact_changes(const TickEnd& end) {
    nb::list changes;
    for (const ContactChange& change : end.contacts) {
        changes.append(nb::make_tuple(change.row, nb::bytes(change.geoms.data(), change.geoms.size())));
    }
    return changes;
}

void bind_tick_end(nb::module_& module) {
    nb::enum_<TickStatus>(module, "TickStatus", "Why the ticks ended.")
        .value("complete", TickStatus::complete)
        .value("diverged", TickStatus::diverged)
        .value("not_finite", TickStatus::not_finite)
        .value("repaired", TickStatus::repaired);
    nb::class_<TickEnd>(module, "TickEnd", "How some ticks ended.")
        .def(nb::new_([](size_t row) { return TickEnd{.row = row, .count = row}; }), "row"_a,
             "An object for `TickLoop.run`, which begins at a row.")
        .def_ro("status", &TickEnd::status)
        .def_ro("row", &TickEnd::row, "The last row that was begun.")
        .def_ro("count", &TickEnd::count, "Complete rows.")
        .def_ro("measured", &TickEnd::measured, "Rows in which the state was measured.")
        .def_ro("driven", &TickEnd::driven, "Rows in which the motors got a command.")
        .def_ro("error", &TickEnd::error, "MuJoCo's message if it could not make a step; else empty.")
        .def_prop_ro("contacts", &contact_changes,
                     "(row, geoms) for each row at which the touching geoms change; `geoms` are pairs of int32.");
}

void bind_loop(nb::module_& module) {
    const auto read = [](auto& given) {
        return TickLoopOptions{
            .motors = motors_of(given, true),
            .substeps = given.count("substeps"),
            .dt = given.number("dt"),
            .diverged_speed = given.number("diverged_speed"),
        };
    };
    const auto make = [](TickLoop* self, const Api& api, nb::handle model, nb::handle data, const Model& pushed_arm,
                         TickLoopOptions options) {
        new (self) TickLoop(api, mujoco_simulation(model, data), pushed_arm, std::move(options));
    };
    nb::class_<TickLoop> bound(module, "TickLoop",
                               "The tick loop of one simulation: measure, control, step, record. One thread at a time.");
    bind_constructor<Api, nb::handle, nb::handle, Model>(
        bound, "__init__(self, api: MujocoApi, model: object, data: object, pushed_arm: ArmModel", read, make, "api"_a, "model"_a, "data"_a,
        "pushed_arm"_a, "given"_a, nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(),
        "The loop of a mujoco.MjModel and MjData; armctl/cpp/tick_loop.hpp explains the arguments.");
    const std::string run = signature(
        "run(self, law: Law, end: TickEnd, sensors: Sensors | None, delay: Delay | None, joint_torque: Law | None, "
        "wrench_sensors: collections.abc.Sequence[WrenchSensor], touching: bytes",
        [](auto& given) { return ticks_of(given, 0, 0); });
    bound.def("run", &run_ticks, "law"_a, "end"_a, "sensors"_a.none(), "delay"_a.none(), "joint_torque"_a.none(), "wrench_sensors"_a,
              "touching"_a, "ticks"_a, nb::sig(run.c_str()),
              "Runs the ticks [first, last) of a reference and records them; `Ticks` in armctl/cpp/tick_loop.hpp explains the arrays, and "
              "`tips` is the number of wrench sensors.\n\n"
              "How they ended is written into `end`: an exception of a law in Python, or an interrupt, which raises when the call "
              "returns, would lose a result. `touching` are the geoms that touch in the row before, as in `TickEnd.contacts`.");
}

}  // namespace

void bind_tick_loop(nb::module_& module) {
    bind_api(module);
    bind_delay(module);
    bind_sensors(module);
    bind_callback_law(module);
    bind_wrench_sensor(module);
    bind_tick_end(module);
    bind_loop(module);
}

}  // namespace armctl
