// Regressor of an unknown body at the tip, and a recursive Bayesian estimator of its parameters, delay and friction.
//
// The ten parameters are the mass m, the first moment m c (3,) and the second moments S, xx yy zz xy xz yz, kg m^2, of the body
// in the tip's frame. Its inertia about the tip is tr(S) 1 - S. The torque is linear in them. The eleventh unknown is the delay
// T of the motors: the torque tau(t - T) acts, so tau(t) exceeds what the motion needs by T times the rate of tau. The last
// unknowns are the dry friction of the n joints, N m.
//
// Sources: Atkeson, An, Hollerbach, "Estimation of inertial parameters of manipulator loads and links" (1986); Ljung, System
// Identification (1999), 11.2.
#pragma once
#include <array>
#include <vector>

#include "../dense_matrix.hpp"
#include "../dynamics.hpp"

namespace armctl {

constexpr size_t body_parameters = 10;
constexpr size_t delay_unknown = 10;
constexpr size_t first_friction_unknown = 11;

// The number of unknowns of an arm of n joints.
inline size_t unknown_count(size_t n) { return first_friction_unknown + n; }

// The torques of a body at the tip per parameter, the first ten columns of Y (n, 10 or more), at a motion of the arm. `J` (6,
// n) becomes the Jacobian of the tip.
void payload_regressor(Dynamics& dynamics, Vector q, Vector v, Vector a, MatrixResult J, MatrixResult Y);

class PayloadEstimator {
public:
    struct Settings {
        double filter_weight = 0.0;            // of each of two low-passes in one control period
        double information_weight = 0.0;       // of one control period
        double forgetting = 0.0;               // per control period
        std::vector<double> torque_precision;  // (n,) 1/(N m), reciprocal standard deviations of unexplained torques
        std::vector<double> prior_deviations;  // (p,) standard deviations of the unknowns before any motion
    };

    // What the estimator keeps from tick to tick, as parts of the memory of a law.
    struct Memory {
        Memory(std::span<double> numbers, size_t n);
        static size_t size(size_t n);

        Result estimate;                         // (p,)
        std::array<MatrixResult, 2> regressors;  // (n, p) behind each low-pass
        std::array<Result, 2> torques;           // (n,) behind each low-pass
        MatrixResult information;                // (p, p)
        Result information_vector;               // (p,)
    };

    explicit PayloadEstimator(Settings settings);

    // Updates the estimate with the torque (n,) that the motors gave beyond the model's in one control period, at which the
    // regressor was Y (n, p).
    //
    // Regressors and torques pass the same low-pass. Old information fades, faster if the estimate does not explain the torques
    // (Fortescue, Kershenbaum, Ydstie, "Implementation of self-tuning regulators with variable forgetting factors", 1981).
    void learn(Matrix Y, Vector torque, bool is_moving, Memory& memory);

private:
    double filter(Matrix Y, Vector torque, Memory& memory) const;
    void add_information(double keep, Memory& memory);

    double filter_weight_;
    double information_weight_;
    double forgetting_;
    std::vector<double> torque_precision_;
    std::vector<double> prior_deviations_;
    DenseMatrix factors_;  // (p, p) scratch memory
};

}  // namespace armctl
