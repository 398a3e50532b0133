// Where the joints and the tip of a chain are, and how they move.
#pragma once
#include <vector>

#include "chain.hpp"

namespace armctl {

// Which parts of the tip's pose are constrained: `free_x` leaves the turn about the tip's x axis free.
enum class Constraint { pose = 0, position = 1, free_x = 2, free_y = 3, free_z = 4 };

inline bool has_free_axis(Constraint constraint) { return constraint >= Constraint::free_x; }
// The axis about which the tip may turn.
inline int free_axis(Constraint constraint) { return static_cast<int>(constraint) - static_cast<int>(Constraint::free_x); }

struct PoseError {
    double position;     // m, or reaches
    double orientation;  // rad
};

// The errors of a tip, in the unit of length of both poses. They are finite.
PoseError residual(Constraint constraint, const Pose& target, const Pose& tip);

// The joint of a chain in space.
struct JointLine {
    Vec3 origin;
    Vec3 axis;
};

// The signs of three factors of a Jacobian's determinant are numbered from 0 to 26; this is a chain without them.
inline constexpr int NO_BRANCH = 27;

// The kinematics of a chain at one configuration, with scratch memory: one object for each thread.
class ChainKinematics {
public:
    explicit ChainKinematics(const Chain& chain);

    const Chain& chain() const { return *chain_; }

    // Places the joints and the tip at q (n,).
    void place(Vector q);

    // The Jacobian of the tip where the joints are placed: a twist for each unknown, world axes.
    void find_jacobian();

    // The branch where the joints are placed: the signs of the factors of the Jacobian's determinant, as a number. If two of
    // the three axes that are not special meet or are parallel there are three factors, else two. Of an arm with seven joints
    // it is the Jacobian without the joint that is swept.
    int branch() const;

    // Yoshikawa's manipulability where the joints are placed, lengths in m; of the position, or of position and orientation.
    // With fewer unknowns than rows it is sqrt(det(J^T J)) (Yoshikawa, "Manipulability of robotic mechanisms", Int. J. Robotics
    // Research 4(2), 1985).
    double manipulability(bool oriented);

    const std::vector<JointLine>& joints() const { return lines_; }
    const Pose& tip() const { return tip_; }
    // The tip with its position in m.
    Pose metric_tip() const { return {tip_.rotation, chain_->reach() * tip_.translation}; }
    std::vector<Twist>& jacobian() { return jacobian_; }
    const std::vector<Twist>& jacobian() const { return jacobian_; }

private:
    Twist joint_twist(size_t j) const;
    Vec3 special_point(size_t j) const;

    const Chain* chain_;
    std::vector<JointLine> lines_;  // (k,)
    Pose tip_;
    std::vector<Twist> jacobian_;  // (n,)
};

}  // namespace armctl
