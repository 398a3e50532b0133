"""Distances between convex geoms and proofs of clearance over whole motions, as scalar loops for numba.

The kernels are in one file (hence its length) because they share these rows and the layout of the scratch memory.

The world is described by packed rows (a tuple of many small arrays is 80 times slower in numba):

- `tree` (F, 11): one row for each joint that moves. Frame i + 1 belongs to row i; frame 0 is the world. Every frame maps the
  world at the reference configuration to the world now.
- `geoms` (G + groups, 41): the shape, frame and bounding sphere of each geom; behind them one bounding sphere for each group of
  geoms.
- `points` (P, 5), `neighbors`: vertices at the reference configuration, and the neighbors of the vertices of large hulls.
- `pairs` (K, 9): pairs that may meet, with the direction and the vertices found by the last query, which start the next one.
- `groups` (Q, 4): groups a and b, and the range of their pairs.
- `frames` (F + 1, 18), `spheres` (G + groups, 5 + depth), `work` (16, 3): memory of one thread, overwritten by every query.

GJK: E. G. Gilbert, D. W. Johnson, S. S. Keerthi, "A fast procedure for computing the distance between complex objects in
three-dimensional space", IEEE J. Robotics and Automation 4 (1988). For any direction v, v.w / |v| is a lower bound of the
distance, where w is the support point of the difference of the two shapes; it does not rely on convergence, so every proof here
rests on it.
"""

import math

from armctl.core.jit import njit

# Columns of `tree`
AXIS = 0  # (3,) world axis of the joint at the reference configuration
ANCHOR = 3  # (3,) a point on it
KIND = 6
REFERENCE = 7  # joint position of the reference configuration
PARENT = 8  # frame
JOINT = 9  # index of the joint position
DEPTH = 10  # frames above it, the world included
TREE_COLUMNS = 11
HINGE = 0
SLIDE = 1

# Columns of `geoms`
CENTER = 0  # (3,) of the bounding sphere
BOUND = 3  # its radius
RADIUS = 4  # by which the shape is inflated: the radius of a sphere or capsule
SHAPE = 5
FRAME = 6
FIRST = 7  # row of `points`
LAST = 8
INFO = 9  # (16,) of planes, cylinders and ellipsoids
IS_BOX = 25
BOX = 26  # center (3,), inverse rotation by rows (9,), half sizes (3,)
GEOM_COLUMNS = 41
POINTS = 0  # the convex hull of some points, inflated
CYLINDER = 1  # INFO: axis (3,), radius, half length
ELLIPSOID = 2  # INFO: rotation times half sizes, by rows (9,)
PLANE = 3  # INFO: normal (3,), offset. A plane stands still; it is always the first geom of a pair

# Columns of `pairs`
A = 0
B = 1
DIRECTION = 2  # (3,) in the frame of a
VERTEX_A = 5
VERTEX_B = 6
COMMON = 7  # the last frame above both
COMMON_DEPTH = 8
PAIR_COLUMNS = 9

# Columns of `spheres`
IS_KNOWN = 3  # whether the motion bounds behind it are computed
MOTION = 4  # by the depth of an ancestor: bound of the motion relative to it

# Columns of `intervals`
BEGIN = 0  # s
END = 1
PIECE = 2  # the pieces of the motion that it spans
LAST_PIECE = 3
OPEN = 4  # the range of its open pairs, -1 for all
LAST_OPEN = 5
TILT_IS_OPEN = 6  # 1 where it is not settled that the axis keeps its direction
INTERVAL_COLUMNS = 7

# Elements of `keep`
KEEP_FRAME = 0  # of the axis that keeps its direction; negative if none does
KEEP_AXIS = 1  # (3,) of the world at the reference configuration
KEEP_DIRECTION = 4  # (3,) of the world
KEEP_WITHIN = 7  # rad
KEEP_SIZE = 8
TILT_MIN_RAD = 1e-4  # an interval in which the axis turns by less is not split again: it then counts as tilted

# Rows of `work`
FOUND = 4
FACE = 5
KEPT = 8
LAST_HIT = 11  # its first element: the pair that was not free last time
RELATIVE = 12  # four rows: the second geom's frame as the first one sees it
WORK_ROWS = 16

LARGE_HULL = 24  # vertices; larger hulls are searched by hill climbing
MOTION_MIN_M = 1e-4  # an interval in which no point moves farther is not split again: the pair then counts as not free
MOTION_MIN_SHARE = 0.25  # of the clearance, where that is less: a line may end where something is hardly farther away
COARSE = 0.8  # of the size of the moving geom: while the motion is larger, a distance would not settle the pair
PAIR = 0  # columns of what `near_pairs` finds
DISTANCE = 1
GRADIENT = 2  # (joints,)
TRACE_COLUMNS = 6  # of the steps of GJK: the difference of two support points (3,), and that of the first geom (3,)
MAX_GJK_STEPS = 60
_WITNESS_GAP = 1e-10  # relative: the direction of a distance is less accurate than the distance
_PARTED_M = 1e-3  # between geoms that are displaced until they are apart
_MAX_DEPTH_STEPS = 20
_DEPTH_GAP_M = 1e-9
_GJK_RELATIVE_GAP = 1e-9
_GJK_GAP_M = 1e-7
_SETTLED_M = 1e-7  # a bound that is so near to the clearance is taken for it
_INFINITE = 1e300


@njit
def locate_frames(q, tree, frames):
    """Writes the transform of every frame, and the anchor and axis of its joint in the world."""
    for k in range(12):
        frames[0, k] = 0.0
    frames[0, 0] = 1.0
    frames[0, 4] = 1.0
    frames[0, 8] = 1.0
    for row in range(len(tree)):
        joint = tree[row]
        parent = frames[int(joint[PARENT])]
        frame = frames[row + 1]
        kind = int(joint[KIND])
        _transform(parent, joint[ANCHOR], joint[ANCHOR + 1], joint[ANCHOR + 2], frame, 12)
        _rotate(parent, joint[AXIS], joint[AXIS + 1], joint[AXIS + 2], frame, 15)
        displacement = q[int(joint[JOINT])] - joint[REFERENCE]
        if kind == SLIDE:
            for k in range(9):
                frame[k] = parent[k]
            for k in range(3):
                frame[9 + k] = parent[9 + k] + frame[15 + k] * displacement
        else:
            _turn(parent, joint, displacement, frame)


@njit
def _rotate(frame, x, y, z, out, at):
    out[at] = frame[0] * x + frame[1] * y + frame[2] * z
    out[at + 1] = frame[3] * x + frame[4] * y + frame[5] * z
    out[at + 2] = frame[6] * x + frame[7] * y + frame[8] * z


@njit
def _transform(frame, x, y, z, out, at):
    out[at] = frame[0] * x + frame[1] * y + frame[2] * z + frame[9]
    out[at + 1] = frame[3] * x + frame[4] * y + frame[5] * z + frame[10]
    out[at + 2] = frame[6] * x + frame[7] * y + frame[8] * z + frame[11]


@njit
def _turn(parent, joint, angle, out):
    """out = parent @ (rotation by an angle about the axis through the anchor), by Rodrigues' formula."""
    x = joint[AXIS]
    y = joint[AXIS + 1]
    z = joint[AXIS + 2]
    sine = math.sin(angle)
    cosine = math.cos(angle)
    u = 1.0 - cosine
    r00 = cosine + x * x * u
    r01 = x * y * u - z * sine
    r02 = x * z * u + y * sine
    r10 = y * x * u + z * sine
    r11 = cosine + y * y * u
    r12 = y * z * u - x * sine
    r20 = z * x * u - y * sine
    r21 = z * y * u + x * sine
    r22 = cosine + z * z * u
    ox = joint[ANCHOR]
    oy = joint[ANCHOR + 1]
    oz = joint[ANCHOR + 2]
    tx = ox - (r00 * ox + r01 * oy + r02 * oz)
    ty = oy - (r10 * ox + r11 * oy + r12 * oz)
    tz = oz - (r20 * ox + r21 * oy + r22 * oz)
    for i in range(3):
        a = parent[3 * i]
        b = parent[3 * i + 1]
        c = parent[3 * i + 2]
        out[3 * i] = a * r00 + b * r10 + c * r20
        out[3 * i + 1] = a * r01 + b * r11 + c * r21
        out[3 * i + 2] = a * r02 + b * r12 + c * r22
        out[9 + i] = a * tx + b * ty + c * tz + parent[9 + i]


@njit
def place(q, geoms, tree, frames, spheres):
    """Places all frames and bounding spheres at a configuration."""
    locate_frames(q, tree, frames)
    for g in range(len(geoms)):
        geom = geoms[g]
        _transform(frames[int(geom[FRAME])], geom[CENTER], geom[CENTER + 1], geom[CENTER + 2], spheres[g], 0)
        spheres[g, IS_KNOWN] = 0.0


@njit
def _bound_motions(b, delta, geoms, tree, frames, spheres):
    """Bounds the motion of a geom relative to each of its ancestors while joint j moves by at most delta[j].

    Change the joints from the base outward: joint j then turns the geom about its axis at the center of the interval, and a
    point at the distance r from the axis moves by at most delta[j] r.
    """
    sphere = spheres[b]
    sphere[IS_KNOWN] = 1.0
    bound = geoms[b, BOUND]
    frame = int(geoms[b, FRAME])
    total = 0.0
    while frame > 0:
        joint = tree[frame - 1]
        sphere[MOTION + int(joint[DEPTH])] = total
        step = delta[int(joint[JOINT])]
        if int(joint[KIND]) == SLIDE:
            total += step
        elif step > 0.0:
            located = frames[frame]
            x = sphere[0] - located[12]
            y = sphere[1] - located[13]
            z = sphere[2] - located[14]
            u = y * located[17] - z * located[16]
            v = z * located[15] - x * located[17]
            w = x * located[16] - y * located[15]
            total += step * (math.sqrt(u * u + v * v + w * w) + bound)
        frame = int(joint[PARENT])
    sphere[MOTION] = total


@njit
def _relative_motion(a, b, common_depth, delta, geoms, tree, frames, spheres):
    """Bounds how far any point of one geom moves as the other sees it."""
    if spheres[b, IS_KNOWN] == 0.0:
        _bound_motions(b, delta, geoms, tree, frames, spheres)
    if spheres[a, IS_KNOWN] == 0.0:
        _bound_motions(a, delta, geoms, tree, frames, spheres)
    return spheres[a, MOTION + common_depth] + spheres[b, MOTION + common_depth]


@njit
def _motion_along(g, common, nx, ny, nz, delta, geoms, tree, frames, spheres):
    """Bounds the motion of a geom along a direction of the world, relative to an ancestor: to first order, and a remainder.

    Joint j moves a point x along n by at most delta r, and by delta |n . (w x (x - o))| + delta r (turns before it + delta /
    2): the turns of the joints nearer to the base tilt the direction, and the arc leaves its tangent.
    """
    bound = geoms[g, BOUND]
    sphere = spheres[g]
    frame = int(geoms[g, FRAME])
    total = 0.0
    turns = 0.0  # of the hinges nearer to the base than the joint in hand; the walk goes from the geom to the base
    walk = frame
    while walk != common:
        joint = tree[walk - 1]
        if int(joint[KIND]) == HINGE:
            turns += delta[int(joint[JOINT])]
        walk = int(joint[PARENT])
    walk = frame
    while walk != common:
        joint = tree[walk - 1]
        step = delta[int(joint[JOINT])]
        if step > 0.0:
            located = frames[walk]
            along_axis = located[15] * nx + located[16] * ny + located[17] * nz
            if int(joint[KIND]) == SLIDE:
                total += step * min(1.0, abs(along_axis) + turns)
            else:
                turns -= step
                x = sphere[0] - located[12]
                y = sphere[1] - located[13]
                z = sphere[2] - located[14]
                u = located[16] * z - located[17] * y
                v = located[17] * x - located[15] * z
                w = located[15] * y - located[16] * x
                radius = math.sqrt(u * u + v * v + w * w) + bound
                tangential = abs(nx * u + ny * v + nz * w) + bound * math.sqrt(max(0.0, 1.0 - along_axis * along_axis))
                total += step * min(radius, tangential + radius * (turns + 0.5 * step))
        walk = int(joint[PARENT])
    return total


@njit
def _support(first, last, x, y, z, start, points, neighbors):
    """The row of the point that is farthest in a direction; climbs over the edges of large hulls."""
    if last - first <= LARGE_HULL:
        best = first
        most = points[first, 0] * x + points[first, 1] * y + points[first, 2] * z
        for i in range(first + 1, last):
            value = points[i, 0] * x + points[i, 1] * y + points[i, 2] * z
            if value > most:
                most = value
                best = i
        return best
    best = start if first <= start < last else first
    most = points[best, 0] * x + points[best, 1] * y + points[best, 2] * z
    while True:
        current = best
        for edge in range(int(points[current, 3]), int(points[current, 4])):
            i = neighbors[edge]
            value = points[i, 0] * x + points[i, 1] * y + points[i, 2] * z
            if value > most:
                most = value
                best = i
        if best == current:
            return best


@njit
def _round_support(geom, x, y, z, points):
    """The point of a cylinder or an ellipsoid that is farthest in a direction."""
    center = points[int(geom[FIRST])]
    if int(geom[SHAPE]) == CYLINDER:
        ax = geom[INFO]
        ay = geom[INFO + 1]
        az = geom[INFO + 2]
        along = x * ax + y * ay + z * az
        half = geom[INFO + 4] if along > 0.0 else -geom[INFO + 4]
        u = x - along * ax
        v = y - along * ay
        w = z - along * az
        length = math.sqrt(u * u + v * v + w * w)
        scale = geom[INFO + 3] / length if length > 1e-12 else 0.0
        return center[0] + half * ax + scale * u, center[1] + half * ay + scale * v, center[2] + half * az + scale * w
    u = geom[INFO] * x + geom[INFO + 3] * y + geom[INFO + 6] * z
    v = geom[INFO + 1] * x + geom[INFO + 4] * y + geom[INFO + 7] * z
    w = geom[INFO + 2] * x + geom[INFO + 5] * y + geom[INFO + 8] * z
    length = math.sqrt(u * u + v * v + w * w)
    scale = 1.0 / length if length > 1e-12 else 0.0
    return (
        center[0] + scale * (geom[INFO] * u + geom[INFO + 1] * v + geom[INFO + 2] * w),
        center[1] + scale * (geom[INFO + 3] * u + geom[INFO + 4] * v + geom[INFO + 5] * w),
        center[2] + scale * (geom[INFO + 6] * u + geom[INFO + 7] * v + geom[INFO + 8] * w),
    )


@njit
def _closest_to_origin(simplex, count, out, face, kept):
    """Writes the point of a simplex closest to the origin; keeps the vertices of its face. Returns 5 for an origin inside."""
    if count == 1:
        for k in range(3):
            out[k] = simplex[0, k]
        return 1
    if count == 2:
        return _closest_on_segment(simplex, out)
    if count == 3:
        return _closest_on_triangle(simplex, out)
    nearest = _INFINITE
    size = 0
    nearest_x = 0.0
    nearest_y = 0.0
    nearest_z = 0.0
    is_inside = True
    for opposite in range(4):
        i = 1 if opposite == 0 else 0
        j = 2 if opposite < 2 else 1
        k = 3 if opposite < 3 else 2
        ux = simplex[j, 0] - simplex[i, 0]
        uy = simplex[j, 1] - simplex[i, 1]
        uz = simplex[j, 2] - simplex[i, 2]
        vx = simplex[k, 0] - simplex[i, 0]
        vy = simplex[k, 1] - simplex[i, 1]
        vz = simplex[k, 2] - simplex[i, 2]
        nx = uy * vz - uz * vy
        ny = uz * vx - ux * vz
        nz = ux * vy - uy * vx
        side = (
            nx * (simplex[opposite, 0] - simplex[i, 0])
            + ny * (simplex[opposite, 1] - simplex[i, 1])
            + nz * (simplex[opposite, 2] - simplex[i, 2])
        )
        origin_side = -(nx * simplex[i, 0] + ny * simplex[i, 1] + nz * simplex[i, 2])
        if origin_side * side < 0.0 or side == 0.0:  # this face sees the origin, or the simplex is flat
            is_inside = False
            for c in range(3):
                face[0, c] = simplex[i, c]
                face[1, c] = simplex[j, c]
                face[2, c] = simplex[k, c]
            vertices = _closest_on_triangle(face, out)
            square = out[0] * out[0] + out[1] * out[1] + out[2] * out[2]
            if square < nearest:
                nearest = square
                size = vertices
                nearest_x = out[0]
                nearest_y = out[1]
                nearest_z = out[2]
                for r in range(3):
                    for c in range(3):
                        kept[r, c] = face[r, c]
    if is_inside:
        return 5
    for r in range(size):
        for c in range(3):
            simplex[r, c] = kept[r, c]
    out[0] = nearest_x
    out[1] = nearest_y
    out[2] = nearest_z
    return size


@njit
def _closest_on_segment(simplex, out):
    ux = simplex[1, 0] - simplex[0, 0]
    uy = simplex[1, 1] - simplex[0, 1]
    uz = simplex[1, 2] - simplex[0, 2]
    t = -(simplex[0, 0] * ux + simplex[0, 1] * uy + simplex[0, 2] * uz)
    square = ux * ux + uy * uy + uz * uz
    if t <= 0.0:
        return _keep_vertex(simplex, 0, out)
    if t >= square:
        return _keep_vertex(simplex, 1, out)
    t /= square
    out[0] = simplex[0, 0] + t * ux
    out[1] = simplex[0, 1] + t * uy
    out[2] = simplex[0, 2] + t * uz
    return 2


@njit
def _closest_on_triangle(simplex, out):
    """By the regions of C. Ericson, Real-Time Collision Detection (2005), section 5.1.5."""
    ax = simplex[0, 0]
    ay = simplex[0, 1]
    az = simplex[0, 2]
    ux = simplex[1, 0] - ax
    uy = simplex[1, 1] - ay
    uz = simplex[1, 2] - az
    vx = simplex[2, 0] - ax
    vy = simplex[2, 1] - ay
    vz = simplex[2, 2] - az
    d1 = -(ux * ax + uy * ay + uz * az)
    d2 = -(vx * ax + vy * ay + vz * az)
    if d1 <= 0.0 and d2 <= 0.0:
        return _keep_vertex(simplex, 0, out)
    d3 = -(ux * simplex[1, 0] + uy * simplex[1, 1] + uz * simplex[1, 2])
    d4 = -(vx * simplex[1, 0] + vy * simplex[1, 1] + vz * simplex[1, 2])
    if d3 >= 0.0 and d4 <= d3:
        return _keep_vertex(simplex, 1, out)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _keep_edge(simplex, 0, 1, d1 / (d1 - d3), out)
    d5 = -(ux * simplex[2, 0] + uy * simplex[2, 1] + uz * simplex[2, 2])
    d6 = -(vx * simplex[2, 0] + vy * simplex[2, 1] + vz * simplex[2, 2])
    if d6 >= 0.0 and d5 <= d6:
        return _keep_vertex(simplex, 2, out)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return _keep_edge(simplex, 0, 2, d2 / (d2 - d6), out)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return _keep_edge(simplex, 1, 2, (d4 - d3) / ((d4 - d3) + (d5 - d6)), out)
    scale = 1.0 / (va + vb + vc)
    v = vb * scale
    w = vc * scale
    out[0] = ax + ux * v + vx * w
    out[1] = ay + uy * v + vy * w
    out[2] = az + uz * v + vz * w
    return 3


@njit
def _keep_vertex(simplex, i, out):
    for k in range(3):
        out[k] = simplex[i, k]
        simplex[0, k] = out[k]
    return 1


@njit
def _keep_edge(simplex, i, j, t, out):
    for k in range(3):
        start = simplex[i, k]
        end = simplex[j, k]
        out[k] = start + t * (end - start)
        simplex[0, k] = start
        simplex[1, k] = end
    return 2


@njit
def _support_point(p, side, x, y, z, geoms, points, neighbors, pairs):
    """The farthest point of one geom of a pair in a direction of its own frame; remembers the vertex for the next query."""
    geom = geoms[int(pairs[p, side])]
    if int(geom[SHAPE]) != POINTS:
        return _round_support(geom, x, y, z, points)
    column = VERTEX_A + side
    i = _support(int(geom[FIRST]), int(geom[LAST]), x, y, z, int(pairs[p, column]), points, neighbors)
    pairs[p, column] = i
    return points[i, 0], points[i, 1], points[i, 2]


@njit
def _plane_distance(p, geoms, points, neighbors, pairs, frames):
    plane = geoms[int(pairs[p, A])]
    other = geoms[int(pairs[p, B])]
    frame = frames[int(other[FRAME])]
    nx = plane[INFO]
    ny = plane[INFO + 1]
    nz = plane[INFO + 2]
    x, y, z = _rotated_back(frame, -nx, -ny, -nz)
    px, py, pz = _support_point(p, B, x, y, z, geoms, points, neighbors, pairs)
    height = -(x * px + y * py + z * pz) + nx * frame[9] + ny * frame[10] + nz * frame[11]
    return height - plane[INFO + 3] - other[RADIUS]


@njit
def _rotated_back(frame, x, y, z):
    """A direction of the world in a frame."""
    return (
        frame[0] * x + frame[3] * y + frame[6] * z,
        frame[1] * x + frame[4] * y + frame[7] * z,
        frame[2] * x + frame[5] * y + frame[8] * z,
    )


@njit
def _relate(first, second, out):
    """Writes the second frame as seen from the first: rotation by rows, and translation."""
    for i in range(3):
        for j in range(3):
            out[i, j] = first[i] * second[j] + first[3 + i] * second[3 + j] + first[6 + i] * second[6 + j]
    x = second[9] - first[9]
    y = second[10] - first[10]
    z = second[11] - first[11]
    out[3, 0], out[3, 1], out[3, 2] = _rotated_back(first, x, y, z)


@njit
def _first_direction(p, geoms, pairs, frames, spheres):
    """The direction that the last query found, or else from center to center, in the frame of the first geom."""
    x = pairs[p, DIRECTION]
    y = pairs[p, DIRECTION + 1]
    z = pairs[p, DIRECTION + 2]
    if x * x + y * y + z * z > 1e-20:
        return x, y, z
    a = int(pairs[p, A])
    b = int(pairs[p, B])
    u = spheres[a, 0] - spheres[b, 0]
    v = spheres[a, 1] - spheres[b, 1]
    w = spheres[a, 2] - spheres[b, 2]
    if u * u + v * v + w * w < 1e-20:
        return 1.0, 0.0, 0.0
    return _rotated_back(frames[int(geoms[a, FRAME])], u, v, w)


@njit
def distance(p, enough, touching, is_exact, geoms, points, neighbors, pairs, frames, spheres, work):
    """Bounds of the distance of a pair, (lower, upper), by GJK in the frame of its first geom.

    It stops as soon as the lower bound reaches `enough`, the upper one falls to `touching`, or, unless it should be exact, the
    distance is known to be between the two. Lower bounds are rigorous; an upper bound at or below zero means overlap.
    """
    first = geoms[int(pairs[p, A])]
    second = geoms[int(pairs[p, B])]
    if int(first[SHAPE]) == PLANE:
        height = _plane_distance(p, geoms, points, neighbors, pairs, frames)
        return height, height
    relative = work[RELATIVE:]
    _relate(frames[int(first[FRAME])], frames[int(second[FRAME])], relative)
    radii = first[RADIUS] + second[RADIUS]
    vx, vy, vz = _first_direction(p, geoms, pairs, frames, spheres)
    lower = -_INFINITE
    upper = _INFINITE
    count = 0
    for _ in range(MAX_GJK_STEPS):
        square = vx * vx + vy * vy + vz * vz
        length = math.sqrt(square)
        wx, wy, wz = _difference_support(p, vx, vy, vz, relative, geoms, points, neighbors, pairs)
        projection = vx * wx + vy * wy + vz * wz
        if projection / length - radii > lower:
            lower = projection / length - radii
            pairs[p, DIRECTION] = vx
            pairs[p, DIRECTION + 1] = vy
            pairs[p, DIRECTION + 2] = vz
            if lower >= enough:
                return lower, upper
        if count > 0:
            upper = min(upper, length - radii)
            is_decided = upper <= touching or (not is_exact and lower > touching and upper < enough)
            if is_decided or square - projection <= _GJK_RELATIVE_GAP * square or upper - lower < _GJK_GAP_M:
                return lower, upper
        for k in range(count):
            if _squared_distance(work[k], wx, wy, wz) < 1e-22:  # no progress
                return lower, min(upper, length - radii)
        work[count, 0] = wx
        work[count, 1] = wy
        work[count, 2] = wz
        count = _closest_to_origin(work, count + 1, work[FOUND], work[FACE:KEPT], work[KEPT:LAST_HIT])
        vx = work[FOUND, 0]
        vy = work[FOUND, 1]
        vz = work[FOUND, 2]
        if count == 5 or vx * vx + vy * vy + vz * vz < 1e-18:  # the hulls overlap, not only their inflated shapes
            return lower, min(-radii, -1e-12)
    return lower, upper


@njit
def _squared_distance(point, x, y, z):
    u = point[0] - x
    v = point[1] - y
    w = point[2] - z
    return u * u + v * v + w * w


@njit
def _difference_support(p, vx, vy, vz, relative, geoms, points, neighbors, pairs):
    """The support point of the difference of both geoms against a direction, in the frame of the first."""
    ax, ay, az = _support_point(p, A, -vx, -vy, -vz, geoms, points, neighbors, pairs)
    x = relative[0, 0] * vx + relative[1, 0] * vy + relative[2, 0] * vz
    y = relative[0, 1] * vx + relative[1, 1] * vy + relative[2, 1] * vz
    z = relative[0, 2] * vx + relative[1, 2] * vy + relative[2, 2] * vz
    bx, by, bz = _support_point(p, B, x, y, z, geoms, points, neighbors, pairs)
    return (
        ax - (relative[0, 0] * bx + relative[0, 1] * by + relative[0, 2] * bz + relative[3, 0]),
        ay - (relative[1, 0] * bx + relative[1, 1] * by + relative[1, 2] * bz + relative[3, 1]),
        az - (relative[2, 0] * bx + relative[2, 1] * by + relative[2, 2] * bz + relative[3, 2]),
    )


@njit
def _gap(a, b, geoms, spheres):
    """A lower bound of the distance of two geoms or groups, from their bounding spheres, a standing box or a plane."""
    first = geoms[a]
    sphere = spheres[b]
    bound = geoms[b, BOUND]
    if int(first[SHAPE]) == PLANE:
        return first[INFO] * sphere[0] + first[INFO + 1] * sphere[1] + first[INFO + 2] * sphere[2] - first[INFO + 3] - bound
    if first[IS_BOX] > 0.0 and int(first[FRAME]) == 0:
        x = sphere[0] - first[BOX]
        y = sphere[1] - first[BOX + 1]
        z = sphere[2] - first[BOX + 2]
        u = max(abs(first[BOX + 3] * x + first[BOX + 4] * y + first[BOX + 5] * z) - first[BOX + 12], 0.0)
        v = max(abs(first[BOX + 6] * x + first[BOX + 7] * y + first[BOX + 8] * z) - first[BOX + 13], 0.0)
        w = max(abs(first[BOX + 9] * x + first[BOX + 10] * y + first[BOX + 11] * z) - first[BOX + 14], 0.0)
        return math.sqrt(u * u + v * v + w * w) - bound
    x = spheres[a, 0] - sphere[0]
    y = spheres[a, 1] - sphere[1]
    z = spheres[a, 2] - sphere[2]
    return math.sqrt(x * x + y * y + z * z) - first[BOUND] - bound


@njit
def first_hit(q, clearance, geoms, points, neighbors, pairs, groups, tree, frames, spheres, work):
    """A pair that is not farther apart than the clearance at a configuration, or -1."""
    place(q, geoms, tree, frames, spheres)
    hint = int(work[LAST_HIT, 0])
    if hint >= 0 and _hits(hint, clearance, geoms, points, neighbors, pairs, frames, spheres, work):
        return hint
    for row in range(len(groups)):
        if _gap(groups[row, 0], groups[row, 1], geoms, spheres) > clearance:
            continue
        for p in range(groups[row, 2], groups[row, 3]):
            if _hits(p, clearance, geoms, points, neighbors, pairs, frames, spheres, work):
                work[LAST_HIT, 0] = p
                return p
    return -1


@njit
def _hits(p, clearance, geoms, points, neighbors, pairs, frames, spheres, work):
    """Whether a pair is not farther apart than the clearance."""
    if _gap(int(pairs[p, A]), int(pairs[p, B]), geoms, spheres) > clearance:
        return False
    enough = clearance + 1e-9  # strictly farther
    lower, _ = distance(p, enough, clearance, False, geoms, points, neighbors, pairs, frames, spheres, work)
    return lower <= clearance


@njit
def all_hits(q, clearance, hits, geoms, points, neighbors, pairs, groups, tree, frames, spheres, work):
    """Marks every pair that is not farther apart than the clearance."""
    place(q, geoms, tree, frames, spheres)
    for row in range(len(groups)):
        is_far = _gap(groups[row, 0], groups[row, 1], geoms, spheres) > clearance
        for p in range(groups[row, 2], groups[row, 3]):
            hits[p] = not is_far and _hits(p, clearance, geoms, points, neighbors, pairs, frames, spheres, work)


@njit
def nearest_pair(q, geoms, points, neighbors, pairs, groups, tree, frames, spheres, work):
    """The pair that is nearest to touching, and its distance; a distance at or below zero says that it overlaps."""
    place(q, geoms, tree, frames, spheres)
    least = _INFINITE
    nearest = -1
    for row in range(len(groups)):
        if _gap(groups[row, 0], groups[row, 1], geoms, spheres) > least:
            continue
        for p in range(groups[row, 2], groups[row, 3]):
            if _gap(int(pairs[p, A]), int(pairs[p, B]), geoms, spheres) > least:
                continue
            _, upper = distance(p, least, -_INFINITE, True, geoms, points, neighbors, pairs, frames, spheres, work)
            if upper < least:
                least = upper
                nearest = p
    return nearest, least


@njit
def _least_motion(clearance):
    """An interval in which no point moves farther is not split again, m."""
    return min(MOTION_MIN_M, MOTION_MIN_SHARE * clearance) if clearance > 0.0 else MOTION_MIN_M


@njit
def _check_pair(p, delta, clearance, open_pairs, end, geoms, points, neighbors, pairs, tree, frames, spheres, work):
    """Settles a pair for an interval, or notes it as open. Returns the end of the open pairs, or -1 - p if it is not free."""
    a = int(pairs[p, A])
    b = int(pairs[p, B])
    motion = _relative_motion(a, b, int(pairs[p, COMMON_DEPTH]), delta, geoms, tree, frames, spheres)
    gap = _gap(a, b, geoms, spheres)
    if gap > clearance + motion:
        return end
    if motion > max(gap, 0.0) + COARSE * min(geoms[a, BOUND], geoms[b, BOUND]) and motion > _least_motion(clearance):
        # The interval is too long for a distance to settle the pair. Only a contact at its middle ends the search early.
        if gap <= clearance and _hits(p, clearance, geoms, points, neighbors, pairs, frames, spheres, work):
            work[LAST_HIT, 0] = p
            return -1 - p
        open_pairs[end] = p
        return end + 1
    enough = clearance + motion
    lower, upper = distance(p, enough + 1e-9, clearance, False, geoms, points, neighbors, pairs, frames, spheres, work)
    if lower > enough:
        return end
    if upper <= clearance or lower <= clearance or motion < _least_motion(clearance):
        work[LAST_HIT, 0] = p
        return -1 - p
    if int(geoms[a, SHAPE]) != PLANE:
        motion = _motion_along_direction(p, a, b, delta, geoms, pairs, tree, frames, spheres)
        if lower > clearance + motion:
            return end
        if upper > clearance + motion:
            enough = clearance + motion
            lower, upper = distance(p, enough + 1e-9, clearance, True, geoms, points, neighbors, pairs, frames, spheres, work)
            if lower > clearance + _motion_along_direction(p, a, b, delta, geoms, pairs, tree, frames, spheres):
                return end
    open_pairs[end] = p
    return end + 1


@njit
def _motion_along_direction(p, a, b, delta, geoms, pairs, tree, frames, spheres):
    """Bounds the motion of a pair along the direction that separates it."""
    x = pairs[p, DIRECTION]
    y = pairs[p, DIRECTION + 1]
    z = pairs[p, DIRECTION + 2]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x *= scale
    y *= scale
    z *= scale
    frame = frames[int(geoms[a, FRAME])]
    nx = frame[0] * x + frame[1] * y + frame[2] * z
    ny = frame[3] * x + frame[4] * y + frame[5] * z
    nz = frame[6] * x + frame[7] * y + frame[8] * z
    common = int(pairs[p, COMMON])
    first = _motion_along(a, common, nx, ny, nz, delta, geoms, tree, frames, spheres)
    second = _motion_along(b, common, nx, ny, nz, delta, geoms, tree, frames, spheres)
    return first + second


@njit
def _check_group(row, delta, clearance, open_pairs, end, geoms, points, neighbors, pairs, groups, tree, frames, spheres, work):
    """As `_check_pair` for all pairs of two groups; groups too near to be told apart are noted as -1 - row."""
    a = groups[row, 0]
    b = groups[row, 1]
    common_depth = int(pairs[groups[row, 2], COMMON_DEPTH])
    motion = _relative_motion(a, b, common_depth, delta, geoms, tree, frames, spheres)
    gap = _gap(a, b, geoms, spheres)
    if gap > clearance + motion:
        return end
    if motion > max(gap, 0.0) + COARSE * min(geoms[a, BOUND], geoms[b, BOUND]) and motion > _least_motion(clearance):
        if gap <= clearance:
            for p in range(groups[row, 2], groups[row, 3]):
                if _hits(p, clearance, geoms, points, neighbors, pairs, frames, spheres, work):
                    work[LAST_HIT, 0] = p
                    return -1 - p
        open_pairs[end] = -1 - row
        return end + 1
    for p in range(groups[row, 2], groups[row, 3]):
        end = _check_pair(p, delta, clearance, open_pairs, end, geoms, points, neighbors, pairs, tree, frames, spheres, work)
        if end < 0:
            return end
    return end


@njit
def _check_interval(
    q,
    delta,
    clearance,
    open_pairs,
    first,
    last,
    end,
    geoms,
    points,
    neighbors,
    pairs,
    groups,
    tree,
    frames,
    spheres,
    work,
):
    """Checks open pairs, or all if `first` is negative, where joints stay within delta of q. Returns as `_check_pair` does."""
    place(q, geoms, tree, frames, spheres)
    count = len(groups) if first < 0 else last - first
    for i in range(count):
        p = -1 - i if first < 0 else open_pairs[first + i]
        if p < 0:
            row = -1 - p
            end = _check_group(
                row, delta, clearance, open_pairs, end, geoms, points, neighbors, pairs, groups, tree, frames, spheres, work
            )
        else:
            end = _check_pair(
                p, delta, clearance, open_pairs, end, geoms, points, neighbors, pairs, tree, frames, spheres, work
            )
        if end < 0:
            return end
    return end


@njit
def tilt_angle(keep, frames):
    """The angle between the axis that should keep its direction and this direction, rad, where the frames are placed."""
    frame = frames[int(keep[KEEP_FRAME])]
    ux, uy, uz = _turned(frame, keep[KEEP_AXIS], keep[KEEP_AXIS + 1], keep[KEEP_AXIS + 2])
    dx = keep[KEEP_DIRECTION]
    dy = keep[KEEP_DIRECTION + 1]
    dz = keep[KEEP_DIRECTION + 2]
    x = uy * dz - uz * dy
    y = uz * dx - ux * dz
    z = ux * dy - uy * dx
    return math.atan2(math.sqrt(x * x + y * y + z * z), ux * dx + uy * dy + uz * dz)


@njit
def _turned(frame, x, y, z):
    """A direction of a frame in the world."""
    return (
        frame[0] * x + frame[1] * y + frame[2] * z,
        frame[3] * x + frame[4] * y + frame[5] * z,
        frame[6] * x + frame[7] * y + frame[8] * z,
    )


@njit
def _check_tilt(keep, delta, tree, frames):
    """1 if the axis keeps its direction while joint j moves by at most delta[j], -1 if not, 0 if the interval is too long.

    Change the joints from the base outward: hinge j then turns the axis u on a circle of radius |a_j x u|.
    """
    angle = tilt_angle(keep, frames)
    if angle > keep[KEEP_WITHIN]:
        return -1
    walk = int(keep[KEEP_FRAME])
    ux, uy, uz = _turned(frames[walk], keep[KEEP_AXIS], keep[KEEP_AXIS + 1], keep[KEEP_AXIS + 2])
    turn = 0.0
    while walk > 0:
        joint = tree[walk - 1]
        if int(joint[KIND]) == HINGE:
            located = frames[walk]
            x = located[16] * uz - located[17] * uy
            y = located[17] * ux - located[15] * uz
            z = located[15] * uy - located[16] * ux
            turn += delta[int(joint[JOINT])] * math.sqrt(x * x + y * y + z * z)
        walk = int(joint[PARENT])
    if angle + turn <= keep[KEEP_WITHIN]:
        return 1
    return -1 if turn < TILT_MIN_RAD else 0


@njit
def prove_motion(knots, coefficients, pair, clearance, ranges, memory, scene):
    """Proves that one pair, or all if it is negative, keep more than a clearance while the joints move by polynomials of time.

    The polynomials are (pieces, degree + 1, joints), by powers of the time since the piece's knot. Returns (-1, 0) if the proof
    succeeds, else a pair and the time at which it is not known to be free. The number behind the last pair says that the axis
    tilts.
    """
    _bound_pieces(knots, coefficients, ranges)
    state = _first_interval(knots, pair, memory)
    state, found, time = _continue_proof(state, knots, coefficients, clearance, ranges, memory, scene)
    return found, time


@njit
def closest_approach(knots, coefficients, clearance, resolution, samples, ranges, memory, scene):
    """A proved lower bound of the distance during a motion, a distance that is attained, its pair and its time.

    It proves that the motion keeps slightly less than the least distance seen so far, but more than the clearance. Where the
    proof stops, a smaller distance is found, and the proof goes on with that one: what is settled so far stays settled. The
    bound is negative if the clearance cannot be proved; then the distance is the one at which the proof stopped.
    """
    q = memory[2]
    least = _INFINITE
    nearest = -1
    when = 0.0
    piece = 0
    for k in range(samples):
        time = knots[0] + (knots[-1] - knots[0]) * k / (samples - 1)
        piece = _piece_at(time, piece, knots)
        _evaluate(coefficients[piece], time - knots[piece], q)
        p, distance_now = nearest_pair(q, *scene)
        if distance_now < least:
            least = distance_now
            nearest = p
            when = time
    _bound_pieces(knots, coefficients, ranges)
    state = _first_interval(knots, -1, memory)
    aim = least
    while least > clearance:
        bound = max(aim - resolution, 0.5 * (aim + clearance))
        if bound - clearance < _SETTLED_M:
            bound = clearance
        state, p, time = _continue_proof(state, knots, coefficients, bound, ranges, memory, scene)
        if p < 0:
            return bound, least, nearest, when
        if p == len(scene[3]):
            return -1.0, least, p, time
        p, distance_now = nearest_pair(q, *scene)
        if bound == clearance:
            return -1.0, distance_now, p, time
        aim -= 0.5 * (aim - bound)  # a proof stops this near to its bound, or because GJK did not converge
        if distance_now < least:
            least = distance_now
            nearest = p
            when = time
            aim = min(aim, least)
    return -1.0, least, nearest, when


@njit
def _first_interval(knots, pair, memory):
    """Notes the whole motion as the first interval. Returns the state of a proof: first and last interval, last open pair."""
    open_pairs, intervals, _, _, keep = memory
    open_pairs[0] = pair
    intervals[0, TILT_IS_OPEN] = 1.0 if keep[KEEP_FRAME] >= 0.0 else 0.0
    intervals[0, BEGIN] = knots[0]
    intervals[0, END] = knots[-1]
    intervals[0, PIECE] = 0
    intervals[0, LAST_PIECE] = len(knots) - 2
    intervals[0, OPEN] = -1 if pair < 0 else 0
    intervals[0, LAST_OPEN] = -1 if pair < 0 else 1
    return 0, 1, 0 if pair < 0 else 1


@njit
def _continue_proof(state, knots, coefficients, clearance, ranges, memory, scene):
    """Settles intervals until none is left or a pair is not free, which is returned with its time; q is then where it is.

    Intervals are split breadth first, so that contacts are found early, and both parts inherit the pairs that are open. A
    proof that stopped goes on with the same interval. If the memory for intervals or pairs does not suffice, the motion counts
    as not free.
    """
    head, tail, end = state
    open_pairs, intervals, q, delta, keep = memory
    room = len(scene[3]) + len(scene[4])  # pairs and groups
    while head < tail:
        if tail + 2 > len(intervals) or end + room > len(open_pairs):
            tail, end = _moved_to_front(head, tail, end, open_pairs, intervals)
            head = 0
        begin = intervals[head, BEGIN]
        stop = intervals[head, END]
        first = int(intervals[head, PIECE])
        last = int(intervals[head, LAST_PIECE])
        middle = 0.5 * (begin + stop)
        if first == last:
            _bound_interval(coefficients[first], middle - knots[first], 0.5 * (stop - begin), q, delta)
        else:
            _bound_pieces_together(middle, first, last, knots, coefficients, ranges, q, delta)
        if tail + 2 > len(intervals) or end + room > len(open_pairs):
            p, _ = nearest_pair(q, *scene)
            return (head, tail, end), p, middle
        first_open = int(intervals[head, OPEN])
        last_open = int(intervals[head, LAST_OPEN])
        stopped = _check_interval(q, delta, clearance, open_pairs, first_open, last_open, end, *scene)
        if stopped < 0:
            return (head, tail, end), -1 - stopped, middle
        settled = _check_tilt(keep, delta, scene[5], scene[6]) if intervals[head, TILT_IS_OPEN] > 0.0 else 1
        if settled < 0:
            return (head, tail, end), len(scene[3]), middle
        head += 1
        if stopped > end or settled == 0:
            tail = _split(begin, stop, first, last, end, stopped, 1 - settled, tail, knots, intervals)
            end = stopped
    return (head, tail, end), -1, 0.0


@njit
def _split(begin, stop, first, last, open_first, open_last, tilt_is_open, tail, knots, intervals):
    """Appends both parts of an interval, split at a knot if it has one inside. Returns the new end of the intervals."""
    middle = 0.5 * (begin + stop)
    split = first
    if first < last:
        split = _piece_at(middle, first, knots)
        if split == last or (split > first and middle - knots[split] < knots[split + 1] - middle):
            split -= 1
        middle = knots[split + 1]
    for side in range(2):
        intervals[tail, BEGIN] = begin if side == 0 else middle
        intervals[tail, END] = middle if side == 0 else stop
        intervals[tail, PIECE] = first if side == 0 else (split + 1 if first < last else last)
        intervals[tail, LAST_PIECE] = split if side == 0 else last
        intervals[tail, OPEN] = open_first
        intervals[tail, LAST_OPEN] = open_last
        intervals[tail, TILT_IS_OPEN] = tilt_is_open
        tail += 1
    return tail


@njit
def _moved_to_front(head, tail, end, open_pairs, intervals):
    """Moves the intervals that are left, and their open pairs, to the front of their lists. Returns both new ends."""
    base = int(intervals[head, OPEN])
    if base < 0:
        return tail, end
    for k in range(base, end):
        open_pairs[k - base] = open_pairs[k]
    for k in range(head, tail):
        for column in range(INTERVAL_COLUMNS):
            intervals[k - head, column] = intervals[k, column]
        intervals[k - head, OPEN] -= base
        intervals[k - head, LAST_OPEN] -= base
    return tail - head, end - base


@njit
def _piece_at(time, piece, knots):
    """The piece at a time, looked for from a given one onwards."""
    while piece < len(knots) - 2 and knots[piece + 1] <= time:
        piece += 1
    return piece


@njit
def _evaluate(coefficients, time, q):
    for i in range(coefficients.shape[1]):
        value = 0.0
        for k in range(coefficients.shape[0] - 1, -1, -1):
            value = value * time + coefficients[k, i]
        q[i] = value


@njit
def _bound_interval(coefficients, middle, half, q, delta):
    """Writes the middle of an interval of one piece, and how far each joint leaves it at most: sum of |derivative k / k!| h^k.

    The Taylor coefficients at the middle come from repeated synthetic division (the Horner scheme).
    """
    degree = coefficients.shape[0] - 1
    for i in range(coefficients.shape[1]):
        c0 = coefficients[0, i]
        c1 = coefficients[1, i]
        if degree == 1:
            q[i] = c0 + middle * c1
            delta[i] = abs(c1) * half
            continue
        c2 = coefficients[2, i] if degree > 1 else 0.0
        c3 = coefficients[3, i] if degree > 2 else 0.0
        c4 = coefficients[4, i] if degree > 3 else 0.0
        c5 = coefficients[5, i] if degree > 4 else 0.0
        q[i] = c0 + middle * (c1 + middle * (c2 + middle * (c3 + middle * (c4 + middle * c5))))
        d1 = c1 + middle * (2.0 * c2 + middle * (3.0 * c3 + middle * (4.0 * c4 + middle * 5.0 * c5)))
        d2 = c2 + middle * (3.0 * c3 + middle * (6.0 * c4 + middle * 10.0 * c5))
        d3 = c3 + middle * (4.0 * c4 + middle * 10.0 * c5)
        d4 = c4 + middle * 5.0 * c5
        delta[i] = half * (abs(d1) + half * (abs(d2) + half * (abs(d3) + half * (abs(d4) + half * abs(c5)))))


@njit
def _bound_pieces(knots, coefficients, ranges):
    """Writes for each piece, (2, joints), the middle of its range and how far each joint leaves that at most."""
    for k in range(len(coefficients)):
        half = 0.5 * (knots[k + 1] - knots[k])
        _bound_interval(coefficients[k], half, half, ranges[k, 0], ranges[k, 1])


@njit
def _bound_pieces_together(middle, first, last, knots, coefficients, ranges, q, delta):
    """As `_bound_interval`, for several pieces together."""
    at = _piece_at(middle, first, knots)
    _evaluate(coefficients[at], middle - knots[at], q)
    for i in range(len(q)):
        delta[i] = 0.0
    for k in range(first, last + 1):
        for i in range(len(q)):
            delta[i] = max(delta[i], abs(ranges[k, 0, i] - q[i]) + ranges[k, 1, i])


@njit
def overlap_depth(p, directions, geoms, points, neighbors, pairs, frames):
    """How far the second geom of a pair must move to part from the first: the least over many directions of the world."""
    least = _INFINITE
    for row in range(len(directions)):
        nx = directions[row, 0]
        ny = directions[row, 1]
        nz = directions[row, 2]
        least = min(least, _depth_along(p, nx, ny, nz, geoms, points, neighbors, pairs, frames))
    return least


@njit
def _depth_along(p, nx, ny, nz, geoms, points, neighbors, pairs, frames):
    """How far the second geom of a pair must move along a direction of the world to part from the first."""
    first = geoms[int(pairs[p, A])]
    second = geoms[int(pairs[p, B])]
    if int(first[SHAPE]) == PLANE:
        nx = first[INFO]
        ny = first[INFO + 1]
        nz = first[INFO + 2]
        top = first[INFO + 3]
    else:
        x, y, z = _farthest(first, frames[int(first[FRAME])], nx, ny, nz, points, neighbors)
        top = nx * x + ny * y + nz * z
    x, y, z = _farthest(second, frames[int(second[FRAME])], -nx, -ny, -nz, points, neighbors)
    return top - nx * x - ny * y - nz * z


@njit
def _farthest(geom, frame, nx, ny, nz, points, neighbors):
    """The point of a geom, in the world, that is farthest in a direction of the world."""
    x, y, z = _rotated_back(frame, nx, ny, nz)
    if int(geom[SHAPE]) == POINTS:
        i = _support(int(geom[FIRST]), int(geom[LAST]), x, y, z, -1, points, neighbors)
        px = points[i, 0]
        py = points[i, 1]
        pz = points[i, 2]
    else:
        px, py, pz = _round_support(geom, x, y, z, points)
    radius = geom[RADIUS]
    px, py, pz = _turned(frame, px, py, pz)
    return px + frame[9] + radius * nx, py + frame[10] + radius * ny, pz + frame[11] + radius * nz


@njit
def near_pairs(
    q,
    delta,
    share,
    clearances,
    directions,
    trace,
    found,
    geoms,
    points,
    neighbors,
    pairs,
    groups,
    tree,
    frames,
    spheres,
    work,
):
    """The pairs that joints, moving by at most delta, can bring nearer by more than a share of what is free.

    What is free of a pair is its distance less its clearance. Writes rows of `found`: the pair, its distance, negative where it
    overlaps, and the derivative of the distance by each joint. Returns how many there are.
    """
    place(q, geoms, tree, frames, spheres)
    count = 0
    for row in range(len(groups)):
        common_depth = int(pairs[groups[row, 2], COMMON_DEPTH])
        motion = _relative_motion(groups[row, 0], groups[row, 1], common_depth, delta, geoms, tree, frames, spheres)
        gap = _gap(groups[row, 0], groups[row, 1], geoms, spheres)
        for p in range(groups[row, 2], groups[row, 3]):
            if share * (gap - clearances[p]) >= motion:
                continue
            a = int(pairs[p, A])
            b = int(pairs[p, B])
            motion_of_pair = _relative_motion(a, b, common_depth, delta, geoms, tree, frames, spheres)
            if share * (_gap(a, b, geoms, spheres) - clearances[p]) >= motion_of_pair:
                continue
            enough = clearances[p] + motion_of_pair / share
            lower, _ = distance(p, enough, -_INFINITE, False, geoms, points, neighbors, pairs, frames, spheres, work)
            if lower >= enough:
                continue
            out = found[count]
            out[PAIR] = p
            out[DISTANCE] = _witness(p, directions, trace, geoms, points, neighbors, pairs, frames, spheres, work)
            _distance_gradient(p, work[FOUND], work[FACE : FACE + 2], out[GRADIENT:], geoms, pairs, tree, frames)
            approach = 0.0
            for j in range(len(delta)):
                approach += abs(out[GRADIENT + j]) * delta[j]
            if share * (out[DISTANCE] - clearances[p]) < approach:
                count += 1
    return count


@njit
def _witness(p, directions, trace, geoms, points, neighbors, pairs, frames, spheres, work):
    """The distance of a pair, negative where it overlaps.

    Writes the direction from the first geom to the second to `work[FOUND]`, and the nearest points of both, or points at the
    same distance along it, to the next two rows; everything in the world.
    """
    first = geoms[int(pairs[p, A])]
    second = geoms[int(pairs[p, B])]
    if int(first[SHAPE]) == PLANE:
        return _plane_witness(first, second, frames[int(second[FRAME])], points, neighbors, work)
    length = _core_witness(p, 0.0, 0.0, 0.0, trace, geoms, points, neighbors, pairs, frames, spheres, work)
    if length < 0.0:
        return _overlap_witness(p, directions, trace, geoms, points, neighbors, pairs, frames, spheres, work)
    return length - first[RADIUS] - second[RADIUS]


@njit
def _core_witness(p, x, y, z, trace, geoms, points, neighbors, pairs, frames, spheres, work):
    """As `_witness`, for a pair without its radii, the second geom displaced in the world; -1 where it overlaps.

    GJK as in `distance`; the steps are noted, because they tell which point of the first geom is the nearest.
    """
    fa = frames[int(geoms[int(pairs[p, A]), FRAME])]
    relative = work[RELATIVE:]
    _relate(fa, frames[int(geoms[int(pairs[p, B]), FRAME])], relative)
    x, y, z = _rotated_back(fa, x, y, z)
    relative[3, 0] += x
    relative[3, 1] += y
    relative[3, 2] += z
    vx, vy, vz = _first_direction(p, geoms, pairs, frames, spheres)
    count = 0
    for step in range(MAX_GJK_STEPS):
        ax, ay, az = _support_point(p, A, -vx, -vy, -vz, geoms, points, neighbors, pairs)
        wx, wy, wz = _difference_support(p, vx, vy, vz, relative, geoms, points, neighbors, pairs)
        square = vx * vx + vy * vy + vz * vz
        if count > 0 and square - (vx * wx + vy * wy + vz * wz) <= _WITNESS_GAP * square:
            break
        is_known = False
        for k in range(count):
            is_known |= _squared_distance(work[k], wx, wy, wz) < 1e-22
        if is_known:
            break
        _write(trace[step], wx, wy, wz)
        _write(trace[step, 3:], ax, ay, az)
        _write(work[count], wx, wy, wz)
        count = _closest_to_origin(work, count + 1, work[FOUND], work[FACE:KEPT], work[KEPT:LAST_HIT])
        vx = work[FOUND, 0]
        vy = work[FOUND, 1]
        vz = work[FOUND, 2]
        if count == 5 or vx * vx + vy * vy + vz * vz < 1e-18:
            return -1.0
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    px, py, pz = _point_of_first(work, count, trace)
    px, py, pz = _turned(fa, px, py, pz)
    nx, ny, nz = _turned(fa, -vx / length, -vy / length, -vz / length)
    _write(work[FOUND], nx, ny, nz)
    _write(work[FACE], px + fa[9], py + fa[10], pz + fa[11])
    _write(work[FACE + 1], px + fa[9], py + fa[10], pz + fa[11])  # the other one is along the direction
    return length


@njit
def _write(row, x, y, z):
    row[0] = x
    row[1] = y
    row[2] = z


@njit
def _plane_witness(plane, other, frame, points, neighbors, work):
    """As `_witness`, for a plane."""
    nx = plane[INFO]
    ny = plane[INFO + 1]
    nz = plane[INFO + 2]
    x, y, z = _farthest(other, frame, -nx, -ny, -nz, points, neighbors)
    _write(work[FOUND], nx, ny, nz)
    _write(work[FACE], x, y, z)
    _write(work[FACE + 1], x, y, z)
    return nx * x + ny * y + nz * z - plane[INFO + 3]


@njit
def _point_of_first(simplex, count, trace):
    """The point of the first geom that belongs to the point of a simplex closest to the origin."""
    b = (0.0, 0.0)
    if count > 1:
        b = _barycentric(simplex, count)
    weights = (1.0 - b[0] - b[1], b[0], b[1])
    x = 0.0
    y = 0.0
    z = 0.0
    for k in range(min(count, 3)):
        step = 0
        while trace[step, 0] != simplex[k, 0] or trace[step, 1] != simplex[k, 1] or trace[step, 2] != simplex[k, 2]:
            step += 1  # the simplex has copies of the rows
        x += weights[k] * trace[step, 3]
        y += weights[k] * trace[step, 4]
        z += weights[k] * trace[step, 5]
    return x, y, z


@njit
def _barycentric(simplex, count):
    """The weights of the second and third vertex in the point of a segment or triangle closest to the origin."""
    uu = 0.0
    uv = 0.0
    vv = 0.0
    ou = 0.0
    ov = 0.0
    for c in range(3):
        u = simplex[1, c] - simplex[0, c]
        v = simplex[2, c] - simplex[0, c] if count > 2 else 0.0
        uu += u * u
        uv += u * v
        vv += v * v
        ou -= u * simplex[0, c]
        ov -= v * simplex[0, c]
    if count == 2:
        return ou / uu, 0.0
    determinant = uu * vv - uv * uv
    if determinant <= 1e-12 * uu * vv:
        return ou / uu, 0.0
    return (vv * ou - uv * ov) / determinant, (uu * ov - uv * ou) / determinant


@njit
def _overlap_witness(p, directions, trace, geoms, points, neighbors, pairs, frames, spheres, work):
    """As `_witness`, for a pair that overlaps: the direction in which it parts soonest, improved from a lattice.

    Displace the second geom along a direction n until the pair is just apart. Along the direction m of the shortest distance
    it parts no later than along n: with the displacement s and the distance d, the depth along m is s n.m - d <= s - d.
    """
    radii = geoms[int(pairs[p, A]), RADIUS] + geoms[int(pairs[p, B]), RADIUS]
    depth = _INFINITE
    nx = 0.0
    ny = 0.0
    nz = 0.0
    for row in range(len(directions)):
        x = directions[row, 0]
        y = directions[row, 1]
        z = directions[row, 2]
        along = _depth_along(p, x, y, z, geoms, points, neighbors, pairs, frames) - radii
        if along < depth:
            depth = along
            nx = x
            ny = y
            nz = z
    for _ in range(_MAX_DEPTH_STEPS):
        way = depth + _PARTED_M
        sx = way * nx
        sy = way * ny
        sz = way * nz
        length = _core_witness(p, sx, sy, sz, trace, geoms, points, neighbors, pairs, frames, spheres, work)
        nx = work[FOUND, 0]
        ny = work[FOUND, 1]
        nz = work[FOUND, 2]
        _write(work[FACE + 1], work[FACE, 0] - sx, work[FACE, 1] - sy, work[FACE, 2] - sz)
        along = sx * nx + sy * ny + sz * nz - length
        has_converged = along > depth - _DEPTH_GAP_M
        depth = along
        if has_converged:
            break
    return -depth - radii


@njit
def _distance_gradient(p, direction, nearest, gradient, geoms, pairs, tree, frames):
    """The derivative of a pair's distance by each joint: how fast the nearest points move apart along the direction."""
    gradient[:] = 0.0
    common = int(pairs[p, COMMON])
    for side in range(2):
        walk = int(geoms[int(pairs[p, side]), FRAME])
        sign = -1.0 if side == 0 else 1.0
        while walk != common:
            joint = tree[walk - 1]
            located = frames[walk]
            if int(joint[KIND]) == SLIDE:
                rate = located[15] * direction[0] + located[16] * direction[1] + located[17] * direction[2]
            else:
                x = nearest[side, 0] - located[12]
                y = nearest[side, 1] - located[13]
                z = nearest[side, 2] - located[14]
                u = located[16] * z - located[17] * y
                v = located[17] * x - located[15] * z
                w = located[15] * y - located[16] * x
                rate = u * direction[0] + v * direction[1] + w * direction[2]
            gradient[int(joint[JOINT])] += sign * rate
            walk = int(joint[PARENT])
