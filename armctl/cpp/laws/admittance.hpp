// Admittance control: the reference of the tip yields to measured forces like a mass on a spring and a damper.
#pragma once
#include "../law.hpp"
#include "task_space.hpp"

namespace armctl {

// mass x_c'' + damping x_c' + stiffness x_c = wrench,    tip reference = reference + x_c
//
// Sources: Hogan, "Impedance control" (1985); Siciliano, Sciavicco, Villani, Oriolo, Robotics: Modelling, Planning and Control
// (2009), 9.3.2. Arms of less than six joints yield in position only.
class Admittance final : public Law {
public:
    struct Gains {
        std::vector<double> mass;       // (6,) kg and kg m^2
        std::vector<double> damping;    // (6,) N s/m and N m s/rad
        std::vector<double> stiffness;  // (6,) N/m and N m/rad
        double bandwidth = 0.0;         // rad/s, of the position loop
    };

    Admittance(std::shared_ptr<const ArmModel> model, Gains gains, double dt);

    size_t joints() const override { return dynamics_.model().n(); }
    bool needs_wrench() const override { return true; }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::span<double> memory() override { return memory_; }
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // x_c, the displacement of the reference, (6,) m and rad.
    Result offset() { return std::span(memory_).subspan(0, 6); }

private:
    Result rate() { return std::span(memory_).subspan(6, 6); }              // of the offset
    Result filtered_wrench() { return std::span(memory_).subspan(12, 6); }  // N and N m
    void yield(Vector wrench);

    Gains gains_;
    double dt_;
    Dynamics dynamics_;
    TaskSpace task_;

    std::vector<double> memory_;  // the three vectors above

    // Scratch memory.
    DenseMatrix mobility_;              // (rows, rows) factors
    std::vector<double> motion_;        // (rows,) of the tip
    std::vector<double> acceleration_;  // (n,)
    std::vector<double> v_friction_;    // (n,)
    std::vector<double> error_rate_;    // (n,)
};

}  // namespace armctl
