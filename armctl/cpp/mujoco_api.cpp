#include "mujoco_api.hpp"

#include <array>
#include <cstring>
#include <memory>

#include "errors.hpp"

namespace armctl {

namespace {

// A number of MuJoCo's struct at an offset.
template <class Number>
Number number_at(const void* address, size_t offset) {
    Number number;
    std::memcpy(static_cast<void*>(&number), static_cast<const std::byte*>(address) + offset, sizeof(Number));
    return number;
}

using Batch = std::unique_ptr<MujocoBatch, void (*)(MujocoBatch*)>;

// A batch of MuJoCo with one simulation and no thread of its own.
Batch make_batch(const MujocoApi& api) {
    std::array<char, 500> error{};
    const MujocoApi::BatchConfig config{.threads = 1, .persistent = 0};
    Batch batch(api.make_batch(api.empty_model, 1, &config, error.data(), static_cast<int>(error.size())), api.delete_batch);
    if (!batch) { throw InputError("mujoco: " + std::string(error.data())); }
    return batch;
}

// A function, or a struct, from its address.
template <class Pointer>
void set(Pointer& pointer, const Arguments& given, const char* name) {
    pointer = reinterpret_cast<Pointer>(given.integer(name));  // NOLINT(performance-no-int-to-ptr): Python has it as a number
}

}  // namespace

MujocoApi::MujocoApi(const MujocoModel* empty, const Arguments& given)
    : empty_model(empty), contacts{
                              .count = given.count("contact_count"),
                              .array = given.count("contact_array"),
                              .stride = given.count("contact_stride"),
                              .geoms = given.count("contact_geoms"),
                          } {
    set(step, given, "step");
    set(rne_post_constraint, given, "rne_post_constraint");
    set(make_batch, given, "make_batch");
    set(delete_batch, given, "delete_batch");
    set(apply, given, "apply");
    set(error, given, "error");
}

Contacts::Contacts(const ContactLayout& layout, const MujocoData* data)
    : layout_(layout), first_(number_at<const std::byte*>(data, layout.array)),
      count_(static_cast<size_t>(number_at<std::int32_t>(data, layout.count))) {}

std::array<std::int32_t, 2> Contacts::geoms(size_t contact) const {
    return number_at<std::array<std::int32_t, 2>>(first_ + contact * layout_.stride, layout_.geoms);
}

bool Contacts::touch(std::int32_t geom) const {
    for (size_t k = 0; k < count_; ++k) {
        if (std::ranges::count(geoms(k), geom) > 0) { return true; }
    }
    return false;
}

std::string guarded_call(const MujocoApi& api, MujocoApi::BatchFunction function, void* argument) {
    // A batch makes one call at a time, so each thread has its own.
    thread_local const Batch batch = make_batch(api);
    const int failures = api.apply(batch.get(), nullptr, 0, function, argument, 0);
    return failures == 0 ? std::string() : std::string(api.error(batch.get(), 0));
}

}  // namespace armctl
