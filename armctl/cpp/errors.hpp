// The errors of the core; the bindings turn each into the exception of the same name in armctl.core.errors.
#pragma once
#include <cstdint>
#include <stdexcept>
#include <string>

namespace armctl {

// An argument has a wrong shape, type or value. The message is one sentence, as in Python.
class InputError : public std::invalid_argument {
    using std::invalid_argument::invalid_argument;
};

// A number of the caller as an index below `count`.
inline size_t checked_index(std::int64_t number, size_t count, const char* what) {
    if (number < 0 || static_cast<size_t>(number) >= count) {
        throw InputError(std::string(what) + ": " + std::to_string(number) + " is not one of " + std::to_string(count));
    }
    return static_cast<size_t>(number);
}

}  // namespace armctl
