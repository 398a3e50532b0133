// The contact transition of a force axis: approach, contact, and back if the contact is lost.
#pragma once
#include <optional>

#include "../law.hpp"

namespace armctl {

struct AxisCommand {
    double force = 0.0;           // N
    double acceleration = 0.0;    // m/s^2 that damps or approaches
    double speed = 0.0;           // m/s of the approach, or that lasts in contact: joint damping and friction are compensated at it
    double yielding_speed = 0.0;  // m/s in contact at which dry friction is compensated
};

// One axis at one tick.
struct AxisTick {
    double target = 0.0;          // N
    double measured = 0.0;        // N, that the tip exerts
    double speed = 0.0;           // m/s of the tip
    double mass = 0.0;            // kg, effective, of a tip that moves along the axis only
    double approach_speed = 0.0;  // m/s
    double threshold = 0.0;       // N, above which there is contact
    double dt = 0.0;              // s, control period
};

// A force axis with what it keeps from tick to tick, which are numbers of the memory of a law.
struct ForceAxis {
    static constexpr size_t memory_size = 14;

    explicit ForceAxis(Result memory)
        : touches(memory[0]), measured(memory[1]), commanded(memory[2]), integral(memory[3]), lost_time(memory[4]), yielding(memory[5]),
          steady_speed(memory[6]), first_force(memory[7]), depth(memory[8]), depth_depth(memory[9]), depth_speed(memory[10]),
          speed_speed(memory[11]), depth_force(memory[12]), speed_force(memory[13]), of_wall(memory.subspan(7)) {}

    double& touches;       // 1 in contact, else 0
    double& measured;      // N, filtered
    double& commanded;     // N
    double& integral;      // of the error of the force, N, in contact; of that of the speed, m, before
    double& lost_time;     // s, for which there was hardly any force
    double& yielding;      // m/s
    double& steady_speed;  // m/s
    double& first_force;   // N, at which the depth begins; 0 before
    double& depth;         // m, travelled since
    // Sums over the ticks since, of products of depth, speed and rise of the force.
    double& depth_depth;
    double& depth_speed;
    double& speed_speed;
    double& depth_force;
    double& speed_force;
    Result of_wall;  // the numbers from `first_force` on

    AxisCommand command(const AxisTick& tick) {
        measured += low_pass_weight(force_filter, tick.dt) * (tick.measured - measured);
        const double sign = std::copysign(1.0, tick.target);
        const double pressing = sign * measured;
        update_wall(tick, sign, pressing);
        update_contact(tick, pressing);
        return touches == 0.0 ? approach(tick, sign, pressing) : press(tick, pressing);
    }

private:
    // What the way into a wall has shown of it so far.
    struct Wall {
        double stiffness = 0.0;  // N/m
        double damping = 0.0;    // N s/m
    };

    static constexpr double force_filter = 300.0;  // rad/s; about 3 ms against the noise of force sensors
    static constexpr double approach_rate = 40.0;  // 1/s, the bandwidth of the speed in an approach; stable with a delay of 4 ms
    static constexpr double damping_rate = 36.0;   // 1/s, the damping of the tip in contact divided by its mass
    static constexpr double integral_rate = 20.0;  // 1/s. Below the damping rate, the integral of a lightly damped wall is stable.
    // 1/s. While the tip sinks into a damped wall, its damping would hold back a part of the force. So a speed that lasts, and that
    // reduces the error, is damped less and less.
    static constexpr double steady_speed_rate = 16.0;
    static constexpr double min_relieved_ratio = 0.25;    // of the target, what the damping is relieved of at least
    static constexpr double max_relieved_ratio = 0.9;     // and at most, where the wall itself damps the tip critically
    static constexpr double relief_rate = 30.0;           // 1/s, of the depth, a bound for the steady speed
    static constexpr double max_integrated_error = 0.08;  // of the target
    // 1/s. On foam, the error of the force of a damped tip decays at stiffness / (damping_rate mass), 3 /s for 10 kg at 1e3 N/m.
    // With more speed, it decays at this rate on a wall of the estimated stiffness.
    static constexpr double force_rate = 22.0;
    static constexpr double min_stiffness = 1000.0;    // N/m; a tip that falls into a hole takes it for a soft wall
    static constexpr double max_sinking_speed = 0.25;  // m/s
    static constexpr double first_ratio = 0.25;        // of the contact threshold, the force from which the stiffness is estimated
    // Of depth and speed, squared sine between their changes over time, from which stiffness and damping can be told apart.
    static constexpr double min_independence = 1e-3;
    static constexpr double rise_time = 0.02;  // s, time constant of the commanded force after the first contact
    // Friction is compensated at this share of the speed that a frictionless mass would have. With all of it, the force loop that
    // is closed over the friction is unstable on walls ten times stiffer than MuJoCo's default with a delay of 4 ms.
    static constexpr double yielding_ratio = 0.1;
    // While there is less force than the contact threshold, the command is this multiple of the measured force. Above 1 it makes
    // the force grow on any wall that the slow tip touches; without contact it is zero.
    static constexpr double detection_gain = 4.0;
    static constexpr double lost_ratio = 0.2;      // of the contact threshold; below it for max_lost_time the contact is lost
    static constexpr double max_lost_time = 0.01;  // s

    // Follows the tip in the wall from the first force on.
    void update_wall(const AxisTick& tick, double sign, double pressing) {
        if (pressing < first_ratio * tick.threshold || tick.target == 0.0) {
            std::ranges::fill(of_wall, 0.0);
            return;
        }
        const double speed = sign * tick.speed;
        if (first_force == 0.0) { first_force = pressing; }
        depth += tick.dt * speed;
        const double rise = pressing - first_force;
        depth_depth += depth * depth;
        depth_speed += depth * speed;
        speed_speed += speed * speed;
        depth_force += depth * rise;
        speed_force += speed * rise;
    }

    // Stiffness, N/m, and damping, N s/m, of the wall by least squares over the way so far: rise = stiffness depth + damping speed.
    std::optional<Wall> wall() const {
        const double determinant = depth_depth * speed_speed - depth_speed * depth_speed;
        if (!(determinant > min_independence * depth_depth * speed_speed)) { return std::nullopt; }
        Wall found{
            .stiffness = (depth_force * speed_speed - speed_force * depth_speed) / determinant,
            .damping = (speed_force * depth_depth - depth_force * depth_speed) / determinant,
        };
        if (found.damping < 0.0) { found = {.stiffness = depth_force / depth_depth}; }
        found.stiffness = std::max(found.stiffness, min_stiffness);
        return found;
    }

    // The speed beyond that of a damped tip with which an error of the force decays at `force_rate` on the wall.
    double sinking_speed(const AxisTick& tick, const std::optional<Wall>& wall, double error, double pressing) const {
        if (!wall || pressing - first_force < first_ratio * tick.threshold) { return 0.0; }
        const double resistance = wall->damping + wall->stiffness / force_rate;
        const double speed = (1.0 / resistance - 1.0 / (damping_rate * tick.mass)) * error;
        return speed * error > 0.0 ? clipped(speed, max_sinking_speed) : 0.0;
    }

    // Of the target, what the damping is relieved of: the more, the more the wall damps the mass of the tip instead.
    static double relieved_ratio(const std::optional<Wall>& wall, double mass) {
        if (!wall) { return min_relieved_ratio; }
        const double damping_ratio = 0.5 * wall->damping / std::sqrt(wall->stiffness * mass);
        return min_relieved_ratio + (max_relieved_ratio - min_relieved_ratio) * std::clamp(2.0 * damping_ratio - 1.0, 0.0, 1.0);
    }

    // Notes the first contact, and its loss.
    void update_contact(const AxisTick& tick, double pressing) {
        if (tick.target == 0.0) {
            touches = 1.0;
        } else if (touches == 0.0) {
            if (pressing > tick.threshold) {
                touches = 1.0;
                commanded = measured;
                integral = 0.0;
                steady_speed = 0.0;
                lost_time = 0.0;
            }
        } else {
            lost_time = pressing < lost_ratio * tick.threshold ? lost_time + tick.dt : 0.0;
            if (lost_time > max_lost_time) {
                touches = 0.0;
                integral = 0.0;
            }
        }
    }

    AxisCommand approach(const AxisTick& tick, double sign, double pressing) {
        const double speed = sign * tick.approach_speed;
        const double error = speed - tick.speed;
        integral += tick.dt * error;
        return {
            .force = detection_gain * sign * std::max(pressing, 0.0),
            // Both poles at half the rate.
            .acceleration = approach_rate * (error + 0.25 * approach_rate * integral),
            .speed = speed,
        };
    }

    AxisCommand press(const AxisTick& tick, double pressing) {
        commanded += low_pass_weight(1.0 / rise_time, tick.dt) * (tick.target - commanded);
        const double error = commanded - measured;
        const double damping = damping_rate * tick.mass;
        const double bound = max_integrated_error * std::abs(tick.target);
        const std::optional<Wall> wall = this->wall();
        const double sinking = sinking_speed(tick, wall, error, pressing);
        const double faster = tick.speed - sinking;
        const double reducing = error * faster > 0.0 ? faster : 0.0;
        steady_speed += low_pass_weight(steady_speed_rate, tick.dt) * (reducing - steady_speed);
        // A tip that slides or yields stays slow, and one on a stiff wall does not chatter.
        const double most = std::min(relieved_ratio(wall, tick.mass) * std::abs(tick.target) / damping, relief_rate * std::max(depth, 0.0));
        steady_speed = clipped(steady_speed, most);
        const double damped_speed = faster - steady_speed;
        // The damping explains a part of the error. If that were integrated, the force would overshoot.
        integral += integral_rate * tick.dt * clipped(error - damping * damped_speed, bound);
        const double free_speed = error / damping;  // of a mass without friction under this error of the force
        yielding += low_pass_weight(damping_rate, tick.dt) * (yielding_ratio * free_speed - yielding);
        return {
            .force = commanded + integral,
            .acceleration = -damping_rate * damped_speed,
            .speed = steady_speed + sinking,
            .yielding_speed = yielding,
        };
    }
};

}  // namespace armctl
