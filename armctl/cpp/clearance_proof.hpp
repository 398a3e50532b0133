// Proofs that an arm keeps its distance during a whole motion: bisection in time with bounds of each link's motion.
#pragma once
#include <memory>
#include <optional>
#include <vector>

#include "collision_scene.hpp"
#include "spans.hpp"

namespace armctl {

// A motion of all joints by polynomials of time, of degree 1 to 5.
class PolynomialMotion {
public:
    static constexpr size_t MAX_DEGREE = 5;

    // `coefficients` (pieces, degree + 1, m), by powers of the time since the knot of the piece, row by row; `knots` (pieces + 1,)
    // s.
    void set(Vector knots, Vector coefficients, size_t joints);
    // The straight line of all joints, (m,), in the time from 0 to 1.
    void set_line(Vector start, Vector end);

    size_t pieces() const { return knots_.size() - 1; }
    double begin() const { return knots_.front(); }
    double end() const { return knots_.back(); }
    double knot(size_t index) const { return knots_[index]; }

    // The piece at a time, looked for from a given one onwards.
    size_t piece_at(double time, size_t piece) const;
    // The positions (m,) at a time since the knot of a piece.
    void evaluate(size_t piece, double time, Result positions) const;
    // The middle of an interval of one piece, and how far each joint leaves it at most. Times count from the piece's knot.
    void bound_interval(size_t piece, double middle, double half, Result positions, Result delta) const;
    // The same for several pieces together; `middle` counts as the knots do.
    void bound_pieces(size_t first, size_t last, double middle, Result positions, Result delta) const;

private:
    double coefficient(size_t piece, size_t power, size_t joint) const {
        return coefficients_[(piece * powers_ + power) * joints_ + joint];
    }
    void bound_ranges();

    std::vector<double> knots_;
    std::vector<double> coefficients_;
    size_t powers_ = 2;
    size_t joints_ = 0;
    // Of each piece and joint: the middle of its range, and how far it leaves that at most.
    std::vector<double> range_middles_;
    std::vector<double> range_deltas_;
};

// Where a motion is not known to be free. The number behind the last pair says that the kept axis tilts.
struct Hit {
    size_t pair;
    double time;  // s
};

// How near a motion comes.
struct Approach {
    double bound;     // m, proved for the whole motion; negative if the clearance could not be proved
    double distance;  // m, that occurs: near the bound, or where the proof failed
    Hit nearest;      // its pair and time
};

// One object for each thread. A proof takes the motion that was set.
class ClearanceProof {
public:
    explicit ClearanceProof(std::shared_ptr<CollisionScene> scene);

    CollisionScene& scene() { return *scene_; }
    PolynomialMotion& motion() { return motion_; }
    // An axis that must keep its direction, or none.
    void set_kept_axis(const std::optional<KeptAxis>& keep) { keep_ = keep; }
    const std::optional<KeptAxis>& kept_axis() const { return keep_; }

    // Proves that all pairs, or only one, keep more than a clearance.
    std::optional<Hit> hit(double clearance, std::optional<size_t> only_pair = std::nullopt);

    // Proves that the motion keeps slightly less than the least distance seen so far, but more than the clearance. Where the
    // proof stops, a smaller distance is found, and the proof goes on with that one: what is settled so far stays settled.
    Approach closest_approach(double clearance);

private:
    struct Interval {
        double begin;  // s
        double end;
        size_t first_piece;
        size_t last_piece;
        bool has_all_pairs;  // nothing is settled
        size_t first_open;   // of the list of open pairs
        size_t last_open;
        bool tilt_is_open;
    };

    // A pair, or all pairs of two groups, that are not settled.
    struct OpenPair {
        size_t index;
        bool is_group;
    };

    enum class Tilt { keeps, open, exceeds };

    void begin_proof(std::optional<size_t> only_pair);
    std::optional<Hit> continue_proof(double clearance);
    bool has_room() const;
    void move_to_front();
    std::optional<size_t> check_interval(const Interval& interval, double clearance);
    std::optional<size_t> check_group(size_t group, double clearance);
    std::optional<size_t> check_pair(size_t pair, double clearance);
    bool is_too_long(double motion, double gap, size_t a, size_t b, double clearance) const;
    Tilt check_tilt() const;
    void split(const Interval& interval, size_t first_open, bool tilt_is_open);

    std::shared_ptr<CollisionScene> scene_;
    PolynomialMotion motion_;
    std::optional<KeptAxis> keep_;
    size_t max_open_pairs_;
    // The intervals from `head_` on wait.
    std::vector<Interval> intervals_;
    size_t head_ = 0;
    std::vector<OpenPair> open_pairs_;
    // The middle of the interval in hand, (m,), and how far each joint leaves it at most.
    std::vector<double> positions_;
    std::vector<double> delta_;
};

}  // namespace armctl
