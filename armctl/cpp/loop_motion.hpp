// Closed loops during a whole motion of the driven joints: a proof by bisection in time that they stay closed.
#pragma once
#include <deque>
#include <optional>

#include "loop_bounds.hpp"
#include "polynomial_motion.hpp"

namespace armctl {

// A part of a piece of a motion; times count from the piece's knot.
struct TimeInterval {
    size_t piece;
    double begin;  // s
    double end;
};

// What closed loops do in an interval, with scratch memory.
class LoopInterval {
public:
    explicit LoopInterval(size_t n) : q_(n), delta_q_(n), end_q_(n), no_delta_(n) {}

    // Fills the positions (m,) in the middle, and bounds of how far the joints leave them. Both ends have to be on one branch with the
    // middle; so neighboring intervals are.
    LoopVerdict bound(const PolynomialMotion& motion, BoundedLoops& loops, const TimeInterval& interval, Result positions, Result delta) {
        const double middle = 0.5 * (interval.begin + interval.end);
        const double half = 0.5 * (interval.end - interval.begin);
        motion.bound(interval.piece, middle, half, q_, delta_q_);
        const LoopVerdict verdict = loops.bound(q_, delta_q_, delta);
        copy(loops.positions(), positions);
        if (half == 0.0 && verdict == LoopVerdict::open) { return LoopVerdict::closed; }
        if (half == 0.0 || verdict != LoopVerdict::closed) { return verdict; }
        for (const double time : {interval.begin, interval.end}) {
            motion.bound(interval.piece, time, 0.0, end_q_, no_delta_);
            if (!loops.holds(end_q_, positions)) { return LoopVerdict::open; }
        }
        return LoopVerdict::closed;
    }

private:
    Numbers q_, delta_q_, end_q_, no_delta_;  // (n,)
};

// The first time, s, at which loops are not known to stay closed with passive joints inside their limits; none if they are proved to.
inline std::optional<double> first_break(const Closure& closure, const PolynomialMotion& motion) {
    constexpr size_t max_intervals = 100000;
    BoundedLoops loops(closure);
    LoopInterval interval(closure->n());
    Numbers positions(closure->m());
    Numbers delta(closure->m());
    std::deque<TimeInterval> waiting;  // in the order of time
    for (size_t piece = 0; piece < motion.pieces(); ++piece) { waiting.push_back({piece, 0.0, motion.length(piece)}); }
    for (size_t count = 0; !waiting.empty(); ++count) {
        const TimeInterval next = waiting.front();
        const double middle = 0.5 * (next.begin + next.end);
        const LoopVerdict verdict = interval.bound(motion, loops, next, positions, delta);
        if (verdict == LoopVerdict::broken || count > max_intervals) { return motion.knot(next.piece) + middle; }
        waiting.pop_front();
        if (verdict == LoopVerdict::closed) { continue; }
        waiting.push_front({next.piece, middle, next.end});
        waiting.push_front({next.piece, next.begin, middle});
    }
    return std::nullopt;
}

}  // namespace armctl
