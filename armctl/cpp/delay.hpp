// Commands that reach the motors some ticks after they were given.
#pragma once
#include <algorithm>
#include <string>
#include <vector>

#include "errors.hpp"
#include "spans.hpp"

namespace armctl {

class Delay {
public:
    // A delay of at most max_ticks for n joints; it is 0 until `restart`.
    Delay(size_t n, size_t max_ticks) : n_(n), depth_(max_ticks + 1), commands_(depth_ * n) {}

    size_t joints() const { return n_; }

    // Forgets all commands, and delays those to come by some ticks. Throws InputError for more than max_ticks.
    void restart(size_t ticks) {
        if (ticks >= depth_) { throw InputError("ticks: need at most " + std::to_string(depth_ - 1) + ", got " + std::to_string(ticks)); }
        ticks_ = ticks;
        given_ = 0;
    }

    // Takes the command of this tick, (n,) N m. Returns that of `ticks` ago, or the first one until then; the numbers change in
    // the next call.
    Vector delayed(Vector tau) {
        std::ranges::copy(tau, command(given_ % depth_).begin());
        const size_t oldest = given_ > ticks_ ? given_ - ticks_ : 0;
        ++given_;
        return command(oldest % depth_);
    }

private:
    Result command(size_t index) { return Result(commands_).subspan(index * n_, n_); }

    size_t n_;
    size_t depth_;  // of the ring buffer
    std::vector<double> commands_;
    size_t ticks_ = 0;
    size_t given_ = 0;  // commands since the start
};

}  // namespace armctl
