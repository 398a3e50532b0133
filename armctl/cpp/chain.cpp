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
    special_axes_ = arrays.special_axes;
    if (!special_axes_) { return; }
    for (const size_t joint : {special_axes_->first + 2, special_axes_->others[0], special_axes_->others[1], special_axes_->others[2]}) {
        checked_index(static_cast<std::int64_t>(joint), k, "special_axes");
    }
    for (size_t j = 0; j < k; ++j) { joints_[j].distance_to_point = arrays.distances_to_points[j]; }
}

bool Chain::contains(Vector q) const {
    for (size_t i = 0; i < unknowns_.size(); ++i) {
        if (!unknowns_[i].bounds.contain(q[i]) || !std::isfinite(q[i])) { return false; }
    }
    return true;
}

double wound(double position, double near, Bounds bounds, double period) {
    if (!(period > 0)) { return position; }
    position += period * std::nearbyint((near - position) / period);
    if (position > bounds.high) { position -= period * std::ceil((position - bounds.high) / period); }
    if (position < bounds.low) { position += period * std::ceil((bounds.low - position) / period); }
    return position;
}

}  // namespace armctl
