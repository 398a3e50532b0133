// What a motion must keep: a clearance from everything and, if asked, the direction of an axis.
#pragma once
#include <memory>
#include <vector>

#include "clearance_proof.hpp"
#include "spans.hpp"

namespace armctl {

using Configuration = std::vector<double>;  // (n,) rad
using Path = std::vector<Configuration>;

// Distance of two configurations, rad.
double joint_distance(Vector first, Vector second);

class FreeSpace {
public:
    // Uses the proof's scratch memory and its kept axis.
    FreeSpace(std::shared_ptr<ClearanceProof> proof, double clearance);

    size_t n() const { return proof_->scene().model().n(); }

    // Whether the straight line between two configurations, (n,), is proved.
    bool line_is_free(Vector start, Vector end);
    // The same for an edge of a tree. To check its end first decides most edges at a tenth of the cost of a proof.
    bool edge_is_free(Vector start, Vector end);

    bool keeps_axis() const { return proof_->kept_axis().has_value(); }
    double kept_within() const { return proof_->kept_axis()->within; }
    // Turns the kept axis of a configuration towards its direction, by the least motion of the joints, between bounds. Returns
    // whether it could.
    bool level(Result q, Vector low, Vector high);

private:
    void find_axis_jacobian(Vec3 axis);
    Vec3 rotation_needed(Vec3 axis) const;
    Vec3 solve_damped_gram(Vec3 b) const;

    std::shared_ptr<ClearanceProof> proof_;
    double clearance_;
    std::vector<double> start_;  // (m,)
    std::vector<double> end_;
    std::vector<Vec3> axis_jacobian_;  // (n,) how each joint turns the kept axis, across it
};

}  // namespace armctl
