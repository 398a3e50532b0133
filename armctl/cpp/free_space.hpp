// What a motion must keep: a clearance from everything and, if asked, the direction of an axis.
#pragma once
#include "clearance_proof.hpp"
#include "spans.hpp"

namespace armctl {

constexpr double LEVEL_SHARE = 0.5;  // of the permitted tilt, which nodes keep: the lines between them need the rest
constexpr double LEVEL_TOLERANCE_RAD = 1e-6;
constexpr int LEVEL_STEPS = 8;
constexpr double LEVEL_DAMPING = 1e-6;
constexpr double UPSIDE_DOWN = 1e-16;  // the square of a sine: the axis is upside down

using Configuration = std::vector<double>;  // (n,) rad
using Path = std::vector<Configuration>;

// Distance of two configurations, rad.
inline double joint_distance(Vector first, Vector second) {
    double square = 0.0;
    for (size_t i = 0; i < first.size(); ++i) {
        const double difference = second[i] - first[i];
        square += difference * difference;
    }
    return std::sqrt(square);
}

class FreeSpace {
public:
    // Uses the proof's scratch memory and its kept axis.
    FreeSpace(std::shared_ptr<ClearanceProof> proof, double clearance)
        : proof_(std::move(proof)), clearance_(clearance), start_(proof_->scene().model().joints()), end_(start_.size()) {}

    size_t n() const { return proof_->scene().model().n(); }

    // Whether the straight line between two configurations, (n,), is proved.
    bool line_is_free(Vector start, Vector end) {
        proof_->scene().model().positions(start, start_);
        proof_->scene().model().positions(end, end_);
        proof_->motion().set_line(start_, end_);
        return !proof_->hit(clearance_);
    }

    // The same for an edge of a tree. To check its end first decides most edges at a tenth of the cost of a proof.
    bool edge_is_free(Vector start, Vector end) {
        CollisionScene& scene = proof_->scene();
        scene.model().positions(end, end_);
        if (scene.first_hit(end_, clearance_) != scene.no_pair()) { return false; }
        if (keeps_axis() && scene.tilt(*proof_->kept_axis()) > kept_within()) { return false; }
        return line_is_free(start, end);
    }

    bool keeps_axis() const { return proof_->kept_axis().has_value(); }
    double kept_within() const { return proof_->kept_axis()->within; }
    // Turns the kept axis of a configuration towards its direction, by the least motion of the joints, between bounds. Returns
    // whether it could. Newton steps on the tilt.
    bool level(Result q, Vector low, Vector high) {
        CollisionScene& scene = proof_->scene();
        const KeptAxis& keep = *proof_->kept_axis();
        for (int step = 0; step < LEVEL_STEPS; ++step) {
            scene.model().positions(q, end_);
            scene.place_frames(end_);
            const double excess = scene.tilt(keep) - LEVEL_SHARE * keep.within;
            if (excess <= LEVEL_TOLERANCE_RAD) { return true; }
            const Numbers decrease = tilt_decrease(scene.frame(keep.frame).pose.rotation * keep.axis);
            const double scale = (excess + LEVEL_TOLERANCE_RAD) / (dot(decrease, decrease) + LEVEL_DAMPING);
            for (size_t j = 0; j < q.size(); ++j) { q[j] = std::min(std::max(q[j] + scale * decrease[j], low[j]), high[j]); }
        }
        return false;
    }

private:
    // How fast each joint (n,) turns the kept axis towards its direction.
    Numbers tilt_decrease(Vec3 axis) const {
        const CollisionScene& scene = proof_->scene();
        Vec3 rotation = cross(axis, proof_->kept_axis()->direction);
        if (dot(rotation, rotation) < UPSIDE_DOWN) {  // any rotation across the axis
            rotation = {axis.y - axis.z, axis.z - axis.x, axis.x - axis.y};
        }
        Numbers all(scene.model().joints());
        for (size_t walk = proof_->kept_axis()->frame; walk > 0; walk = scene.model().frames[walk].parent) {
            const MovingFrame& moving = scene.model().frames[walk];
            if (!moving.slides) { all[moving.joint] = dot(scene.frame(walk).axis, rotation) / norm(rotation); }
        }
        return scene.model().reduced_gradient(all);
    }

    std::shared_ptr<ClearanceProof> proof_;
    double clearance_;
    std::vector<double> start_;  // (m,)
    std::vector<double> end_;
};

}  // namespace armctl
