#include "clearance_proof.hpp"

#include <algorithm>
#include <cmath>

namespace armctl {

namespace {

// Intervals and open pairs that wait, at most: beyond that a motion counts as not free.
constexpr size_t MAX_INTERVALS = 8192;
constexpr size_t OPEN_PAIRS_PER_PAIR = 400;
constexpr size_t MIN_OPEN_PAIRS = 4096;
// An interval in which no point moves farther is not split again: the pair then counts as not free.
constexpr double MIN_MOTION_M = 1e-4;
// Of the clearance, where that is less: a line may end where something is hardly farther away.
constexpr double MIN_MOTION_SHARE = 0.25;
// Of the size of the moving geom: while the motion is larger, a distance would not settle the pair.
constexpr double COARSE_MOTION = 0.8;
// An interval in which the axis turns by less is not split again: it then counts as tilted.
constexpr double MIN_TILT_RAD = 1e-4;
// Of the closest approach: between the proved bound and a distance that is attained.
constexpr double RESOLUTION_M = 2e-4;
// A bound that is so near to the clearance is taken for it.
constexpr double SETTLED_M = 1e-7;
// Samples of the motion from which the search for its closest approach starts.
constexpr int APPROACH_SAMPLES = 24;

double min_motion(double clearance) { return clearance > 0.0 ? std::min(MIN_MOTION_M, MIN_MOTION_SHARE * clearance) : MIN_MOTION_M; }

}  // namespace

ClearanceProof::ClearanceProof(std::shared_ptr<CollisionScene> scene)
    : scene_(std::move(scene)), max_open_pairs_(OPEN_PAIRS_PER_PAIR * scene_->model().pairs.size() + MIN_OPEN_PAIRS),
      positions_(scene_->model().joints()), delta_(scene_->model().joints()) {
    motion_.set_line(positions_, positions_);
}

std::optional<Hit> ClearanceProof::hit(double clearance, std::optional<size_t> only_pair) {
    begin_proof(only_pair);
    return continue_proof(clearance);
}

Approach ClearanceProof::closest_approach(double clearance) {
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

// Notes the whole motion as the first interval.
void ClearanceProof::begin_proof(std::optional<size_t> only_pair) {
    head_ = 0;
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
// Intervals are split breadth first, so that contacts are found early, and both parts inherit the pairs that are open. A proof
// that stopped goes on with the same interval.
std::optional<Hit> ClearanceProof::continue_proof(double clearance) {
    while (head_ < intervals_.size()) {
        if (!has_room()) { move_to_front(); }
        const Interval interval = intervals_[head_];
        const double middle = 0.5 * (interval.begin + interval.end);
        if (interval.first_piece == interval.last_piece) {
            motion_.bound_interval(interval.first_piece, middle - motion_.knot(interval.first_piece), 0.5 * (interval.end - interval.begin),
                                   positions_, delta_);
        } else {
            motion_.bound_pieces(interval.first_piece, interval.last_piece, middle, positions_, delta_);
        }
        if (!has_room()) { return Hit{scene_->nearest_pair(positions_).pair, middle}; }
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
        ++head_;
        if (open_pairs_.size() > first_open || tilt == Tilt::open) { split(interval, first_open, tilt == Tilt::open); }
    }
    return std::nullopt;
}

bool ClearanceProof::has_room() const {
    const size_t needed = scene_->model().pairs.size() + scene_->model().groups.size();
    return intervals_.size() + 2 <= MAX_INTERVALS && open_pairs_.size() + needed <= max_open_pairs_;
}

// Removes the intervals that are settled, and their open pairs.
void ClearanceProof::move_to_front() {
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
std::optional<size_t> ClearanceProof::check_interval(const Interval& interval, double clearance) {
    scene_->place(positions_);
    std::optional<size_t> not_free;
    if (interval.has_all_pairs) {
        for (size_t group = 0; group < scene_->model().groups.size() && !not_free; ++group) { not_free = check_group(group, clearance); }
        return not_free;
    }
    for (size_t i = interval.first_open; i < interval.last_open && !not_free; ++i) {
        const OpenPair open = open_pairs_[i];
        not_free = open.is_group ? check_group(open.index, clearance) : check_pair(open.index, clearance);
    }
    return not_free;
}

// Whether an interval is too long for distances to settle a pair.
bool ClearanceProof::is_too_long(double motion, double gap, size_t a, size_t b, double clearance) const {
    const std::vector<BoundingSphere>& spheres = scene_->model().spheres;
    const double size = std::min(spheres[a].radius, spheres[b].radius);
    return motion > std::max(gap, 0.0) + COARSE_MOTION * size && motion > min_motion(clearance);
}

std::optional<size_t> ClearanceProof::check_group(size_t index, double clearance) {
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

std::optional<size_t> ClearanceProof::check_pair(size_t p, double clearance) {
    const GeomPair& pair = scene_->model().pairs[p];
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

// Whether the axis keeps its direction while joint j moves by at most delta[j]. Change the joints from the base outward: hinge
// j then turns the axis u on a circle of radius |a_j x u|.
ClearanceProof::Tilt ClearanceProof::check_tilt() const {
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
void ClearanceProof::split(const Interval& interval, size_t first_open, bool tilt_is_open) {
    double middle = 0.5 * (interval.begin + interval.end);
    size_t before = interval.first_piece;  // the last piece of the first part
    const bool has_knot = interval.first_piece < interval.last_piece;
    if (has_knot) {
        before = motion_.piece_at(middle, interval.first_piece);
        const bool is_near_its_knot = before > interval.first_piece && middle - motion_.knot(before) < motion_.knot(before + 1) - middle;
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

}  // namespace armctl
