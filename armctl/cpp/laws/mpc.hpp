// Model predictive control: computed torque whose acceleration is planned over a horizon, within the limits of the arm.
#pragma once
#include "computed_torque_qp.hpp"

namespace armctl {

struct MPCGains {
    ComputedTorqueQPGains limits;
    std::vector<size_t> blocks;  // (k,) the ticks of each block, at least 2
    Numbers torque_rate;         // (n,) N m/s
};

// a = a_ref + stiffness e + damping e_dot + c, where c is linear in each block of the horizon: if it were constant, the feedback
// would move the torque of a long block out of its limits.
//
// Computed torque makes every joint a double integrator, so errors depend linearly on c, with coefficients that do not change. c = 0
// is computed torque. The plan minimizes the squares of c and of the errors of the tip that c adds, times the stiffness, subject to
//
//     -tau_max <= M a + h <= tau_max,    -v_max <= v <= v_max,    q_min <= q <= q_max
//
// the torques at the first tick of each block, the others at its last one; and the change of the torques from block to block, which is
// at most the torque rate times the time between. The torques are linearized along the plan of the last tick, shifted by one tick, which
// is one step of sequential quadratic programming per tick (the real-time iteration of Diehl, Bock, Schloeder, "A real-time iteration
// scheme for nonlinear optimization in optimal feedback control", SIAM J. Control Optim. 43, 2005): c = 0 is no motion to linearize
// along where errors are large. Where limits contradict each other, those of velocity and position that c = 0 exceeds become costs.
// Without a solution the last plan goes on. The AccelerationProgram keeps the limits of the tick, and those of position beyond.
class MPC final : public Cloneable<MPC> {
public:
    MPC(const Model& model, MPCGains gains)
        : Cloneable(model->n(), memory_size(model->n(), gains.blocks.size())), program_(model, std::move(gains.limits)), period_(model),
          torque_rate_(std::move(gains.torque_rate)), ticks_(std::move(gains.blocks)),
          rates_(std::ranges::any_of(torque_rate_, [](double rate) { return rate < unbounded; }) ? size() : 0),
          solver_(size(), 3 * size() + rates_) {
        require_size(torque_rate_, joints(), "torque_rate");
        predict(this->gains().continuous ? 0.5 : 1.0);
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const Setpoint nearer = attainable(state, setpoint);
        program_.begin(state, nearer, tau);
        plan(state, nearer, tau);
        program_.limit(state, tau);
        const Result last = memory(counters, joints());
        for (size_t i = 0; i < joints(); ++i) {
            const double change = torque_rate_[i] * gains().dt;
            if (memory()[0] > 0.0) { tau[i] = std::clamp(tau[i], last[i] - change, last[i] + change); }
            tau[i] = clipped(tau[i], gains().torque_limit[i]);  // a plan on a limit exceeds it by rounding
            last[i] = tau[i];
        }
        memory()[0] += 1.0;
    }

    // Counts of ticks: all, those that needed a plan, those without one, and those whose plan exceeds limits.
    Result counts() { return memory(0, counters); }

private:
    static constexpr size_t counters = 4;
    // In the measure of the tip, for the program of the tick as well: joints that cost less go so far astray that no plan leads back.
    static constexpr double joint_weight = 0.1;
    // Relative to the limits of velocity, that the feedback of an error asks for: farther setpoints are moved nearer. With 1, errors of
    // motions that run away decay late; with 4, targets that jump by 2 rad let the arm circle around them.
    static constexpr double farthest_speed = 2.0;
    static constexpr double slope_step = 1e-6;  // rad and rad/s, of the differences that give the derivatives of the torques
    // Limits of velocity and position that are farther away than this share of their range are not part of the program.
    static constexpr double near_limit = 0.15;
    // Of the torque limit, with a plan: the torque that is left at present says little about the place where the joint has to stop.
    // 0.25 gives the same errors; with 0.05 the arm brakes in motions that it can follow.
    static constexpr double planned_brake_share = 0.5;
    static constexpr double position_tolerance = 1e-6;  // rad
    // Of limits that contradict others, relative to the cost of a c that would meet them: what remains of the violation is small.
    static constexpr double violation_weight = 1e4;

    // Errors of a joint at a node, relative to those at the start or to a block's c.
    struct Response {
        double error = 0.0;
        double rate = 0.0;
        double acceleration = 0.0;  // of the feedback, with c
    };

    // The first or the last tick of a block.
    struct Node {
        size_t tick;
        std::vector<Response> of;  // the blocks' c, the error and the rate at the start
    };

    // The setpoint within the range of the joints, and not so far away that no plan is near the motion that the error's feedback asks for.
    Setpoint attainable(const State& state, const Setpoint& setpoint) {
        Setpoint result = setpoint;
        for (size_t i = 0; i < joints(); ++i) {
            const double inside = std::min(std::max(setpoint.q[i], gains().q_min[i]), gains().q_max[i]);
            const double farthest = farthest_speed * gains().damping / gains().stiffness * gains().v_max[i];
            q_target_[i] = std::min(std::max(inside, state.q[i] - farthest), state.q[i] + farthest);
            too_far_[i] = inside - q_target_[i];
            const bool is_inside = inside == setpoint.q[i];
            v_target_[i] = is_inside ? setpoint.v_tick[i] : 0.0;
            a_target_[i] = is_inside ? setpoint.a_tick[i] : 0.0;
        }
        result.q = q_target_;
        result.v_tick = v_target_;
        result.a_tick = a_target_;
        return result;
    }

    const ComputedTorqueQPGains& gains() const { return program_.gains(); }
    Mat square() const { return {joints(), joints()}; }
    static size_t memory_size(size_t n, size_t blocks) { return counters + n + n * blocks; }
    size_t blocks() const { return ticks_.size(); }
    size_t size() const { return blocks() * joints(); }
    Result c() { return memory(counters + joints(), size()); }  // of each block

    // The responses of errors of a joint in closed loop, and the cost of c, which counts errors for as long again after the horizon.
    //
    // The squares of c are the feedback's own cost (Rossiter, Kouvaritakis, Rice, "A numerically robust state-space approach to stable-
    // predictive control strategies", Automatica 34, 1998). Without errors in the cost, the plan gives up the path to save accelerations;
    // with only a tenth of the squares of c, it ends where no torque leads back. A limit of the torque rate allows no errors in the cost:
    // the end of c would ask for a jump of the torque.
    void predict(double position_step) {
        std::vector<Response> now(blocks() + 2);
        now[blocks()].error = 1.0;
        now[blocks() + 1].rate = 1.0;
        size_t tick = 0;
        for (size_t block = 0; block <= blocks(); ++block) {
            const size_t first = tick;
            const size_t end = block < blocks() ? first + ticks_[block] : 2 * first;
            for (; tick < end; ++tick) {
                for (size_t i = 0; i < now.size(); ++i) {
                    now[i].acceleration = gains().stiffness * now[i].error + gains().damping * now[i].rate + weight(i, tick);
                }
                if (block < blocks() && (tick == first || tick + 1 == end)) { nodes_.push_back({.tick = tick, .of = now}); }
                for (size_t i = 0; i < blocks(); ++i) {
                    for (size_t j = 0; j < blocks(); ++j) {
                        if (rates_ == 0) { squares_(i, j) += gains().stiffness * gains().stiffness * now[i].error * now[j].error; }
                        squares_(i, j) += weight(i, tick) * weight(j, tick);
                    }
                }
                for (Response& each : now) {
                    each.error += gains().dt * each.rate - position_step * gains().dt * gains().dt * each.acceleration;
                    each.rate -= gains().dt * each.acceleration;
                }
            }
        }
    }

    // Of a block's c at a tick: c is linear between the starts of the blocks, and constant in the last one.
    double weight(size_t block, size_t tick) const {
        size_t start = 0;
        for (size_t k = 0; k < blocks(); start += ticks_[k], ++k) {
            const double share = (static_cast<double>(tick) - static_cast<double>(start)) / static_cast<double>(ticks_[k]);
            if (share >= 1.0 || share < 0.0) { continue; }
            if (k == block) { return k + 1 < blocks() ? 1.0 - share : 1.0; }
            if (k + 1 == block) { return share; }
        }
        return 0.0;
    }

    void plan(const State& state, const Setpoint& setpoint, Result tau) {
        for (size_t i = 0; i < joints(); ++i) {
            error_[i] = setpoint.q[i] - state.q[i];
            rate_[i] = setpoint.v_tick[i] - state.v[i];
            program_.H(i, i) += joint_weight * joint_weight * gains().length * gains().length;
        }
        if (gains().dt == 0.0) { return; }
        const bool is_outside = this->is_outside(state);
        program_.brake_share = is_outside ? AccelerationProgram::min_brake_share : planned_brake_share;
        if (is_outside) {
            memory()[1] += 1.0;
            memory()[2] += 1.0;
            std::ranges::fill(c(), 0.0);
            return;
        }
        shift();
        bool is_limited = add_nodes(setpoint, tau);
        if (!is_limited && std::ranges::any_of(c(), [](double each) { return each != 0.0; })) {
            std::ranges::fill(c(), 0.0);
            is_limited = add_nodes(setpoint, tau);
        }
        if (!is_limited) { return; }
        memory()[1] += 1.0;
        const QuadraticProgram program = this->program();
        if (!solver_.solve(program, c())) {
            if (solver_.solve_relaxed(program, violation_weights(), c())) {
                memory()[3] += 1.0;
            } else {
                memory()[2] += 1.0;
                program_.brake_share = AccelerationProgram::min_brake_share;
            }
        }
        for (size_t i = 0; i < joints(); ++i) {
            added_[i] = c()[i];
            program_.desired[i] += added_[i];
        }
        for (size_t i = 0; i < joints(); ++i) { tau[i] = dot(program_.M.row(i), added_, tau[i]); }
    }

    // The plan of the last tick, seen from this one.
    void shift() {
        const size_t n = joints();
        for (size_t block = 0; block + 1 < blocks(); ++block) {
            const double share = 1.0 / static_cast<double>(ticks_[block]);
            for (size_t i = 0; i < n; ++i) { c()[block * n + i] += share * (c()[(block + 1) * n + i] - c()[block * n + i]); }
        }
    }

    // Makes the rows of the program: whether c = 0 exceeds a limit.
    bool add_nodes(const Setpoint& setpoint, Vector tau) {
        bool is_limited = false;
        for (size_t k = 0; k < nodes_.size(); ++k) { is_limited = add_node(k, setpoint, tau) || is_limited; }
        return is_limited;
    }

    // Adds the rows of a node to the program: whether c = 0 exceeds a limit there.
    bool add_node(size_t k, const Setpoint& setpoint, Vector tau) {
        const Node& node = nodes_[k];
        const size_t block = k / 2;
        find_motion(node, setpoint);
        if (k % 2 != 0) { return add_motion_rows(node, block); }
        if (block == 0) {
            copy(tau, tau_);
            inertia_ = program_.M;
        } else {
            linearize(node);
        }
        return add_torque_rows(node, block);
    }

    // The motion at a node for c = 0, and its reference.
    void find_motion(const Node& node, const Setpoint& setpoint) {
        const Response& of_error = node.of[blocks()];
        const Response& of_rate = node.of[blocks() + 1];
        for (size_t i = 0; i < joints(); ++i) {
            double q_ref = setpoint.q[i] + too_far_[i] + static_cast<double>(node.tick) * gains().dt * setpoint.v_tick[i];
            double v_ref = setpoint.v_tick[i];
            double a_ref = node.tick == 0 ? setpoint.a_tick[i] : 0.0;
            if (setpoint.q_ahead.rows > 0) {
                const size_t row = std::min(node.tick, setpoint.q_ahead.rows - 1);
                q_ref = setpoint.q_ahead(row, i);
                v_ref = setpoint.v_ahead(row, i);
                a_ref = node.tick == row ? setpoint.a_ahead(row, i) : 0.0;
            }
            q_ref = std::min(std::max(q_ref, gains().q_min[i]), gains().q_max[i]) - too_far_[i];
            v_ref_[i] = v_ref;
            a_ref_[i] = a_ref;
            q_[i] = q_ref - of_error.error * error_[i] - of_rate.error * rate_[i];
            v_[i] = v_ref - of_error.rate * error_[i] - of_rate.rate * rate_[i];
            a_[i] = a_ref + of_error.acceleration * error_[i] + of_rate.acceleration * rate_[i];
        }
    }

    // The torques, their derivatives and the inertia at the motion of the last plan.
    void linearize(const Node& node) {
        for (size_t each = 0; each < blocks(); ++each) {
            for (size_t i = 0; i < joints(); ++i) {
                const double last = c()[each * joints() + i];
                q_[i] -= node.of[each].error * last;
                v_[i] -= node.of[each].rate * last;
                a_[i] += node.of[each].acceleration * last;
            }
        }
        find_torques();
        period_.add_friction(v_ref_, a_ref_, tau_);
        period_.mass_matrix(inertia_);
        period_.add_step_inertia(inertia_);
    }

    // The rows of the torques at the first tick of a block, and of their change since the block before.
    bool add_torque_rows(const Node& node, size_t block) {
        const size_t n = joints();
        const Result last = memory(counters, n);
        bool is_limited = false;
        for (size_t each = 0; each < blocks(); ++each) {  // c changes neither q nor v of the first tick
            const Response& of = node.of[each];
            rows_.set_block(block * 3 * n, each * n, of.acceleration * inertia_ - of.rate * of_v_ - of.error * of_q_);
        }
        for (size_t i = 0; i < n; ++i) {
            const size_t row = block * 3 * n + i;
            if (block > 0) { tau_[i] -= dot(rows_.row(row), c()); }
            double lower = -gains().torque_limit[i];
            double upper = gains().torque_limit[i];
            if (rates_ > 0 && block == 0 && memory()[0] > 0.0) {
                lower = std::max(lower, last[i] - torque_rate_[i] * gains().dt);
                upper = std::min(upper, last[i] + torque_rate_[i] * gains().dt);
            }
            is_limited = set_bounds(row, lower - tau_[i], upper - tau_[i]) || is_limited;
            if (rates_ > 0 && block > 0) {
                const size_t rate = 3 * size() + block * n + i;
                for (size_t column = 0; column < size(); ++column) {
                    rows_(rate, column) = rows_(row, column) - rows_(row - 3 * n, column);
                }
                const double change = torque_rate_[i] * gains().dt * static_cast<double>(ticks_[block - 1]);
                const double planned = tau_[i] - tau_before_[i];
                is_limited = set_bounds(rate, -change - planned, change - planned) || is_limited;
            }
            tau_before_[i] = tau_[i];
        }
        return is_limited;
    }

    // The rows of velocities and positions at the last tick of a block.
    bool add_motion_rows(const Node& node, size_t block) {
        const size_t n = joints();
        bool is_limited = false;
        for (size_t i = 0; i < n; ++i) {
            const size_t row = block * 3 * n + i;
            for (size_t each = 0; each < blocks(); ++each) {
                rows_(row + n, each * n + i) = node.of[each].rate;
                rows_(row + 2 * n, each * n + i) = node.of[each].error;
            }
            is_limited = set_bounds(row + n, v_[i] - gains().v_max[i], v_[i] + gains().v_max[i], near_limit) || is_limited;
            is_limited = set_bounds(row + 2 * n, q_[i] - gains().q_max[i], q_[i] - gains().q_min[i], near_limit) || is_limited;
        }
        return is_limited;
    }

    // The torques without friction, and their derivatives by positions and velocities.
    void find_torques() {
        period_.inverse_dynamics(q_, v_, a_, tau_);
        for (size_t j = 0; j < joints(); ++j) {
            find_slope(j, q_, of_q_);
            find_slope(j, v_, of_v_);
        }
    }

    void find_slope(size_t j, Result x, MatrixResult slopes) {
        const double here = x[j];
        x[j] = here + slope_step;
        period_.inverse_dynamics(q_, v_, a_, tau_of_step_);
        x[j] = here;
        for (size_t i = 0; i < joints(); ++i) { slopes(i, j) = (tau_of_step_[i] - tau_[i]) / slope_step; }
    }

    // Bounds of a row; whether zero is outside. A row that is farther from both than a share of their distance is left out.
    bool set_bounds(size_t row, double lower, double upper, double near_share = 1.0) {
        const double near = near_share * (upper - lower);
        const bool is_near = lower > -near || upper < near;
        lower_[size() + row] = is_near ? std::max(lower, -unbounded) : -unbounded;
        upper_[size() + row] = is_near ? std::min(upper, unbounded) : unbounded;
        return lower > limit_tolerance || upper < -limit_tolerance;
    }

    QuadraticProgram program() {
        const size_t n = joints();
        for (size_t row = 0; row < size(); ++row) {
            for (size_t column = 0; column < size(); ++column) {
                cost_(row, column) = squares_(row / n, column / n) * program_.H(row % n, column % n);
            }
        }
        return {.H = cost_, .f = {}, .M = rows_, .lower = lower_, .upper = upper_};
    }

    // Weights of the bounds of velocity and position, where they exclude zero and have no solution. The cost of a violation is the
    // same at all nodes: what c can hardly change any more decides little.
    Vector violation_weights() {
        double cost = 0.0;
        std::array<double, 3> square{};  // the largest one of the rows of torque, velocity and position
        for (size_t i = 0; i < size(); ++i) { cost = std::max(cost, cost_(i, i)); }
        const auto kind = [n = joints()](size_t row) { return row % (3 * n) / n; };
        for (size_t row = 0; row < 3 * size(); ++row) {
            square[kind(row)] = std::max(square[kind(row)], dot(rows_.row(row), rows_.row(row)));
        }
        for (size_t row = 0; row < 3 * size(); ++row) {
            if (kind(row) != 0) { weights_[size() + row] = violation_weight * cost / square[kind(row)]; }
        }
        return weights_;
    }

    // Whether a joint is outside of its range: no plan keeps it then; the program of the tick brakes and brings it back.
    bool is_outside(const State& state) const {
        for (size_t i = 0; i < joints(); ++i) {
            if (state.q[i] < gains().q_min[i] - position_tolerance || state.q[i] > gains().q_max[i] + position_tolerance) { return true; }
        }
        return false;
    }

    AccelerationProgram program_;
    Dynamics period_;            // of the control period
    Numbers torque_rate_;        // (n,) N m/s
    std::vector<size_t> ticks_;  // of each block
    std::vector<Node> nodes_;
    size_t rates_;  // rows of the torque rate
    ActiveSetSolver solver_;
    Mat squares_{blocks(), blocks()};  // of the weights of two blocks, summed over the horizon
    Mat inertia_ = square(), cost_{size(), size()}, rows_{3 * size() + rates_, size()};
    Numbers q_target_ = zeros(), v_target_ = zeros(), a_target_ = zeros(), too_far_ = zeros();
    Numbers error_ = zeros(), rate_ = zeros(), q_ = zeros(), v_ = zeros(), a_ = zeros(), v_ref_ = zeros(), a_ref_ = zeros(), tau_ = zeros(),
            tau_before_ = zeros(), tau_of_step_ = zeros(), added_ = zeros();
    Mat of_q_ = square(), of_v_ = square();  // slopes of the torque
    Numbers lower_ = Numbers(4 * size() + rates_, -unbounded), upper_ = Numbers(4 * size() + rates_, unbounded);
    Numbers weights_ = Numbers(4 * size() + rates_);
};

}  // namespace armctl
