// Joint torques of forces on the tip.
#pragma once
#include <vector>

#include "dynamics.hpp"
#include "spans.hpp"

namespace armctl {

class TipForce {
public:
    explicit TipForce(std::shared_ptr<const ArmModel> model);

    // The number of joints of the arm.
    size_t joints() const { return dynamics_.model().n(); }

    // J(q)^T wrench, (n,) N m: what a wrench (6,) on the tip does to the joints. Force first, world axes.
    void torque(Vector q, Vector wrench, Result tau);

private:
    Dynamics dynamics_;
    std::vector<double> jacobian_;  // (6, n)
};

}  // namespace armctl
