#include "tip_force.hpp"

namespace armctl {

TipForce::TipForce(std::shared_ptr<const ArmModel> model) : dynamics_(std::move(model)), jacobian_(6 * joints()) {}

void TipForce::torque(Vector q, Vector wrench, Result tau) {
    const MatrixResult J{jacobian_.data(), 6, joints()};
    dynamics_.place(q);
    dynamics_.locate();
    dynamics_.tip_jacobian(J);
    for (size_t i = 0; i < tau.size(); ++i) {
        double total = 0.0;
        for (size_t k = 0; k < 6; ++k) { total += J(k, i) * wrench[k]; }
        tau[i] = total;
    }
}

}  // namespace armctl
