// Proofs that an arm keeps its distance during a whole motion: bisection in time with bounds of each link's motion.
#pragma once
#include "collision_scene.hpp"
#include "errors.hpp"
#include "spans.hpp"

namespace armctl {

constexpr size_t MAX_WAITING = 8192;      // intervals that wait, about: then the search goes on depth first
constexpr size_t MAX_INTERVALS = 100000;  // in all, at most, and more for each piece of the motion: beyond that it counts as not free
constexpr size_t MAX_INTERVALS_PER_PIECE = 1000;
constexpr size_t OPEN_PAIRS_PER_PAIR = 400;
constexpr size_t MIN_OPEN_PAIRS = 4096;
constexpr double MIN_MOTION_M = 1e-4;  // an interval in which no point moves farther is not split again: the pair then counts as not free
constexpr double MIN_MOTION_SHARE = 0.25;  // of the clearance, where that is less: a line may end where something is hardly farther away
constexpr double COARSE_MOTION = 0.8;  // of the size of the moving geom: while the motion is larger, a distance would not settle the pair
constexpr double MIN_TILT_RAD = 1e-4;  // an interval in which the axis turns by less is not split again: it then counts as tilted
constexpr double RESOLUTION_M = 2e-4;  // of the closest approach: between the proved bound and a distance that is attained
constexpr double SETTLED_M = 1e-7;     // A bound that is so near to the clearance is taken for it
constexpr int APPROACH_SAMPLES = 24;   // samples of the motion from which the search for its closest approach starts
constexpr double UNIT_KNOTS[] = {0.0, 1.0};

// A motion of all joints by polynomials of time, of degree 1 to 5.
class PolynomialMotion {
public:
    static constexpr size_t MAX_DEGREE = 5;

    // `coefficients` (pieces, degree + 1, m), by powers of the time since the knot of the piece, row by row; `knots` (pieces + 1,)
    // s.
    void set(Vector knots, Vector coefficients, size_t joints) {
        if (knots.size() < 2) { throw InputError("knots: need at least two"); }
        joints_ = joints;
        powers_ = joints > 0 ? coefficients.size() / ((knots.size() - 1) * joints) : 2;
        if (powers_ < 2 || powers_ > MAX_DEGREE + 1) { throw InputError("coefficients: need polynomials of degree 1 to 5"); }
        knots_.assign(knots.begin(), knots.end());
        coefficients_.assign(coefficients.begin(), coefficients.end());
        bound_ranges();
    }

    // The straight line of all joints, (m,), in the time from 0 to 1.
    void set_line(Vector start, Vector end) {
        std::vector<double> coefficients(start.begin(), start.end());
        for (size_t i = 0; i < start.size(); ++i) { coefficients.push_back(end[i] - start[i]); }
        set(UNIT_KNOTS, coefficients, start.size());
    }

    size_t pieces() const { return knots_.size() - 1; }
    double begin() const { return knots_.front(); }
    double end() const { return knots_.back(); }
    double knot(size_t index) const { return knots_[index]; }

    // The piece at a time, looked for from a given one onwards.
    size_t piece_at(double time, size_t piece) const {
        while (piece + 1 < pieces() && knots_[piece + 1] <= time) { ++piece; }
        return piece;
    }

    // The positions (m,) at a time since the knot of a piece.
    void evaluate(size_t piece, double time, Result positions) const {
        for (size_t i = 0; i < joints_; ++i) {
            double value = 0.0;
            for (size_t power = powers_; power > 0; --power) { value = value * time + coefficient(piece, power - 1, i); }
            positions[i] = value;
        }
    }

    // The middle of an interval of one piece, and how far each joint leaves it at most. Times count from the piece's knot.
    //
    // The sum of |derivative k / k!| half^k; these Taylor coefficients at the middle come from repeated synthetic division (the
    // Horner scheme).
    void bound_interval(size_t piece, double middle, double half, Result positions, Result delta) const {
        for (size_t i = 0; i < joints_; ++i) {
            const double c0 = coefficient(piece, 0, i);
            const double c1 = coefficient(piece, 1, i);
            if (powers_ == 2) {
                positions[i] = c0 + middle * c1;
                delta[i] = std::abs(c1) * half;
                continue;
            }
            const double c2 = coefficient(piece, 2, i);
            const double c3 = powers_ > 3 ? coefficient(piece, 3, i) : 0.0;
            const double c4 = powers_ > 4 ? coefficient(piece, 4, i) : 0.0;
            const double c5 = powers_ > 5 ? coefficient(piece, 5, i) : 0.0;
            positions[i] = c0 + middle * (c1 + middle * (c2 + middle * (c3 + middle * (c4 + middle * c5))));
            const double d1 = c1 + middle * (2.0 * c2 + middle * (3.0 * c3 + middle * (4.0 * c4 + middle * 5.0 * c5)));
            const double d2 = c2 + middle * (3.0 * c3 + middle * (6.0 * c4 + middle * 10.0 * c5));
            const double d3 = c3 + middle * (4.0 * c4 + middle * 10.0 * c5);
            const double d4 = c4 + middle * 5.0 * c5;
            delta[i] = half * (std::abs(d1) + half * (std::abs(d2) + half * (std::abs(d3) + half * (std::abs(d4) + half * std::abs(c5)))));
        }
    }

    // The same for several pieces together; `middle` counts as the knots do.
    void bound_pieces(size_t first, size_t last, double middle, Result positions, Result delta) const {
        const size_t at = piece_at(middle, first);
        evaluate(at, middle - knots_[at], positions);
        std::fill(delta.begin(), delta.end(), 0.0);
        for (size_t piece = first; piece <= last; ++piece) {
            for (size_t i = 0; i < joints_; ++i) {
                const size_t at_range = piece * joints_ + i;
                delta[i] = std::max(delta[i], std::abs(range_middles_[at_range] - positions[i]) + range_deltas_[at_range]);
            }
        }
    }

private:
    double coefficient(size_t piece, size_t power, size_t joint) const {
        return coefficients_[(piece * powers_ + power) * joints_ + joint];
    }
    void bound_ranges() {
        range_middles_.resize(pieces() * joints_);
        range_deltas_.resize(pieces() * joints_);
        for (size_t piece = 0; piece < pieces(); ++piece) {
            const double half = 0.5 * (knots_[piece + 1] - knots_[piece]);
            bound_interval(piece, half, half, {range_middles_.data() + piece * joints_, joints_},
                           {range_deltas_.data() + piece * joints_, joints_});
        }
    }

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

inline double min_motion(double clearance) { return clearance > 0.0 ? std::min(MIN_MOTION_M, MIN_MOTION_SHARE * clearance) : MIN_MOTION_M; }

// One object for each thread. A proof takes the motion that was set.
class ClearanceProof {
public:
    explicit ClearanceProof(std::shared_ptr<CollisionScene> scene)
        : scene_(std::move(scene)), max_open_pairs_(OPEN_PAIRS_PER_PAIR * scene_->model().pairs.size() + MIN_OPEN_PAIRS),
          positions_(scene_->model().joints()), delta_(scene_->model().joints()) {
        motion_.set_line(positions_, positions_);
    }

    CollisionScene& scene() { return *scene_; }
    PolynomialMotion& motion() { return motion_; }
    // An axis that must keep its direction, or none.
    void set_kept_axis(const std::optional<KeptAxis>& keep) { keep_ = keep; }
    const std::optional<KeptAxis>& kept_axis() const { return keep_; }

    // Proves that all pairs, or only one, keep more than a clearance.
    std::optional<Hit> hit(double clearance, std::optional<size_t> only_pair = std::nullopt) {
        begin_proof(only_pair);
        return continue_proof(clearance);
    }

    // Proves that the motion keeps slightly less than the least distance seen so far, but more than the clearance. Where the
    // proof stops, a smaller distance is found, and the proof goes on with that one: what is settled so far stays settled.
    Approach closest_approach(double clearance) {
        PairDistance least{scene_->no_pair(), INFINITE_M};
        double when = 0.0;
        size_t piece = 0;
        for (int k = 0; k < APPROACH_SAMPLES; ++k) {
            const double time = motion_.begin() + (motion_.end() - motion_.begin()) * k / (APPROACH_SAMPLES - 1);
            piece = motion_.piece_at(time, piece);
            motion_.evaluate(piece, time - motion_.knot(piece), positions_);
            const PairDistance now = scene_->nearest_pair(positions_);
            if (now.distance < least.distance) {
                least = now;
                when = time;
            }
        }
        begin_proof(std::nullopt);
        double aim = least.distance;
        while (least.distance > clearance) {
            double bound = std::max(aim - RESOLUTION_M, 0.5 * (aim + clearance));
            if (bound - clearance < SETTLED_M) { bound = clearance; }
            const std::optional<Hit> stopped = continue_proof(bound);
            if (!stopped) { return {bound, least.distance, {least.pair, when}}; }
            if (stopped->pair == scene_->no_pair()) { return {-1.0, least.distance, *stopped}; }
            const PairDistance now = scene_->nearest_pair(positions_);
            if (bound == clearance) { return {-1.0, now.distance, {now.pair, stopped->time}}; }
            aim -= 0.5 * (aim - bound);  // a proof stops this near to its bound, or because GJK did not converge
            if (now.distance < least.distance) {
                least = now;
                when = stopped->time;
                aim = std::min(aim, least.distance);
            }
        }
        return {-1.0, least.distance, {least.pair, when}};
    }

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

    // Notes the whole motion as the first interval.
    void begin_proof(std::optional<size_t> only_pair) {
        head_ = 0;
        checked_ = 0;
        intervals_.clear();
        open_pairs_.clear();
        if (only_pair) { open_pairs_.push_back({*only_pair, false}); }
        intervals_.push_back({.begin = motion_.begin(),
                              .end = motion_.end(),
                              .first_piece = 0,
                              .last_piece = motion_.pieces() - 1,
                              .has_all_pairs = !only_pair,
                              .first_open = 0,
                              .last_open = open_pairs_.size(),
                              .tilt_is_open = keep_.has_value()});
    }

    // Settles intervals until none is left or a pair is not free; the joints are then where it is.
    //
    // Intervals are split breadth first, so that contacts are found early, and depth first as long as many wait. Both parts inherit
    // the pairs that are open. A proof that stopped goes on with the same interval.
    std::optional<Hit> continue_proof(double clearance) {
        while (head_ < intervals_.size()) {
            if (!has_room() && 2 * head_ > intervals_.size()) { move_to_front(); }
            const bool takes_last = !has_room();
            const Interval interval = takes_last ? intervals_.back() : intervals_[head_];
            const double middle = 0.5 * (interval.begin + interval.end);
            if (interval.first_piece == interval.last_piece) {
                motion_.bound_interval(interval.first_piece, middle - motion_.knot(interval.first_piece),
                                       0.5 * (interval.end - interval.begin), positions_, delta_);
            } else {
                motion_.bound_pieces(interval.first_piece, interval.last_piece, middle, positions_, delta_);
            }
            if (++checked_ > MAX_INTERVALS + MAX_INTERVALS_PER_PIECE * motion_.pieces()) {
                return Hit{scene_->nearest_pair(positions_).pair, middle};
            }
            const size_t first_open = open_pairs_.size();
            const std::optional<size_t> not_free = check_interval(interval, clearance);
            if (not_free) {
                open_pairs_.resize(first_open);
                return Hit{*not_free, middle};
            }
            const Tilt tilt = interval.tilt_is_open ? check_tilt() : Tilt::keeps;
            if (tilt == Tilt::exceeds) {
                open_pairs_.resize(first_open);
                return Hit{scene_->no_pair(), middle};
            }
            if (takes_last) {
                intervals_.pop_back();
            } else {
                ++head_;
            }
            if (open_pairs_.size() > first_open || tilt == Tilt::open) {
                split(interval, first_open, tilt == Tilt::open);
            } else if (takes_last) {
                open_pairs_.resize(head_ < intervals_.size() ? intervals_.back().last_open : 0);
            }
        }
        return std::nullopt;
    }

    bool has_room() const {
        const size_t needed = scene_->model().pairs.size() + scene_->model().groups.size();
        return intervals_.size() + 2 <= MAX_WAITING && open_pairs_.size() + needed <= max_open_pairs_;
    }

    // Removes the intervals that are settled, and their open pairs.
    void move_to_front() {
        const size_t settled_pairs = intervals_[head_].first_open;
        open_pairs_.erase(open_pairs_.begin(), open_pairs_.begin() + static_cast<std::ptrdiff_t>(settled_pairs));
        intervals_.erase(intervals_.begin(), intervals_.begin() + static_cast<std::ptrdiff_t>(head_));
        for (Interval& interval : intervals_) {
            interval.first_open -= settled_pairs;
            interval.last_open -= settled_pairs;
        }
        head_ = 0;
    }

    // Checks the open pairs of an interval where joints stay within delta of its middle. Notes those that stay open; returns a pair
    // that is not free.
    std::optional<size_t> check_interval(const Interval& interval, double clearance) {
        scene_->place(positions_);
        std::optional<size_t> not_free;
        if (interval.has_all_pairs) {
            for (size_t group = 0; group < scene_->model().groups.size() && !not_free; ++group) {
                not_free = check_group(group, clearance);
            }
            return not_free;
        }
        for (size_t i = interval.first_open; i < interval.last_open && !not_free; ++i) {
            const OpenPair open = open_pairs_[i];
            not_free = open.is_group ? check_group(open.index, clearance) : check_pair(open.index, clearance);
        }
        return not_free;
    }

    std::optional<size_t> check_group(size_t index, double clearance) {
        const GroupPair& group = scene_->model().groups[index];
        const double motion = scene_->relative_motion(group.a, group.b, group.common, delta_);
        const double gap = scene_->gap(group.a, group.b);
        if (gap > clearance + motion) { return std::nullopt; }
        const bool is_too_long_for_group = is_too_long(motion, gap, group.a, group.b, clearance);
        if (is_too_long_for_group && gap > clearance) {
            open_pairs_.push_back({index, true});
            return std::nullopt;
        }
        for (size_t p = group.first_pair; p < group.last_pair; ++p) {
            if (!is_too_long_for_group) {
                if (const std::optional<size_t> not_free = check_pair(p, clearance)) { return not_free; }
            } else if (scene_->touches(p, clearance)) {
                scene_->expect_hit(p);
                return p;
            }
        }
        if (is_too_long_for_group) { open_pairs_.push_back({index, true}); }
        return std::nullopt;
    }

    std::optional<size_t> check_pair(size_t p, double clearance) {
        const CollisionPair& pair = scene_->model().pairs[p];
        const double motion = scene_->relative_motion(pair.a, pair.b, pair.common, delta_);
        const double gap = scene_->gap(pair.a, pair.b);
        if (gap > clearance + motion) { return std::nullopt; }
        if (is_too_long(motion, gap, pair.a, pair.b, clearance)) {
            // Only a contact at its middle ends the search early.
            if (gap <= clearance && scene_->touches(p, clearance)) {
                scene_->expect_hit(p);
                return p;
            }
            open_pairs_.push_back({p, false});
            return std::nullopt;
        }
        const double enough = clearance + motion;
        const DistanceBounds bounds = scene_->distance(p, {.enough = enough + STRICTLY_M, .touching = clearance});
        if (bounds.lower > enough) { return std::nullopt; }
        if (bounds.upper <= clearance || bounds.lower <= clearance || motion < min_motion(clearance)) {
            scene_->expect_hit(p);
            return p;
        }
        if (scene_->model().geoms[pair.a].kind != ShapeKind::plane) {
            const double separating = scene_->separating_motion(p, delta_);
            if (bounds.lower > clearance + separating) { return std::nullopt; }
            if (bounds.upper > clearance + separating) {
                const double enough_along = clearance + separating + STRICTLY_M;
                const DistanceBounds exact = scene_->distance(p, {.enough = enough_along, .touching = clearance, .is_exact = true});
                if (exact.lower > clearance + scene_->separating_motion(p, delta_)) { return std::nullopt; }
            }
        }
        open_pairs_.push_back({p, false});
        return std::nullopt;
    }

    // Whether an interval is too long for distances to settle a pair.
    bool is_too_long(double motion, double gap, size_t a, size_t b, double clearance) const {
        const std::vector<BoundingSphere>& spheres = scene_->model().spheres;
        const double size = std::min(spheres[a].radius, spheres[b].radius);
        return motion > std::max(gap, 0.0) + COARSE_MOTION * size && motion > min_motion(clearance);
    }

    // Whether the axis keeps its direction while joint j moves by at most delta[j]. Change the joints from the base outward: hinge
    // j then turns the axis u on a circle of radius |a_j x u|.
    Tilt check_tilt() const {
        const double angle = scene_->tilt(*keep_);
        if (angle > keep_->within) { return Tilt::exceeds; }
        const Vec3 axis = scene_->frame(keep_->frame).pose.rotation * keep_->axis;
        double turn = 0.0;
        for (size_t walk = keep_->frame; walk > 0; walk = scene_->model().frames[walk].parent) {
            const MovingFrame& moving = scene_->model().frames[walk];
            if (!moving.slides) { turn += delta_[moving.joint] * norm(cross(scene_->frame(walk).axis, axis)); }
        }
        if (angle + turn <= keep_->within) { return Tilt::keeps; }
        return turn < MIN_TILT_RAD ? Tilt::exceeds : Tilt::open;
    }

    // Appends both parts of an interval, split at a knot if it has one inside.
    void split(const Interval& interval, size_t first_open, bool tilt_is_open) {
        double middle = 0.5 * (interval.begin + interval.end);
        size_t before = interval.first_piece;  // the last piece of the first part
        const bool has_knot = interval.first_piece < interval.last_piece;
        if (has_knot) {
            before = motion_.piece_at(middle, interval.first_piece);
            const bool is_near_its_knot =
                before > interval.first_piece && middle - motion_.knot(before) < motion_.knot(before + 1) - middle;
            if (before == interval.last_piece || is_near_its_knot) { --before; }
            middle = motion_.knot(before + 1);
        }
        Interval part = interval;
        part.has_all_pairs = false;
        part.first_open = first_open;
        part.last_open = open_pairs_.size();
        part.tilt_is_open = tilt_is_open;
        part.end = middle;
        part.last_piece = before;
        intervals_.push_back(part);
        part.begin = middle;
        part.end = interval.end;
        part.first_piece = has_knot ? before + 1 : interval.last_piece;
        part.last_piece = interval.last_piece;
        intervals_.push_back(part);
    }

    std::shared_ptr<CollisionScene> scene_;
    PolynomialMotion motion_;
    std::optional<KeptAxis> keep_;
    size_t max_open_pairs_;
    size_t checked_ = 0;  // intervals since the proof began
    // The intervals from `head_` on wait.
    std::vector<Interval> intervals_;
    size_t head_ = 0;
    std::vector<OpenPair> open_pairs_;
    // The middle of the interval in hand, (m,), and how far each joint leaves it at most.
    std::vector<double> positions_;
    std::vector<double> delta_;
};

}  // namespace armctl
