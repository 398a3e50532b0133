#include "vectors.hpp"

namespace armctl {

Quaternion quaternion(const Rotation& R) {
    const double trace = R.x.x + R.y.y + R.z.z;
    Quaternion quat;
    if (trace >= R.x.x && trace >= R.y.y && trace >= R.z.z) {
        quat = {1.0 + trace, R.y.z - R.z.y, R.z.x - R.x.z, R.x.y - R.y.x};
    } else if (R.x.x >= R.y.y && R.x.x >= R.z.z) {
        quat = {R.y.z - R.z.y, 1.0 + R.x.x - R.y.y - R.z.z, R.x.y + R.y.x, R.x.z + R.z.x};
    } else if (R.y.y >= R.z.z) {
        quat = {R.z.x - R.x.z, R.y.x + R.x.y, 1.0 + R.y.y - R.z.z - R.x.x, R.y.z + R.z.y};
    } else {
        quat = {R.x.y - R.y.x, R.z.x + R.x.z, R.z.y + R.y.z, 1.0 + R.z.z - R.x.x - R.y.y};
    }
    double scale = 1.0 / std::sqrt(quat.w * quat.w + quat.x * quat.x + quat.y * quat.y + quat.z * quat.z);
    if (quat.w < 0.0) { scale = -scale; }
    return {quat.w * scale, quat.x * scale, quat.y * scale, quat.z * scale};
}

Vec3 rotation_vector(const Rotation& from, const Rotation& to) {
    const Quaternion turn = quaternion({to * from.row_x(), to * from.row_y(), to * from.row_z()});  // of to from^T
    const double sine = std::sqrt(turn.x * turn.x + turn.y * turn.y + turn.z * turn.z);
    const double scale = sine > 0.0 ? 2.0 * std::atan2(sine, turn.w) / sine : 2.0;
    return {scale * turn.x, scale * turn.y, scale * turn.z};
}

}  // namespace armctl
