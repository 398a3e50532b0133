// Admittance control: the reference of the tip yields to measured forces like a mass on a spring and a damper.
#pragma once
#include "task_space.hpp"

namespace armctl {

struct AdmittanceGains {
    Numbers mass;            // (6,) kg and kg m^2
    Numbers damping;         // (6,) N s/m and N m s/rad
    Numbers stiffness;       // (6,) N/m and N m/rad
    double bandwidth = 0.0;  // rad/s, of the position loop
    double dt = 0.0;         // s, the control period
};

// mass x_c'' + damping x_c' + stiffness x_c = wrench,    tip reference = reference + x_c
//
// Sources: Hogan, "Impedance control" (1985); Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control
// (2009), 9.3.2. Arms of less than six joints yield in position only.
class Admittance final : public Cloneable<Admittance> {
public:
    Admittance(const Model& model, AdmittanceGains gains)
        : Cloneable(model->n(), size_t{3} * 6, true), gains_(std::move(gains)), task_(model, task_rows(model->n())) {
        require_size(gains_.mass, 6, "mass");
        require_size(gains_.damping, 6, "damping");
        require_size(gains_.stiffness, 6, "stiffness");
    }

    void torque(const State& state, const Setpoint& setpoint, Result tau) noexcept override {
        const Vector v_ref = setpoint.v_tick;
        yield(state.wrench);
        task_.measure(state.q, setpoint.q);
        const double posture_bandwidth = 0.5 * gains_.bandwidth;
        for (size_t i = 0; i < tau.size(); ++i) {
            posture_[i] = posture_bandwidth * posture_bandwidth * (setpoint.q[i] - state.q[i]);
            posture_[i] += 2.0 * posture_bandwidth * (v_ref[i] - state.v[i]);
        }
        copy(v_ref, v_offset_);
        copy(rate().first(motion_.size()), motion_);
        task_.add_joint_motion(motion_, v_offset_);
        for (size_t k = 0; k < motion_.size(); ++k) {
            // The acceleration of the offset is not fed forward: with a delay, a mass below the real one would bounce.
            const double error = task_.error[k] + offset()[k];
            motion_[k] =
                gains_.bandwidth * gains_.bandwidth * error + 2.0 * gains_.bandwidth * task_.error_rate(k, v_ref, state.v, rate()[k]);
        }
        task_.torque(state, setpoint.a_tick, motion_, posture_, v_offset_, v_offset_, tau);
        tau -= transposed(task_.J.top(motion_.size())) * filtered_wrench();
    }

    // x_c, the displacement of the reference, (6,) m and rad.
    Result offset() { return memory(0, 6); }

private:
    // rad/s. The measured wrench is compensated, so the position loop need not be stiff. Faster, it resonates with a stiff wall.
    static constexpr double wrench_filter = 20.0;

    Result rate() { return memory(6, 6); }              // of the offset
    Result filtered_wrench() { return memory(12, 6); }  // N and N m

    // Moves the offset by one control period, by an implicit Euler step, which is stable for any gains; filters the wrench.
    void yield(Vector wrench) {
        for (size_t k = 0; k < 6; ++k) {
            double& rate = this->rate()[k];
            double& offset = this->offset()[k];
            double& filtered = filtered_wrench()[k];
            const double force = wrench[k] - gains_.damping[k] * rate - gains_.stiffness[k] * (offset + gains_.dt * rate);
            rate += gains_.dt * force / (gains_.mass[k] + gains_.dt * gains_.damping[k] + gains_.dt * gains_.dt * gains_.stiffness[k]);
            offset += gains_.dt * rate;
            filtered += low_pass_weight(wrench_filter, gains_.dt) * (wrench[k] - filtered);
        }
    }

    AdmittanceGains gains_;
    TaskSpace task_;
    Numbers motion_ = Numbers(task_.factors.rows());  // of the tip
    Numbers posture_ = zeros();                       // acceleration
    Numbers v_offset_ = zeros();                      // velocity of the reference with the offset
};

}  // namespace armctl
