"""Collision-free paths in joint space, as scalar loops for numba: RRT-Connect and shortcuts, every line of them proved.

The scene is packed as `armctl.collision.kernel` describes. The remaining arrays:

- `ratio` (m, n), `offset` (m,): the positions of all joints that move are `ratio @ q + offset`.
- `knots`: (0, 1), the time of a line; `line` (1, 2, m), `ranges` (1, 2, m): memory for its polynomial and its range.
- `nodes` (2, capacity, n), `parents` (2, capacity), `domains` (2, capacity), `sizes` (2,): the trees of the start and of the
  goals, roots first.
"""

import math

from armctl.collision.kernel import (
    HINGE,
    JOINT,
    KEEP_DIRECTION,
    KEEP_FRAME,
    KEEP_WITHIN,
    KIND,
    PARENT,
    first_hit,
    locate_frames,
    prove_motion,
    tilt_angle,
)
from armctl.core.jit import njit

STEP = 1.0  # rad (m): the longest edge of a tree
_DOMAIN = 4.0  # rad: a node whose extension failed takes samples from this distance only
_MIN_DOMAIN = 1.0  # rad; smaller domains starve a tree of few nodes
_DOMAIN_RATE = 1e-4  # by which a domain shrinks with each failure and grows with each success
_SAME = 1e-10  # rad
_MIN_GAIN = 1e-3  # of the path's length: less is no gain
_LEVEL_SHARE = 0.5  # of the permitted tilt, which nodes keep: the lines between them need the rest
_LEVEL_STEPS = 8
_LEVEL_DAMPING = 1e-6
_MIN_PROGRESS = 0.2  # of a step, towards a target: less, and the projection leads away from it
_IDLE_SHORTCUTS = 25  # in a row without a gain: then it stops


@njit
def is_free_line(start, end, checks_end, clearance, memory, scene):
    """Whether the straight line between two configurations is proved to keep more than a clearance, and the kept axis.

    To check the end first decides most edges of a tree at a tenth of the cost of a proof.
    """
    ratio, offset, knots, line, ranges, proof_memory = memory
    keep = proof_memory[4]
    _write_moving(start, ratio, offset, line[0, 0])
    _write_moving(end, ratio, offset, proof_memory[2])
    for i in range(len(ratio)):
        line[0, 1, i] = proof_memory[2][i] - line[0, 0, i]
    if checks_end:
        if first_hit(proof_memory[2], clearance, *scene) >= 0:
            return False
        if keep[KEEP_FRAME] >= 0.0 and tilt_angle(keep, scene[6]) > keep[KEEP_WITHIN]:
            return False
    pair, _ = prove_motion(knots, line, -1, clearance, ranges, proof_memory, scene)
    return pair < 0


@njit
def _write_moving(q, ratio, offset, out):
    """Writes the positions of all joints that move."""
    for i in range(len(ratio)):
        position = offset[i]
        for j in range(len(q)):
            position += ratio[i, j] * q[j]
        out[i] = position


@njit
def make_level(q, low, high, turns, memory, scene):
    """Turns the kept axis of a configuration towards its direction, by the least motion of the joints. Returns if it could.

    Damped Gauss-Newton steps with the Jacobian of the axis, `turns` (n, 3): dq = J^T (J J^T + damping)^-1 rotation vector.
    """
    ratio, offset, _, _, _, proof_memory = memory
    keep = proof_memory[4]
    tree = scene[5]
    frames = scene[6]
    for _ in range(_LEVEL_STEPS):
        _write_moving(q, ratio, offset, proof_memory[2])
        locate_frames(proof_memory[2], tree, frames)
        excess = tilt_angle(keep, frames) - _LEVEL_SHARE * keep[KEEP_WITHIN]
        if excess <= 1e-6:
            return True
        rx, ry, rz = _rotation_needed(keep, frames, turns, ratio, tree)
        scale = (excess + 1e-6) / math.sqrt(rx * rx + ry * ry + rz * rz)
        x, y, z = _solve_gram(turns, scale * rx, scale * ry, scale * rz)
        for j in range(len(q)):
            q[j] += turns[j, 0] * x + turns[j, 1] * y + turns[j, 2] * z
            q[j] = min(max(q[j], low[j]), high[j])
    return False


@njit
def _rotation_needed(keep, frames, turns, ratio, tree):
    """Writes how each joint turns the kept axis, across it, and returns the direction of the rotation that it needs."""
    walk = int(keep[KEEP_FRAME])
    frame = frames[walk]
    ux = frame[0] * keep[1] + frame[1] * keep[2] + frame[2] * keep[3]
    uy = frame[3] * keep[1] + frame[4] * keep[2] + frame[5] * keep[3]
    uz = frame[6] * keep[1] + frame[7] * keep[2] + frame[8] * keep[3]
    turns[:] = 0.0
    while walk > 0:
        joint = tree[walk - 1]
        if int(joint[KIND]) == HINGE:
            ax = frames[walk, 15]
            ay = frames[walk, 16]
            az = frames[walk, 17]
            along = ax * ux + ay * uy + az * uz
            for j in range(ratio.shape[1]):
                share = ratio[int(joint[JOINT]), j]
                turns[j, 0] += share * (ax - along * ux)
                turns[j, 1] += share * (ay - along * uy)
                turns[j, 2] += share * (az - along * uz)
        walk = int(joint[PARENT])
    dx = keep[KEEP_DIRECTION]
    dy = keep[KEEP_DIRECTION + 1]
    dz = keep[KEEP_DIRECTION + 2]
    x = uy * dz - uz * dy
    y = uz * dx - ux * dz
    z = ux * dy - uy * dx
    if x * x + y * y + z * z < 1e-16:  # upside down: any rotation across the axis
        return uy - uz, uz - ux, ux - uy
    return x, y, z


@njit
def _solve_gram(turns, bx, by, bz):
    """Solves (J J^T + damping) x = b for the (n, 3) rows of J^T, by cofactors."""
    a = _LEVEL_DAMPING
    b = 0.0
    c = 0.0
    d = _LEVEL_DAMPING
    e = 0.0
    f = _LEVEL_DAMPING
    for j in range(len(turns)):
        a += turns[j, 0] * turns[j, 0]
        b += turns[j, 0] * turns[j, 1]
        c += turns[j, 0] * turns[j, 2]
        d += turns[j, 1] * turns[j, 1]
        e += turns[j, 1] * turns[j, 2]
        f += turns[j, 2] * turns[j, 2]
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    x = (d * f - e * e) * bx + (c * e - b * f) * by + (b * e - c * d) * bz
    y = (c * e - b * f) * bx + (a * f - c * c) * by + (b * c - a * e) * bz
    z = (b * e - c * d) * bx + (b * c - a * e) * by + (a * d - b * b) * bz
    return x / determinant, y / determinant, z / determinant


@njit
def _nearest(nodes, size, q):
    """The node nearest to a configuration, and its distance."""
    best = 0
    least = math.inf
    for k in range(size):
        square = 0.0
        for i in range(len(q)):
            offset = nodes[k, i] - q[i]
            square += offset * offset
            if square >= least:
                break
        if square < least:
            least = square
            best = k
    return best, math.sqrt(least)


@njit
def _add(side, q, parent, nodes, parents, domains, sizes):
    node = sizes[side]
    for i in range(len(q)):
        nodes[side, node, i] = q[i]
    parents[side, node] = parent
    domains[side, node] = math.inf
    sizes[side] = node + 1
    return node


@njit
def grow(samples, low, high, side, clearance, nodes, parents, domains, sizes, trial, turns, memory, scene):
    """Grows two trees towards random configurations, (k, n), in turns, until they meet.

    Returns:
        How many samples it took, the node of each tree where they meet or -1, and whose turn it is.
    """
    capacity = nodes.shape[1]
    keep = memory[5][4]
    step = min(STEP, 2.0 * math.sqrt(keep[KEEP_WITHIN])) if keep[KEEP_FRAME] >= 0.0 else STEP
    for taken in range(len(samples)):
        if sizes[side] > sizes[1 - side]:
            side = 1 - side
        other = 1 - side
        near, distance = _nearest(nodes[side], sizes[side], samples[taken])
        domain = domains[side, near]
        if distance > domain or distance < _SAME or max(sizes[0], sizes[1]) >= capacity:
            continue
        start = nodes[side, near]
        is_level = _step_towards(start, samples[taken], min(1.0, step / distance), trial, low, high, turns, memory, scene)
        if not is_level or not is_free_line(start, trial, True, clearance, memory, scene):
            domains[side, near] = _DOMAIN if math.isinf(domain) else max(_MIN_DOMAIN, domain * (1.0 - _DOMAIN_RATE))
            continue
        domains[side, near] = domain * (1.0 + _DOMAIN_RATE)
        added = _add(side, trial, near, nodes, parents, domains, sizes)
        goal = nodes[side, added]
        node, distance = _nearest(nodes[other], sizes[other], goal)
        is_met = False
        while not is_met and sizes[other] < capacity:
            steps = max(1, math.ceil(distance / step - 1e-9))
            start = nodes[other, node]
            is_met = steps == 1
            if is_met:
                trial[:] = goal
            elif not _step_towards(start, goal, 1.0 / steps, trial, low, high, turns, memory, scene):
                break
            remaining = _length(trial, goal)
            if remaining > distance - _MIN_PROGRESS * step and not is_met:
                break
            if not is_free_line(start, trial, True, clearance, memory, scene):
                is_met = False
                break
            distance = remaining
            node = _add(other, trial, node, nodes, parents, domains, sizes)
        if is_met:
            return taken + 1, (added if side == 0 else node), (node if side == 0 else added), side
        side = other
    return len(samples), -1, -1, side


@njit
def _step_towards(start, goal, share, out, low, high, turns, memory, scene):
    """Writes a configuration on the way to another, projected where an axis keeps its direction. Returns if it could."""
    for i in range(len(out)):
        out[i] = start[i] + share * (goal[i] - start[i])
    if memory[5][4][KEEP_FRAME] < 0.0:
        return True
    return make_level(out, low, high, turns, memory, scene)


@njit
def drop_needless_points(path, count, clearance, memory, scene):
    """Goes from each point of a path straight to the farthest one that can be reached. Returns how many points are left."""
    at = 0
    while at < count - 2:
        farthest = count - 1
        while farthest > at + 1:
            if is_free_line(path[at], path[farthest], False, clearance, memory, scene):
                break
            farthest -= 1
        count = _cut(path, count, at + 1, farthest)
        at += 1
    return count


@njit
def _cut(path, count, first, last):
    """Removes the points from `first` up to `last`, which stays. Returns how many are left."""
    removed = last - first
    if removed > 0:
        for k in range(last, count):
            for i in range(path.shape[1]):
                path[k - removed, i] = path[k, i]
    return count - removed


@njit
def _length(first, second):
    square = 0.0
    for i in range(len(first)):
        difference = second[i] - first[i]
        square += difference * difference
    return math.sqrt(square)


@njit
def _place_on(path, count, distance, out):
    """Writes the configuration at a distance along a path. Returns the number of its line."""
    at = 0
    passed = 0.0
    length = _length(path[0], path[1])
    while at < count - 2 and passed + length <= distance:
        passed += length
        at += 1
        length = _length(path[at], path[at + 1])
    share = (distance - passed) / length if length > 0.0 else 0.0
    for i in range(len(out)):
        out[i] = path[at, i] + share * (path[at + 1, i] - path[at, i])
    return at


@njit
def take_shortcuts(path, count, places, begin, end, clearance, memory, scene):
    """Goes straight between random places of a path, (k, 2) shares of its length. Returns how many points it then has."""
    idle = 0
    for row in range(len(places)):
        if count < 3 or idle > _IDLE_SHORTCUTS or count + 1 >= len(path):
            break
        total = 0.0
        for k in range(count - 1):
            total += _length(path[k], path[k + 1])
        low = min(places[row, 0], places[row, 1]) * total
        high = max(places[row, 0], places[row, 1]) * total
        first = _place_on(path, count, low, begin)
        last = _place_on(path, count, high, end)
        idle += 1
        if first == last or high - low - _length(begin, end) < _MIN_GAIN * total:
            continue
        if not is_free_line(begin, end, False, clearance, memory, scene):
            continue
        idle = 0
        if last == first + 1:  # one point becomes two
            for k in range(count - 1, last, -1):
                for i in range(path.shape[1]):
                    path[k + 1, i] = path[k, i]
            count += 1
        else:
            count = _cut(path, count, first + 3, last + 1)
        for i in range(path.shape[1]):
            path[first + 1, i] = begin[i]
            path[first + 2, i] = end[i]
        at = max(first - 1, 0)
        while at < min(first + 4, count - 2):
            if is_free_line(path[at], path[at + 2], False, clearance, memory, scene):
                count = _cut(path, count, at + 1, at + 2)
            else:
                at += 1
    return count
