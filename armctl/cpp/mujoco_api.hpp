// What the core uses of MuJoCo: functions by their public symbols, the arrays of a simulation, its contacts, and calls that
// survive MuJoCo's errors.
#pragma once
#include <string>

#include "arguments.hpp"

namespace armctl {

// MuJoCo's mjModel, mjData and mjBatch, which the core only passes on.
struct MujocoModel;
struct MujocoData;
struct MujocoBatch;

// Where mjData keeps the geoms of its contacts, in bytes.
struct ContactLayout {
    size_t count = 0;   // offset of `ncon` in mjData
    size_t array = 0;   // offset of the pointer `contact` in mjData
    size_t stride = 0;  // size of an mjContact
    size_t geoms = 0;   // offset of `geom` in mjContact
};

// MuJoCo's functions, with the signatures of mujoco.h and mjbatch.h.
struct MujocoApi {
    // `empty` is for the batch in which functions are called; they work on other models. The arguments are the addresses of the
    // functions, and the `ContactLayout` as contact_count and so on.
    MujocoApi(const MujocoModel* empty, const Arguments& given);

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
    const MujocoModel* empty_model;
    ContactLayout contacts;
};

// A simulation and the arrays of its mjData. The owner of this struct keeps mjModel and mjData alive.
struct MujocoSimulation {
    const MujocoModel* model = nullptr;
    MujocoData* data = nullptr;
    Result qpos;
    Result qvel;
    Result ctrl;
    Vector qfrc_actuator;
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
    Contacts(const ContactLayout& layout, const MujocoData* data);

    size_t count() const { return count_; }

    // The geoms of a contact: `mjContact.geom`.
    std::array<std::int32_t, 2> geoms(size_t contact) const;

    // Whether one of them touches a geom.
    bool touch(std::int32_t geom) const;

private:
    const ContactLayout& layout_;
    const std::byte* first_;
    size_t count_;
};

// Calls a function so that an error of MuJoCo ends this call and not the process.
//
// MuJoCo leaves the function by longjmp, which runs no destructors. So while MuJoCo runs, the function and those that it called
// must not own memory or locks. It must not throw.
//
// Returns MuJoCo's message; empty if the function returned.
std::string guarded_call(const MujocoApi& api, MujocoApi::BatchFunction function, void* argument);

// The same for a callable object, such as a lambda that captures by reference.
template <class Work>
std::string guarded(const MujocoApi& api, Work& work) {
    const auto call = [](const MujocoModel*, MujocoData*, int, void* argument) { (*static_cast<Work*>(argument))(); };
    return guarded_call(api, call, &work);
}

}  // namespace armctl
