// The core without Python: kinematics, dynamics, laws, and the tick loop on MuJoCo's own library, which also judges the dynamics.
#include <mujoco/mjbatch.h>
#include <mujoco/mujoco.h>

#include <cstddef>
#include <cstdlib>
#include <limits>
#include <memory>
#include <new>
#include <stdexcept>
#include <vector>

#include "checks.hpp"
#include "laws/computed_torque.hpp"
#include "laws/computed_torque_observer.hpp"
#include "laws/impedance.hpp"
#include "laws/mpc.hpp"
#include "laws/pd.hpp"
#include "point_cloud.hpp"
#include "tick_loop.hpp"

using namespace armctl;

namespace {
size_t allocations = 0;
}  // namespace

void* operator new(size_t size) {
    ++allocations;
    void* memory = std::malloc(size);
    if (memory == nullptr) { throw std::bad_alloc(); }
    return memory;
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t) noexcept { std::free(memory); }

namespace {

// A hinge about y at the origin, and one about x at its tip: both links are bent, and the second one has an inertia of its own.
constexpr const char* arm_xml = R"(
<mujoco>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 -9.81"/>
  <worldbody>
    <body pos="0 0 0.2">
      <joint name="first" axis="0 1 0" armature="0.1" damping="0.5"/>
      <inertial pos="0.2 0.01 0" mass="2" diaginertia="0.01 0.02 0.03"/>
      <body pos="0.4 0 0">
        <joint name="second" axis="1 0 0" armature="0.05" damping="0.2"/>
        <inertial pos="0 0.15 -0.02" mass="1.5" diaginertia="0.02 0.01 0.02"/>
        <site name="tip" pos="0 0.3 0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="first"/><motor joint="second"/></actuator>
</mujoco>)";

constexpr size_t n = 2;
constexpr double dt = 0.002;

// A frame whose z axis is an axis of the frame around it.
Rotation about_y() { return {{0.0, 0.0, 1.0}, {1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}}; }

// The same arm for the core, whose joints turn about their own z axes.
Model make_arm() {
    const Rotation first = about_y();
    // The second axis, x of the world at position zero, in the first joint's frame.
    const Rotation second{{0.0, 0.0, 1.0}, {1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}};
    const Rotation T_world_second = first * second;
    const auto inertia = [](const Rotation& R, Vec3 diagonal) {  // of the world's axes, in those of a joint
        const Rotation transposed{R.row_x(), R.row_y(), R.row_z()};
        return rotated(transposed, {.xx = diagonal.x, .yy = diagonal.y, .zz = diagonal.z});
    };
    ArmDescription arm;
    arm.joints = {
        {
            .rotation = first,
            .translation = {0.0, 0.0, 0.2},
            .mass = 2.0,
            .center = first.inverse_times({0.2, 0.01, 0.0}),
            .inertia = inertia(first, {0.01, 0.02, 0.03}),
        },
        {
            .rotation = second,
            .translation = first.inverse_times({0.4, 0.0, 0.0}),
            .parent = 0,
            .mass = 1.5,
            .center = T_world_second.inverse_times({0.0, 0.15, -0.02}),
            .inertia = inertia(T_world_second, {0.02, 0.01, 0.02}),
        },
    };
    arm.drives = {{.armature = 0.1, .damping = {.linear = 0.5}}, {.armature = 0.05, .damping = {.linear = 0.2}}};
    arm.ratio = Mat(n, n);
    set_identity(arm.ratio);
    arm.chain_length = n;
    arm.gravity = {0.0, 0.0, -9.81};
    arm.T_last_tip = {Rotation(), T_world_second.inverse_times({0.0, 0.3, 0.1})};
    arm.implicit_damping = true;
    return std::make_shared<ArmModel>(ArmModel(arm).for_period(dt, false));
}

struct Freed {
    void operator()(mjSpec* spec) const { mj_deleteSpec(spec); }
    void operator()(mjModel* model) const { mj_deleteModel(model); }
    void operator()(mjData* data) const { mj_deleteData(data); }
};

// A simulation of the arm by MuJoCo, with its functions as the core calls them.
struct Simulation {
    explicit Simulation(const char* xml) {
        char error[500] = "";
        const std::unique_ptr<mjSpec, Freed> spec(mj_parseXMLString(xml, nullptr, error, sizeof(error)));
        if (!spec) { throw std::runtime_error(error); }
        model.reset(mj_compile(spec.get(), nullptr));
        if (!model) { throw std::runtime_error(mjs_getError(spec.get())); }
        data.reset(mj_makeData(model.get()));
        mj_forward(model.get(), data.get());
    }

    const MujocoModel* core_model() const { return reinterpret_cast<const MujocoModel*>(model.get()); }

    MujocoSimulation arrays() const {
        const auto numbers = [](mjtNum* first, auto count) { return Result(first, static_cast<size_t>(count)); };
        const auto rows = [this](const mjtNum* first, size_t columns) { return Matrix{first, static_cast<size_t>(model->nbody), columns}; };
        return {
            .model = core_model(),
            .data = reinterpret_cast<MujocoData*>(data.get()),
            .qpos = numbers(data->qpos, model->nq),
            .qvel = numbers(data->qvel, model->nv),
            .ctrl = numbers(data->ctrl, model->nu),
            .actuator_force = numbers(data->actuator_force, model->nu),
            .qfrc_applied = numbers(data->qfrc_applied, model->nv),
            .actuator_length = numbers(data->actuator_length, model->nu),
            .xfrc_applied = rows(data->xfrc_applied, 6),
            .cfrc_ext = rows(data->cfrc_ext, 6),
            .xpos = rows(data->xpos, 3),
            .xmat = rows(data->xmat, 9),
            .subtree_com = rows(data->subtree_com, 3),
        };
    }

    std::unique_ptr<mjModel, Freed> model;
    std::unique_ptr<mjData, Freed> data;
};

std::shared_ptr<const MujocoApi> mujoco_api(const Simulation& empty) {
    auto api = std::make_shared<MujocoApi>();
    api->step = reinterpret_cast<MujocoApi::Step>(&mj_step);
    api->rne_post_constraint = reinterpret_cast<MujocoApi::Step>(&mj_rnePostConstraint);
    api->make_batch = reinterpret_cast<decltype(api->make_batch)>(&mjb_makeBatch);
    api->delete_batch = reinterpret_cast<decltype(api->delete_batch)>(&mjb_deleteBatch);
    api->apply = reinterpret_cast<decltype(api->apply)>(&mjb_apply);
    api->error = reinterpret_cast<decltype(api->error)>(&mjb_error);
    api->empty_model = empty.core_model();
    api->contacts = {
        .count = offsetof(mjData, ncon),
        .array = offsetof(mjData, contact),
        .stride = sizeof(mjContact),
        .geoms = offsetof(mjContact, geom),
        .exclude = offsetof(mjContact, exclude),
    };
    api->repairs = {
        .first = offsetof(mjData, warning) + mjWARN_BADQPOS * sizeof(mjWarningStat) + offsetof(mjWarningStat, number),
        .stride = sizeof(mjWarningStat),
    };
    return api;
}

constexpr std::array<std::array<double, n>, 3> configurations{{{0.0, 0.0}, {0.7, -1.1}, {-2.0, 2.5}}};

void the_tip_is_where_mujoco_has_it() {
    const Simulation mujoco(arm_xml);
    Dynamics arm(make_arm());
    for (const auto& q : configurations) {
        copy(q, mujoco.arrays().qpos);
        mj_forward(mujoco.model.get(), mujoco.data.get());
        arm.locate(q);
        const Vec3 tip = arm.tip().translation;
        const double* site = mujoco.data->site_xpos;
        checks::near(norm(tip - Vec3{site[0], site[1], site[2]}), 0.0, 1e-12, "distance of the tips");
        std::vector<mjtNum> position(3 * n);
        mj_jacSite(mujoco.model.get(), mujoco.data.get(), position.data(), nullptr, 0);
        const Matrix J = arm.tip_jacobian();
        for (size_t k = 0; k < 3 * n; ++k) { checks::near(J.numbers()[k], position[k], 1e-12, "Jacobian"); }
    }
}

void the_inverse_dynamics_move_mujocos_arm_as_asked() {
    Dynamics arm(make_arm());
    const std::array<double, n> v{0.4, -0.9};
    const std::array<double, n> a{3.0, -5.0};
    for (const auto& q : configurations) {
        const Simulation mujoco(arm_xml);
        copy(q, mujoco.arrays().qpos);
        copy(v, mujoco.arrays().qvel);
        arm.inverse_dynamics(q, v, a, mujoco.arrays().ctrl);
        mj_step(mujoco.model.get(), mujoco.data.get());
        for (size_t i = 0; i < n; ++i) { checks::near(mujoco.data->qvel[i], v[i] + dt * a[i], 1e-12, "velocity after a step"); }
    }
}

void wrong_gains_are_one_sentence() {
    checks::throws<InputError>([] { PD({.stiffness = {1.0, 2.0}, .damping = {1.0}}); }, "damping: need an array of shape (2,), got (1,)");
    checks::throws<InputError>([] { ComputedTorque(make_arm(), {.added_damping = {0.0}, .torque_limit = {1.0, 1.0}}); }, "added_damping: ");
    checks::throws<InputError>([] { ArmModel({}); }, "chain_length: ");
}

ComputedTorqueGains computed_torque_gains() {
    constexpr double bandwidth = 20.0;  // rad/s
    return {
        .stiffness = bandwidth * bandwidth,
        .damping = 2.0 * bandwidth,
        .added_damping = Numbers(n),
        .decay_rate = bandwidth,
        .torque_limit = Numbers(n, 100.0),
        .estimate = {.dt = dt},
    };
}

void a_clone_begins_a_run_of_its_own() {
    auto gains = computed_torque_gains();
    gains.estimate = {.position_weight = 0.5, .velocity_weight = 0.2, .dt = dt};
    ComputedTorque law(make_arm(), gains);
    const Numbers q{0.1, 0.2};
    const Numbers rest(n);
    Numbers first(n);
    Numbers later(n);
    const Setpoint setpoint{.q = rest, .v = rest, .a = rest, .v_tick = rest, .a_tick = rest};
    law.torque({.q = q, .v = rest, .wrench = {}}, setpoint, first);
    const Numbers moved{0.15, 0.1};
    law.torque({.q = moved, .v = rest, .wrench = {}}, setpoint, later);
    const std::unique_ptr<Law> clone = law.clone();
    checks::that(std::ranges::all_of(clone->memory(), [](double number) { return number == 0.0; }), "a clone has an empty memory");
    Numbers again(n);
    clone->torque({.q = q, .v = rest, .wrench = {}}, setpoint, again);
    checks::that(again == first, "a clone gives the torque of a first tick");
    checks::that(later != first, "the tick after it depends on the memory");
}

ComputedTorqueQPGains limits() {
    return {
        .stiffness = 400.0,
        .damping = 40.0,
        .added_damping = Numbers(n),
        .decay_rate = 20.0,
        .torque_limit = Numbers(n, 20.0),
        .q_min = Numbers(n, -1.0),
        .q_max = Numbers(n, 1.0),
        .v_max = Numbers(n, 1.0),
        .a_max = Numbers(n, 20.0),
        .length = 0.8,
        .dt = dt,
    };
}

// At states far from the reference, so that the limits act.
void a_torque_allocates_nothing_and_keeps_its_limits() {
    const EstimateGains estimate{.position_weight = 0.5, .velocity_weight = 0.2, .dt = dt};
    std::vector<std::unique_ptr<Law>> laws;
    laws.push_back(
        std::make_unique<ComputedTorqueObserver>(make_arm(), ComputedTorqueObserverGains{400.0, 40.0, 0.1, Numbers(n, 20.0), estimate}));
    laws.push_back(std::make_unique<Impedance>(make_arm(), ImpedanceGains{Numbers(6, 100.0), Numbers(6, 1.0), Numbers(n, 1.0), 1.0}));
    laws.push_back(std::make_unique<ComputedTorqueQP>(make_arm(), limits()));
    laws.push_back(std::make_unique<MPC>(make_arm(), MPCGains{limits(), {2, 4, 8}, Numbers(n, 1e30)}));
    const Numbers rest(n);
    Numbers tau(n);
    for (const std::unique_ptr<Law>& law : laws) {
        for (const auto& q : configurations) {
            const Setpoint setpoint{.q = rest, .v = rest, .a = rest, .v_tick = rest, .a_tick = rest};
            const size_t before = allocations;
            law->torque({.q = q, .v = rest, .wrench = {}}, setpoint, tau);
            checks::that(allocations == before, "a torque allocates nothing");
            checks::that(std::isfinite(tau[0]) && std::isfinite(tau[1]), "a torque is finite");
        }
    }
    for (const double torque : tau) { checks::that(std::abs(torque) <= 20.0, "a torque is within its limit"); }
}

// The arrays of a trajectory that stays at a place, and the records of a loop.
struct Recording {
    explicit Recording(size_t count, const std::array<double, n>& place)
        : q(count, n), rest(count, n), qpos(q), v(q), command(q), torque(q) {
        for (size_t row = 0; row < count; ++row) { copy(place, q.row(row)); }
    }

    Ticks ticks(size_t last) {
        return {
            .first = 0,
            .last = last,
            .q = q,
            .v = rest,
            .a = rest,
            .v_tick = rest,
            .a_tick = rest,
            .qpos_rows = qpos,
            .v_rows = v,
            .command_rows = command,
            .torque_rows = torque,
        };
    }

    Mat q, rest, qpos, v, command, torque;
};

TickLoopOptions loop_options() {
    return {
        .motors = {{.qpos = 0, .dof = 0, .ctrl = 0, .force = 0}, {.qpos = 1, .dof = 1, .ctrl = 1, .force = 1}},
        .dt = dt,
        .diverged_speed = 1e3,
    };
}

// With both poles at the bandwidth w an error decays as (1 + w t) exp(-w t).
void a_loop_follows_the_formula_of_its_law() {
    constexpr size_t count = 400;
    const Simulation empty("<mujoco/>");
    const Simulation mujoco(arm_xml);
    TickLoop loop(mujoco_api(empty), mujoco.arrays(), make_arm(), loop_options());
    ComputedTorque law(make_arm(), computed_torque_gains());
    Recording recording(count, {0.3, -0.2});
    const Ticks ticks = recording.ticks(count);
    loop.check(ticks, law, {});
    const TickEnd end = loop.run(ticks, law, {}, "");
    checks::that(end.status == TickStatus::complete && end.count == count && end.error.empty(), "the loop is complete");
    for (size_t row = 0; row < count; ++row) {
        const double wt = 20.0 * dt * static_cast<double>(row);
        const double left = (1.0 + wt) * std::exp(-wt);
        checks::near(recording.qpos(row, 0), 0.3 * (1.0 - left), 0.01, "position of the first joint");
        checks::near(recording.qpos(row, 1), -0.2 * (1.0 - left), 0.01, "position of the second joint");
    }
    checks::near(recording.qpos(count - 1, 0), 0.3, 1e-4, "place of the first joint");
    checks::that(std::ranges::equal(recording.command.numbers(), recording.torque.numbers()), "the motors give what is commanded");
}

void a_delay_gives_the_motors_what_was_commanded_before() {
    constexpr size_t count = 50;
    const Simulation empty("<mujoco/>");
    const Simulation mujoco(arm_xml);
    TickLoop loop(mujoco_api(empty), mujoco.arrays(), make_arm(), loop_options());
    PDGravity law(make_arm(), {.stiffness = {50.0, 20.0}, .damping = {5.0, 2.0}});
    Delay delay(n, 3);
    delay.restart(3);
    Recording recording(count, {0.1, 0.1});
    const TickEnd end = loop.run(recording.ticks(count), law, {.delay = &delay}, "");
    checks::that(end.count == count, "the loop is complete");
    for (size_t row = 3; row < count; ++row) {
        checks::that(std::ranges::equal(recording.torque.row(row), recording.command.row(row - 3)), "three ticks later");
    }
}

void a_loop_ends_where_something_is_wrong() {
    const Simulation empty("<mujoco/>");
    const Simulation mujoco(arm_xml);
    TickLoop loop(mujoco_api(empty), mujoco.arrays(), make_arm(), loop_options());
    PD law({.stiffness = {50.0, std::numeric_limits<double>::quiet_NaN()}, .damping = {5.0, 2.0}});
    Recording recording(5, {0.1, 0.1});
    const TickEnd end = loop.run(recording.ticks(5), law, {}, "");
    checks::that(end.status == TickStatus::not_finite && end.row == 0 && end.count == 0, "a torque that is NaN ends the loop");
    mujoco.data->qvel[1] = 2e3;
    const TickEnd fast = loop.run(recording.ticks(5), law, {}, "");
    checks::that(fast.status == TickStatus::diverged, "a joint that is too fast ends the loop");
    checks::throws<InputError>([&] { loop.check(recording.ticks(6), law, {}); }, "first, last: ");
    checks::throws<InputError>([&] { loop.check(recording.ticks(5), PD({.stiffness = {1.0}, .damping = {1.0}}), {}); }, "law: ");
}

void a_cloud_finds_the_nearest_of_its_points() {
    constexpr size_t count = 3000;
    std::vector<double> numbers;
    std::uint32_t state = 7;
    const auto draw = [&]() { return static_cast<double>((state = state * 1664525U + 1013904223U) >> 8) / (1 << 24); };
    for (size_t i = 0; i < 3 * count; ++i) { numbers.push_back(i < 300 ? 0.25 : draw()); }  // many are the same point
    const PointCloud cloud({numbers.data(), count, 3}, 0.01);
    checks::that(cloud.points().size() == count && cloud.radius() == 0.01, "a cloud has all its points");
    for (int i = 0; i < 100; ++i) {
        const Vec3 place = {2.0 * draw() - 0.5, draw(), draw()};
        double least = 1e9;
        for (const Vec3 point : cloud.points()) { least = std::min(least, norm(point - place)); }
        checks::near(cloud.distance(place), least, 1e-15, "the distance is that of the nearest point");
    }
    checks::throws<InputError>([] { PointCloud({nullptr, 0, 3}, 0.0); }, "points: the cloud is empty");
}

}  // namespace

int main() {
    the_tip_is_where_mujoco_has_it();
    the_inverse_dynamics_move_mujocos_arm_as_asked();
    wrong_gains_are_one_sentence();
    a_clone_begins_a_run_of_its_own();
    a_torque_allocates_nothing_and_keeps_its_limits();
    a_loop_follows_the_formula_of_its_law();
    a_delay_gives_the_motors_what_was_commanded_before();
    a_loop_ends_where_something_is_wrong();
    a_cloud_finds_the_nearest_of_its_points();
    std::printf("%d failures\n", checks::failures);
    return checks::failures == 0 ? 0 : 1;
}
