// Checks of a test program: what does not hold is printed, and the program ends with 1.
#pragma once
#include <cmath>
#include <cstdio>
#include <functional>
#include <source_location>
#include <string>
#include <string_view>

namespace checks {

inline int failures = 0;

inline void fail(const std::string& what, const std::source_location& place) {
    ++failures;
    std::printf("%s:%u: %s\n", place.file_name(), static_cast<unsigned>(place.line()), what.c_str());
}

inline void that(bool holds, const char* what, const std::source_location& place = std::source_location::current()) {
    if (!holds) { fail(what, place); }
}

inline void near(double value, double expected, double tolerance, const char* what,
                 const std::source_location& place = std::source_location::current()) {
    if (std::abs(value - expected) <= tolerance) { return; }
    fail(std::string(what) + ": " + std::to_string(value) + " instead of " + std::to_string(expected), place);
}

// That a call throws an error whose message begins with a text.
template <class Error>
void throws(const std::function<void()>& call, std::string_view begin,
            const std::source_location& place = std::source_location::current()) {
    try {
        call();
    } catch (const Error& error) {
        if (!std::string_view(error.what()).starts_with(begin)) { fail("another message: " + std::string(error.what()), place); }
        return;
    }
    fail("nothing is thrown: " + std::string(begin), place);
}

}  // namespace checks
