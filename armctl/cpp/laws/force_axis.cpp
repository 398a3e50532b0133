#include "force_axis.hpp"

#include <algorithm>
#include <cmath>

#include "../law.hpp"

namespace armctl {

namespace {

constexpr double force_filter = 300.0;  // rad/s; about 3 ms against the noise of force sensors
constexpr double approach_rate = 40.0;  // 1/s, the bandwidth of the speed in an approach; stable with a delay of 4 ms
constexpr double damping_rate = 30.0;   // 1/s, the damping of the tip in contact divided by its mass
constexpr double integral_rate = 20.0;  // 1/s. Below the damping rate, the integral of a lightly damped wall is stable.
// 1/s. Into a damped wall the tip moves steadily, and its damping and that of the joints would hold back a part of the force: 2 N
// of 20 N for a light arm that sinks 10 mm. So a speed that lasts, and that reduces the error, is damped less and less.
constexpr double steady_speed_rate = 12.0;
// Of the target, a bound for what the damping is relieved of. On a soft wall the force rises slowly; it prevents windup.
constexpr double max_relieved_ratio = 0.4;
constexpr double relief_rate = 30.0;           // 1/s, of the depth, a bound for the steady speed
constexpr double max_integrated_error = 0.08;  // of the target
// 1/s. On an elastic wall, the error of the force of a damped tip decays at stiffness / (damping_rate mass): 3 /s for an arm of
// 10 kg at 1e3 N/m. The tip gets as much more speed as makes it decay at this rate on a wall of the estimated stiffness.
constexpr double force_rate = 20.0;
constexpr double max_sinking_speed = 0.25;  // m/s
constexpr double first_ratio = 0.25;  // of the contact threshold: the force, and its rise, from which the stiffness is estimated
constexpr double rise_time = 0.02;  // s, time constant of the commanded force after the first contact
// Friction is compensated at this share of the speed that a frictionless mass would have. With all of it, the force loop that
// is closed over the friction is unstable on walls ten times stiffer than MuJoCo's default with a delay of 4 ms.
constexpr double yielding_ratio = 0.1;
// While there is less force than the contact threshold, the command is this multiple of the measured force. Above 1 it makes
// the force grow on any wall that the slow tip touches; without contact it is zero.
constexpr double detection_gain = 2.0;
constexpr double lost_ratio = 0.2;      // of the contact threshold; below it for max_lost_time the contact is lost
constexpr double max_lost_time = 0.01;  // s

// Follows the tip in the wall from the first force on.
void update_wall(const AxisTick& tick, double sign, double pressing, AxisMemory& axis) {
    const double first = first_ratio * tick.threshold;
    const double speed = sign * tick.speed;
    if (pressing < first || tick.target == 0.0) {
        axis.first_force = 0.0;
        axis.depth = 0.0;
        axis.fluidity = 0.0;
        return;
    }
    if (axis.first_force == 0.0) {
        axis.first_force = pressing;
    }
    axis.depth += tick.dt * speed;
    axis.fluidity = std::max(axis.fluidity, speed / pressing);
}

// The speed beyond that of a damped tip with which an error of the force decays at `force_rate`. The wall's stiffness is that of
// the way since the first force. A wall's own damping makes it seem stiffer, and is added besides: both keep the speed low.
double sinking_speed(const AxisTick& tick, double error, double pressing, const AxisMemory& axis) {
    const double rise = pressing - axis.first_force;
    if (axis.first_force == 0.0 || axis.depth <= 0.0 || axis.fluidity == 0.0 || rise < first_ratio * tick.threshold) {
        return 0.0;
    }
    const double resistance = 1.0 / axis.fluidity + rise / axis.depth / force_rate;
    const double speed = (1.0 / resistance - 1.0 / (damping_rate * tick.mass)) * error;
    return speed * error > 0.0 ? clipped(speed, max_sinking_speed) : 0.0;
}

// Notes the first contact, and its loss.
void update_contact(const AxisTick& tick, double pressing, AxisMemory& axis) {
    if (tick.target == 0.0) {
        axis.touches = 1.0;
    } else if (axis.touches == 0.0) {
        if (pressing > tick.threshold) {
            axis.touches = 1.0;
            axis.commanded = axis.measured;
            axis.integral = 0.0;
            axis.steady_speed = 0.0;
            axis.lost_time = 0.0;
        }
    } else {
        axis.lost_time = pressing < lost_ratio * tick.threshold ? axis.lost_time + tick.dt : 0.0;
        if (axis.lost_time > max_lost_time) {
            axis.touches = 0.0;
            axis.integral = 0.0;
        }
    }
}

AxisCommand approach(const AxisTick& tick, double sign, double pressing, AxisMemory& axis) {
    const double sinking = sinking_speed(tick, tick.target - axis.measured, pressing, axis);
    const double speed = sign * std::max(tick.approach_speed, sign * sinking);
    const double error = speed - tick.speed;
    axis.integral += tick.dt * error;
    return {
        .force = detection_gain * sign * std::max(pressing, 0.0),
        // Both poles at half the rate.
        .acceleration = approach_rate * (error + 0.25 * approach_rate * axis.integral),
        .speed = speed,
    };
}

AxisCommand press(const AxisTick& tick, double pressing, AxisMemory& axis) {
    axis.commanded += low_pass_weight(1.0 / rise_time, tick.dt) * (tick.target - axis.commanded);
    const double error = axis.commanded - axis.measured;
    const double damping = damping_rate * tick.mass;
    const double bound = max_integrated_error * std::abs(tick.target);
    const double sinking = sinking_speed(tick, error, pressing, axis);
    const double faster = tick.speed - sinking;
    const double reducing = error * faster > 0.0 ? faster : 0.0;
    axis.steady_speed += low_pass_weight(steady_speed_rate, tick.dt) * (reducing - axis.steady_speed);
    // Up to a part of the target, so that a tip that slides or yields stays slow; and hardly on a stiff wall, where it would chatter.
    const double most = std::min(max_relieved_ratio * std::abs(tick.target) / damping, relief_rate * std::max(axis.depth, 0.0));
    axis.steady_speed = clipped(axis.steady_speed, most);
    const double damped_speed = faster - axis.steady_speed;
    // The damping explains a part of the error. If that were integrated, the force would overshoot.
    axis.integral += integral_rate * tick.dt * clipped(error - damping * damped_speed, bound);
    const double free_speed = error / damping;  // of a mass without friction under this error of the force
    axis.yielding += low_pass_weight(damping_rate, tick.dt) * (yielding_ratio * free_speed - axis.yielding);
    return {
        .force = axis.commanded + axis.integral,
        .acceleration = -damping_rate * damped_speed,
        .speed = axis.steady_speed + sinking,
        .yielding_speed = axis.yielding,
    };
}

}  // namespace

AxisCommand command_axis(const AxisTick& tick, AxisMemory axis) {
    axis.measured += low_pass_weight(force_filter, tick.dt) * (tick.measured - axis.measured);
    const double sign = std::copysign(1.0, tick.target);
    const double pressing = sign * axis.measured;
    update_wall(tick, sign, pressing, axis);
    update_contact(tick, pressing, axis);
    return axis.touches == 0.0 ? approach(tick, sign, pressing, axis) : press(tick, pressing, axis);
}

double low_pass_weight(double rate, double dt) { return -std::expm1(-rate * dt); }

}  // namespace armctl
