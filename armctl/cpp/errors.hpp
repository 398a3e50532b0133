// The errors of the core; the bindings turn each into the exception of the same name in armctl.core.errors.
#pragma once
#include <stdexcept>

namespace armctl {

// An argument has a wrong shape, type or value. The message is one sentence, as in Python.
class InputError : public std::invalid_argument {
    using std::invalid_argument::invalid_argument;
};

}  // namespace armctl
