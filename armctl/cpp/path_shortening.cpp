#include "path_shortening.hpp"

#include <algorithm>
#include <cmath>

namespace armctl {

namespace {

// Of the path's length: less is no gain.
constexpr double MIN_GAIN = 1e-3;
// In a row without a gain: then it stops.
constexpr int MAX_IDLE_SHORTCUTS = 25;

// A place on a path, and the number of its line.
struct Place {
    size_t line;
    Configuration q;
};

auto at(Path& path, size_t index) { return path.begin() + static_cast<std::ptrdiff_t>(index); }

double length(const Path& path) {
    double total = 0.0;
    for (size_t k = 0; k + 1 < path.size(); ++k) { total += joint_distance(path[k], path[k + 1]); }
    return total;
}

Place place_on(const Path& path, double distance) {
    size_t line = 0;
    double passed = 0.0;
    double line_length = joint_distance(path[0], path[1]);
    while (line + 2 < path.size() && passed + line_length <= distance) {
        passed += line_length;
        ++line;
        line_length = joint_distance(path[line], path[line + 1]);
    }
    const double share = line_length > 0.0 ? (distance - passed) / line_length : 0.0;
    Configuration q(path[line].size());
    for (size_t i = 0; i < q.size(); ++i) { q[i] = path[line][i] + share * (path[line + 1][i] - path[line][i]); }
    return {line, q};
}

}  // namespace

void drop_needless_points(FreeSpace& space, Path& path) {
    for (size_t point = 0; point + 2 < path.size(); ++point) {
        size_t farthest = path.size() - 1;
        while (farthest > point + 1 && !space.line_is_free(path[point], path[farthest])) { --farthest; }
        path.erase(at(path, point + 1), at(path, farthest));
    }
}

void take_shortcuts(FreeSpace& space, Path& path, Matrix places) {
    int idle = 0;
    for (size_t row = 0; row < places.rows && path.size() >= 3 && idle <= MAX_IDLE_SHORTCUTS; ++row) {
        const double total = length(path);
        const double low = std::min(places(row, 0), places(row, 1)) * total;
        const double high = std::max(places(row, 0), places(row, 1)) * total;
        const Place begin = place_on(path, low);
        const Place end = place_on(path, high);
        ++idle;
        if (begin.line == end.line || high - low - joint_distance(begin.q, end.q) < MIN_GAIN * total) { continue; }
        if (!space.line_is_free(begin.q, end.q)) { continue; }
        idle = 0;
        path.erase(at(path, begin.line + 1), at(path, end.line + 1));
        path.insert(at(path, begin.line + 1), {begin.q, end.q});
        size_t point = begin.line > 0 ? begin.line - 1 : 0;
        while (point < begin.line + 4 && point + 2 < path.size()) {
            if (space.line_is_free(path[point], path[point + 2])) {
                path.erase(at(path, point + 1));
            } else {
                ++point;
            }
        }
    }
}

}  // namespace armctl
