// Proofs that an arm keeps its distance during a whole motion: bisection in time with bounds of each link's motion.
#pragma once
#include <deque>

#include "errors.hpp"
#include "kept_region.hpp"
#include "loop_motion.hpp"
#include "spans.hpp"

namespace armctl {

constexpr size_t MAX_INTERVALS = 100000;  // in all, at most, and more for each piece of the motion: beyond that it counts as not free
constexpr size_t MAX_INTERVALS_PER_PIECE = 1000;
constexpr double MIN_MOTION_M = 1e-4;  // an interval in which no point moves farther is not split again: the pair then counts as not free
constexpr double MIN_MOTION_SHARE = 0.25;  // of the clearance, where that is less: a line may end where something is hardly farther away
constexpr double COARSE_MOTION = 0.8;  // of the size of the moving geom: while the motion is larger, a distance would not settle the pair
constexpr double MIN_TILT_RAD = 1e-4;  // an interval in which the axis turns by less is not split again: it then counts as tilted
constexpr double MIN_REGION_MOTION = 1e-6;  // m or sine, towards a limit of a region: the same for such an interval at it
constexpr double RESOLUTION_M = 2e-4;       // of the closest approach: between the proved bound and a distance that is attained
constexpr double SETTLED_M = 1e-7;          // A bound that is so near to the clearance is taken for it

// Where a motion is not known to be free. The number behind the last pair says that the tip leaves its region, the next one that closed
// loops cannot be closed.
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
        : scene_(std::move(scene)), positions_(scene_->model().joints()), delta_(scene_->model().joints()),
          tangent_(scene_->model().joints()), interval_(scene_->model().n()) {
        const Numbers zero(moving());
        motion_.set_line(zero, zero);
    }

    // How many numbers a motion has at each time: those of all joints, or with closed loops of the driven ones.
    size_t moving() const { return scene_->model().closure ? scene_->model().n() : scene_->model().joints(); }

    // Takes the straight line between two configurations (n,) as the motion.
    void set_line(Vector start, Vector end) {
        if (scene_->model().closure) {
            motion_.set_line(start, end);
            return;
        }
        scene_->find_positions(start, positions_);
        scene_->find_positions(end, delta_);
        motion_.set_line(positions_, delta_);
    }

    CollisionScene& scene() { return *scene_; }
    PolynomialMotion& motion() { return motion_; }
    // Sets or releases the region in which the tip stays: it moves with a frame and has a pose where joints are now.
    void keep(Vector positions, size_t frame, const Pose& tip, const Region& region) {
        checked_index(static_cast<std::int64_t>(frame), scene_->model().frames.size(), "frame");
        scene_->place_frames(positions);
        keep_.emplace(region, frame, scene_->frame(frame).pose, tip);
    }
    void release() { keep_.reset(); }
    const std::optional<KeptRegion>& kept() const { return keep_; }

    // Proves that all pairs, or only one, keep more than a clearance.
    std::optional<Hit> hit(double clearance, std::optional<size_t> only_pair = std::nullopt) {
        begin_proof(only_pair);
        return continue_proof(clearance);
    }

    // Proves that the motion keeps slightly less than the least distance seen so far, but more than the clearance. Where the
    // proof stops, a smaller distance is found, and the proof goes on with that one: what is settled so far stays settled.
    Approach closest_approach(double clearance) {
        double when = motion_.knot(0);
        place_in(0, 0.0, 0.0);
        PairDistance least = scene_->nearest_pair(positions_);
        begin_proof(std::nullopt);
        double aim = least.distance;
        while (least.distance > clearance) {
            double bound = std::max(aim - RESOLUTION_M, 0.5 * (aim + clearance));
            if (bound - clearance < SETTLED_M) { bound = clearance; }
            const std::optional<Hit> stopped = continue_proof(bound);
            if (!stopped) { return {bound, least.distance, {least.pair, when}}; }
            if (stopped->pair >= scene_->no_pair()) { return {-1.0, least.distance, *stopped}; }
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
    // A part of a piece of the motion; times count from the piece's knot.
    struct Interval {
        size_t piece;
        double begin;  // s
        double end;
        std::shared_ptr<const std::vector<size_t>> open_pairs;  // those that are not settled; none for all that may be near
    };

    // What is known of a pair, or of the region of the tip, in an interval.
    enum class Verdict { free, open, not_free };

    // Finds where all joints are in the middle of an interval of a piece, and how far they leave it at most; with closed loops also
    // whether these stay closed, with passive joints inside their limits.
    Verdict place_in(size_t piece, double begin, double end) {
        if (!scene_->loops()) {
            motion_.bound(piece, 0.5 * (begin + end), 0.5 * (end - begin), positions_, delta_);
            return Verdict::free;
        }
        switch (interval_.bound(motion_, *scene_->loops(), {piece, begin, end}, positions_, delta_)) {
            case LoopVerdict::broken:
                return Verdict::not_free;
            case LoopVerdict::open:
                return Verdict::open;
            default:
                return Verdict::free;
        }
    }

    // Notes all pieces of the motion as the first intervals.
    void begin_proof(std::optional<size_t> only_pair) {
        checked_ = 0;
        waiting_.clear();
        const auto open = only_pair ? std::make_shared<const std::vector<size_t>>(1, *only_pair) : nullptr;
        for (size_t piece = 0; piece < motion_.pieces(); ++piece) { waiting_.push_back({piece, 0.0, motion_.length(piece), open}); }
    }

    // Settles intervals until none is left or a pair is not free; the joints are then where it is.
    //
    // Intervals are split breadth first, so that contacts are found early. Both parts inherit the pairs that are open. A proof that
    // stopped goes on with the same interval.
    std::optional<Hit> continue_proof(double clearance) {
        while (!waiting_.empty()) {
            const auto [piece, begin, end, inherited] = waiting_.front();
            const double middle = 0.5 * (begin + end);
            const double time = motion_.knot(piece) + middle;
            const Verdict closure = place_in(piece, begin, end);
            if (closure == Verdict::not_free) { return Hit{scene_->no_pair() + 1, time}; }
            if (++checked_ > MAX_INTERVALS + MAX_INTERVALS_PER_PIECE * motion_.pieces()) {
                return Hit{scene_->nearest_pair(positions_).pair, time};
            }
            scene_->place(positions_);
            scene_->bound_motions(delta_);
            std::vector<size_t> open_pairs;
            for (const size_t p : inherited ? *inherited : scene_->pairs_in_motion(clearance)) {
                const Verdict verdict = check_pair(p, clearance);
                if (verdict == Verdict::not_free) { return Hit{p, time}; }
                if (verdict == Verdict::open) { open_pairs.push_back(p); }
            }
            const Verdict kept = keep_ ? check_kept(piece, begin, end) : Verdict::free;
            if (kept == Verdict::not_free) { return Hit{scene_->no_pair(), time}; }
            waiting_.pop_front();
            if (open_pairs.empty() && kept == Verdict::free && closure == Verdict::free) { continue; }
            const auto open = std::make_shared<const std::vector<size_t>>(std::move(open_pairs));
            waiting_.push_back({piece, begin, middle, open});
            waiting_.push_back({piece, middle, end, open});
        }
        return std::nullopt;
    }

    // Checks a pair where joints stay within delta of the middle of an interval, at which they are placed.
    Verdict check_pair(size_t p, double clearance) {
        const double motion = scene_->relative_motion(p);
        const double gap = scene_->gap(p);
        if (gap > clearance + motion) { return Verdict::free; }
        if (is_too_long(p, motion, gap, clearance)) {
            // Only a contact at its middle ends the search early.
            return scene_->touches(p, clearance) ? Verdict::not_free : Verdict::open;
        }
        const double enough = clearance + motion;
        const DistanceBounds bounds = scene_->distance(p, {.enough = enough + STRICTLY_M, .touching = clearance});
        if (bounds.lower > enough) { return Verdict::free; }
        if (bounds.upper <= clearance || bounds.lower <= clearance || motion < min_motion(clearance)) { return Verdict::not_free; }
        return Verdict::open;
    }

    // Whether an interval is too long for distances to settle a pair.
    bool is_too_long(size_t p, double motion, double gap, double clearance) const {
        const CollisionPair& pair = scene_->model().pairs[p];
        const double size = std::min(scene_->model().geoms[pair.a].radius, scene_->model().geoms[pair.b].radius);
        return motion > std::max(gap, 0.0) + COARSE_MOTION * size && motion > min_motion(clearance);
    }

    // Whether the tip stays in its region in an interval of a piece.
    Verdict check_kept(size_t piece, double begin, double end) {
        Verdict all = keep_->axis() ? check_tilt() : Verdict::free;
        if (all == Verdict::not_free || keep_->limits().empty()) { return all; }
        std::ranges::fill(tangent_, 0.0);
        if (!scene_->loops()) { motion_.tangent(piece, 0.5 * (begin + end), 0.5 * (end - begin), tangent_); }
        for (const RegionLimit& limit : keep_->limits()) {
            const Verdict verdict = check_limit(limit);
            if (verdict == Verdict::not_free) { return verdict; }
            if (verdict == Verdict::open) { all = verdict; }
        }
        return all;
    }

    // Whether the axis keeps its direction while joint j moves by at most delta[j].
    Verdict check_tilt() const {
        const double angle = keep_->tilt(*scene_);
        const double within = keep_->axis()->within;
        if (angle > within) { return Verdict::not_free; }
        const double turn = keep_->turn(*scene_, delta_);
        if (angle + turn <= within) { return Verdict::free; }
        return turn < MIN_TILT_RAD ? Verdict::not_free : Verdict::open;
    }

    Verdict check_limit(const RegionLimit& limit) const {
        bool is_outside = true;
        bool is_short = true;
        for (const HalfSpace& space : limit.either) {
            const double inside = keep_->inside(*scene_, space);
            const double decrease = keep_->decrease(*scene_, space, {tangent_, delta_});
            if (inside >= decrease) { return Verdict::free; }
            is_outside = is_outside && inside < 0.0;
            is_short = is_short && decrease < MIN_REGION_MOTION;
        }
        return is_outside || is_short ? Verdict::not_free : Verdict::open;
    }

    std::shared_ptr<CollisionScene> scene_;
    PolynomialMotion motion_;
    std::optional<KeptRegion> keep_;
    size_t checked_ = 0;  // intervals since the proof began
    std::deque<Interval> waiting_;
    // The middle of the interval in hand, (m,), and how far each joint leaves it at most.
    std::vector<double> positions_;
    std::vector<double> delta_;
    std::vector<double> tangent_;  // (m,) of the motion at the middle, up to the end of the interval
    LoopInterval interval_;
};

}  // namespace armctl
