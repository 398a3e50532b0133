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

// Throws InputError unless an index of the caller is below `count`. One that was negative is shown as that.
inline void require_index(size_t index, size_t count, const char* what) {
    if (index < count) { return; }
    const auto number = static_cast<std::int64_t>(index);
    throw InputError(std::string(what) + ": " + std::to_string(number) + " is not one of " + std::to_string(count));
}

// A number of the caller as an index below `count`.
inline size_t checked_index(std::int64_t number, size_t count, const char* what) {
    require_index(static_cast<size_t>(number), count, what);
    return static_cast<size_t>(number);
}

// Throws InputError unless numbers, such as a gain for each joint, have a length.
template <class Numbers>
void require_size(const Numbers& numbers, size_t size, const char* name) {
    if (numbers.size() == size) { return; }
    throw InputError(std::string(name) + ": need an array of shape (" + std::to_string(size) + ",), got (" +
                     std::to_string(numbers.size()) + ",)");
}

}  // namespace armctl
