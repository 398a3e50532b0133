#include "chain.hpp"

#include <cmath>
#include <limits>
#include <numbers>

#include "errors.hpp"

namespace armctl {

namespace {

constexpr double INF = std::numeric_limits<double>::infinity();
constexpr double PI = std::numbers::pi;

Unknown make_unknown(Bounds bounds, double period) {
    const bool turns = period > 0;
    return {
        .bounds = bounds,
        .free_bounds = turns ? Bounds{-INF, INF} : bounds,
        .one_turn = turns ? Bounds{-PI, PI} : bounds,
        .period = period,
    };
}

}  // namespace

Chain::Chain(const ChainArrays& arrays) : reach_(arrays.reach) {
    const size_t k = arrays.slides.size();
    if (k == 0 || arrays.low.size() > k) { throw InputError("slides: expected at least one joint, and one for each unknown"); }
    for (size_t i = 0; i < arrays.low.size(); ++i) { unknowns_.push_back(make_unknown({arrays.low[i], arrays.high[i]}, arrays.period[i])); }
    for (size_t j = 0; j < k; ++j) {
        joints_.push_back({
            .placement = {Rotation::from_rows(arrays.rotations.row(j)), vec3(arrays.translations.row(j))},
            .slides = arrays.slides[j] != 0,
            .unknown = checked_index(arrays.unknowns[j], unknowns_.size(), "unknowns"),
            .ratio = arrays.ratios[j],
        });
    }
    tip_ = {Rotation::from_rows(arrays.rotations.row(k)), vec3(arrays.translations.row(k))};
}

Chain Chain::with_special_axes(const SpecialAxes& axes, Vector distances_to_points) const {
    const size_t k = joints_.size();
    checked_index(static_cast<std::int64_t>(axes.first) + 2, k, "first");
    for (const size_t other : axes.others) { checked_index(static_cast<std::int64_t>(other), k, "others"); }
    Chain chain = *this;
    chain.special_axes_ = axes;
    for (size_t j = 0; j < k; ++j) { chain.joints_[j].distance_to_point = distances_to_points[j]; }
    return chain;
}

bool Chain::contains(Vector q) const {
    for (size_t i = 0; i < unknowns_.size(); ++i) {
        if (!(unknowns_[i].bounds.low <= q[i] && q[i] <= unknowns_[i].bounds.high) || !std::isfinite(q[i])) { return false; }
    }
    return true;
}

Chain Chain::with_held(std::span<const std::int64_t> held, Vector positions) const {
    Chain chain = *this;
    for (size_t i = 0; i < held.size(); ++i) {
        chain.unknowns_[checked_index(held[i], n(), "held")] = make_unknown({positions[i], positions[i]}, 0.0);
    }
    return chain;
}

}  // namespace armctl
