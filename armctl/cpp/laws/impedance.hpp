// Cartesian impedance: the tip yields to forces like a spring and a damper around its reference.
#pragma once
#include "../law.hpp"
#include "task_space.hpp"

namespace armctl {

// tau = ID(q, v, a_ref) + J^T K e + D (v_ref - v) + posture
//
// Sources: Hogan, "Impedance control" (1985). D follows from stiffness and mass matrix by simultaneous diagonalization, so
// every mode has the same damping ratio: Albu-Schaeffer, Ott, Hirzinger, "A unified passivity-based control framework for
// position, torque and impedance control of flexible joint robots" (2007). The posture spring acts in the null space.
class Impedance final : public Law {
public:
    struct Gains {
        std::vector<double> stiffness;          // (6,) N/m and N m/rad, of the tip
        std::vector<double> max_error;          // (6,) m and rad, to which the spring stretches
        std::vector<double> posture_stiffness;  // (n,) N m/rad
        double damping_ratio = 0.0;
    };

    Impedance(std::shared_ptr<const ArmModel> model, Gains gains);

    size_t joints() const override { return dynamics_.model().n(); }
    void torque(const State& state, const Setpoint& setpoint, Result tau) override;
    std::unique_ptr<Law> clone() const override { return fresh_copy(*this); }

    // Replaces the stiffness of the tip, (6,) N/m and N m/rad.
    void set_stiffness(std::vector<double> stiffness);

private:
    void find_posture_stiffness();
    void add_critical_damping();

    Gains gains_;
    Dynamics dynamics_;
    TaskSpace task_;

    // Scratch memory.
    DenseMatrix mobility_;           // (6, 6) factors
    DenseMatrix inverse_;            // (n, 6) the dynamically consistent inverse
    DenseMatrix null_space_;         // (n, n) projection
    DenseMatrix posture_stiffness_;  // (n, n)
    DenseMatrix stiffness_;          // (n, n) as seen by the joints
    DenseMatrix scaled_stiffness_;   // (n, n)
    DenseMatrix modes_;              // (n, n)
    std::vector<double> error_rate_;
    std::vector<double> scaled_rate_;
    std::vector<double> feedback_;
};

}  // namespace armctl
