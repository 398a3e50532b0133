// What the core uses of MuJoCo: functions by their public symbols, the arrays of a simulation, its contacts, and calls that
// survive MuJoCo's errors.
#pragma once
#include <algorithm>
#include <array>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include "errors.hpp"
#include "spans.hpp"

namespace armctl {

// MuJoCo's mjModel, mjData and mjBatch, which the core only passes on.
struct MujocoModel;
struct MujocoData;
struct MujocoBatch;

// Where mjData keeps its contacts, in bytes.
struct ContactLayout {
    size_t count = 0;    // offset of `ncon` in mjData
    size_t array = 0;    // offset of the pointer `contact` in mjData
    size_t stride = 0;   // size of an mjContact
    size_t geoms = 0;    // offset of `geom` in mjContact
    size_t exclude = 0;  // offset of `exclude` in mjContact
};

// Where mjData counts what MuJoCo repaired: `mjWarningStat.number` of mjWARN_BADQPOS, BADQVEL, BADQACC and BADCTRL, in bytes.
struct RepairLayout {
    size_t first = 0;   // offset of the first one in mjData
    size_t stride = 0;  // size of an mjWarningStat
};

// A number of MuJoCo's struct at an offset.
template <class Number>
Number number_at(const void* address, size_t offset) {
    Number number;
    std::memcpy(static_cast<void*>(&number), static_cast<const std::byte*>(address) + offset, sizeof(Number));
    return number;
}

// Whether MuJoCo found a position, velocity, acceleration or control that is NaN or huge since its last reset by the caller. It then
// resets the simulation by itself, or sets all controls to zero.
inline bool has_repaired(const RepairLayout& layout, const MujocoData* data) {
    constexpr size_t kinds = 4;
    for (size_t k = 0; k < kinds; ++k) {
        if (number_at<std::int32_t>(data, layout.first + k * layout.stride) != 0) { return true; }
    }
    return false;
}

// MuJoCo's functions, with the signatures of mujoco.h and mjbatch.h.
struct MujocoApi {
    using Step = void (*)(const MujocoModel*, MujocoData*);
    using BatchFunction = void (*)(const MujocoModel*, MujocoData*, int simulation, void* argument);

    // mjBatchConfig.
    struct BatchConfig {
        int threads;
        std::uint8_t persistent;
    };

    Step step = nullptr;                 // mj_step
    Step rne_post_constraint = nullptr;  // mj_rnePostConstraint
    MujocoBatch* (*make_batch)(const MujocoModel*, int simulations, const BatchConfig*, char* error, int error_size) = nullptr;
    void (*delete_batch)(MujocoBatch*) = nullptr;
    int (*apply)(MujocoBatch*, const int* ids, int id_count, BatchFunction, void* argument, int save) = nullptr;  // mjb_apply
    const char* (*error)(const MujocoBatch*, int simulation) = nullptr;                                           // mjb_error
    const MujocoModel* empty_model = nullptr;  // for the batch in which functions are called; they work on other models
    ContactLayout contacts;
    RepairLayout repairs;
};

// A simulation and the arrays of its mjData. The owner of this struct keeps mjModel and mjData alive.
struct MujocoSimulation {
    const MujocoModel* model = nullptr;
    MujocoData* data = nullptr;
    Result qpos;
    Result qvel;
    Result ctrl;
    Vector actuator_force;
    Result qfrc_applied;
    Vector actuator_length;
    // (bodies, ...)
    Matrix xfrc_applied;  // 6
    Matrix cfrc_ext;      // 6: torque, force
    Matrix xpos;          // 3
    Matrix xmat;          // 9
    Matrix subtree_com;   // 3
};

// The contacts of a simulation after its last step.
class Contacts {
public:
    Contacts(const ContactLayout& layout, const MujocoData* data)
        : layout_(layout), first_(number_at<const std::byte*>(data, layout.array)),
          count_(static_cast<size_t>(number_at<std::int32_t>(data, layout.count))) {}

    size_t count() const { return count_; }

    // The geoms of a contact: `mjContact.geom`.
    std::array<std::int32_t, 2> geoms(size_t contact) const {
        return number_at<std::array<std::int32_t, 2>>(first_ + contact * layout_.stride, layout_.geoms);
    }

    // Whether geoms touch in a contact: MuJoCo lists those that are within the gap of a geom, too, and gives them no force.
    bool touches(size_t contact) const { return number_at<std::int32_t>(first_ + contact * layout_.stride, layout_.exclude) == 0; }

    // Whether one of them touches a geom.
    bool touch(std::int32_t geom) const {
        for (size_t k = 0; k < count_; ++k) {
            if (touches(k) && std::ranges::count(geoms(k), geom) > 0) { return true; }
        }
        return false;
    }

private:
    const ContactLayout& layout_;
    const std::byte* first_;
    size_t count_;
};

using Batch = std::unique_ptr<MujocoBatch, void (*)(MujocoBatch*)>;

// A batch of MuJoCo with one simulation and no thread of its own.
inline Batch make_batch(const MujocoApi& api) {
    std::array<char, 500> error{};
    const MujocoApi::BatchConfig config{.threads = 1, .persistent = 0};
    Batch batch(api.make_batch(api.empty_model, 1, &config, error.data(), static_cast<int>(error.size())), api.delete_batch);
    if (!batch) { throw InputError("mujoco: " + std::string(error.data())); }
    return batch;
}

// The batches of a thread. A batch makes one call at a time, so each call within another one has its own: a law in Python may run a
// simulation.
struct ThreadBatches {
    std::vector<Batch> batches;
    size_t used = 0;

    MujocoBatch* next(const MujocoApi& api) {
        if (used == batches.size()) { batches.push_back(make_batch(api)); }
        return batches[used].get();
    }
};

inline ThreadBatches& batches_of_thread() {
    thread_local ThreadBatches batches;
    return batches;
}

// Calls an object, such as a lambda that captures by reference, so that an error of MuJoCo ends this call and not the process.
//
// MuJoCo leaves the call by longjmp, which runs no destructors. So while MuJoCo runs, the object and the functions that it called
// must not own memory or locks. It must not throw.
//
// Returns MuJoCo's message; empty if the object returned.
template <class Work>
[[nodiscard]] std::string guarded(const MujocoApi& api, Work& work) {
    const auto call = [](const MujocoModel*, MujocoData*, int, void* argument) { (*static_cast<Work*>(argument))(); };
    ThreadBatches& batches = batches_of_thread();
    MujocoBatch* batch = batches.next(api);
    ++batches.used;
    const int failures = api.apply(batch, nullptr, 0, call, &work, 0);
    --batches.used;
    return failures == 0 ? std::string() : std::string(api.error(batch, 0));
}

}  // namespace armctl
