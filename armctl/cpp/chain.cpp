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

AxesRelation relation_of(const Arguments& arguments, const char* name) {
    return static_cast<AxesRelation>(checked_index(arguments.integer(name), 3, name));
}

}  // namespace

Chain::Chain(const Arguments& arguments) : reach_(arguments.number("reach")) {
    const size_t k = arguments.length("slides");
    const size_t n = arguments.length("low");
    if (k == 0 || n > k) { throw InputError("slides: expected at least one joint, and one for each unknown"); }
    const Vector low = arguments.vector(n, "low");
    const Vector high = arguments.vector(n, "high");
    const Vector period = arguments.vector(n, "period");
    for (size_t i = 0; i < n; ++i) { unknowns_.push_back(make_unknown({low[i], high[i]}, period[i])); }
    const Integers slides = arguments.integers(k, "slides");
    const Integers unknowns = arguments.integers(k, "unknowns");
    const Vector ratios = arguments.vector(k, "ratios");
    // Of each joint, and of the tip, in the frame before.
    const Matrix rotations{arguments.shaped({k + 1, 3, 3}, "rotations").data(), k + 1, 9};
    const Matrix translations = arguments.matrix(k + 1, 3, "translations");
    const auto placement = [&](size_t j) { return Pose{Rotation::from_rows(rotations.row(j)), vec3(translations.row(j))}; };
    for (size_t j = 0; j < k; ++j) {
        joints_.push_back({placement(j), slides[j] != 0, checked_index(unknowns[j], n, "unknowns"), ratios[j]});
    }
    tip_ = placement(k);
    if (!arguments.has("relation")) { return; }
    const auto joint = [k](std::int64_t number) { return checked_index(number, k, "others"); };
    const Integers others = arguments.integers(3, "others");
    special_axes_ = SpecialAxes{
        .relation = relation_of(arguments, "relation"),
        .first = checked_index(arguments.integer("first") + 2, k, "first") - 2,
        .others = {joint(others[0]), joint(others[1]), joint(others[2])},
        .pair_relation = relation_of(arguments, "pair_relation"),
        .pair_first = arguments.count("pair_first"),
    };
    const Vector distances = arguments.vector(k, "distances_to_points");
    for (size_t j = 0; j < k; ++j) { joints_[j].distance_to_point = distances[j]; }
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
