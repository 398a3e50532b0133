#include "torque_filter.hpp"

#include "../errors.hpp"

namespace armctl {

TorqueFilter::TorqueFilter(std::shared_ptr<Law> filtered, Matrix sections)
    : LawAround(filtered, 1 + (2 * sections.rows * filtered->joints())) {
    for (size_t k = 0; k < sections.rows; ++k) {
        const Vector row = sections.row(k);
        if (row[3] != 1.0) { throw InputError("sections: a0 must be 1"); }
        sections_.push_back({.b0 = row[0], .b1 = row[1], .b2 = row[2], .a1 = row[4], .a2 = row[5]});
    }
}

void TorqueFilter::torque(const State& state, const Setpoint& setpoint, Result tau) {
    inner_torque(state, setpoint, tau);
    double& has_begun = own_memory()[0];
    Result states = own_memory().subspan(1);
    for (const Biquad& section : sections_) {
        for (double& torque : tau) {
            const Result own = states.first(2);
            if (has_begun == 0.0) { section.settle(torque, own); }
            torque = section.output(torque, own);
            states = states.subspan(2);
        }
    }
    has_begun = 1.0;
}

}  // namespace armctl
