"""Collision-free paths in joint space, as scalar loops for numba: RRT-Connect and shortcuts, every line of them proved.

The scene is packed as `armctl.collision.kernel` describes. The remaining arrays:

- `ratio` (m, n), `offset` (m,): the positions of all joints that move are `ratio @ q + offset`.
- `knots`: (0, 1), the time of a line; `line` (1, 2, m), `ranges` (1, 2, m): memory for its polynomial and its range.
- `nodes` (2, capacity, n), `parents` (2, capacity), `domains` (2, capacity), `sizes` (2,): the trees of the start and of the
  goals, roots first.
"""

import math

from armctl.collision.kernel import first_hit, prove_motion
from armctl.core.jit import njit

STEP = 1.0  # rad (m): the longest edge of a tree
_DOMAIN = 4.0  # rad: a node whose extension failed takes samples from this distance only
_MIN_DOMAIN = 1.0  # rad; smaller domains starve a tree of few nodes
_DOMAIN_RATE = 1e-4  # by which a domain shrinks with each failure and grows with each success
_SAME = 1e-10  # rad
_MIN_GAIN = 1e-3  # of the path's length: less is no gain
_IDLE_SHORTCUTS = 25  # in a row without a gain: then it stops


@njit
def is_free_line(start, end, checks_end, clearance, memory, scene):
    """Whether the straight line between two configurations is proved to keep more than a clearance.

    To check the end first decides most edges of a tree at a tenth of the cost of a proof.
    """
    ratio, offset, knots, line, ranges, proof_memory = memory
    q = proof_memory[2]
    joints, count = ratio.shape
    for i in range(joints):
        begin = offset[i]
        change = 0.0
        for j in range(count):
            begin += ratio[i, j] * start[j]
            change += ratio[i, j] * (end[j] - start[j])
        line[0, 0, i] = begin
        line[0, 1, i] = change
        q[i] = begin + change
    if checks_end and first_hit(q, clearance, *scene) >= 0:
        return False
    pair, _ = prove_motion(knots, line, -1, clearance, ranges, proof_memory, scene)
    return pair < 0


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
def grow(samples, side, clearance, nodes, parents, domains, sizes, trial, memory, scene):
    """Grows two trees towards random configurations, (k, n), in turns, until they meet.

    Returns:
        How many samples it took, the node of each tree where they meet or -1, and whose turn it is.
    """
    capacity = nodes.shape[1]
    for taken in range(len(samples)):
        if sizes[side] > sizes[1 - side]:
            side = 1 - side
        other = 1 - side
        near, distance = _nearest(nodes[side], sizes[side], samples[taken])
        domain = domains[side, near]
        if distance > domain or distance < _SAME or max(sizes[0], sizes[1]) >= capacity:
            continue
        share = min(1.0, STEP / distance)
        for i in range(len(trial)):
            trial[i] = nodes[side, near, i] + share * (samples[taken, i] - nodes[side, near, i])
        if not is_free_line(nodes[side, near], trial, True, clearance, memory, scene):
            domains[side, near] = _DOMAIN if math.isinf(domain) else max(_MIN_DOMAIN, domain * (1.0 - _DOMAIN_RATE))
            continue
        domains[side, near] = domain * (1.0 + _DOMAIN_RATE)
        added = _add(side, trial, near, nodes, parents, domains, sizes)
        node, distance = _nearest(nodes[other], sizes[other], trial)
        origin = node
        steps = max(1, math.ceil(distance / STEP))
        reached = 0
        while reached < steps and sizes[other] < capacity:
            share = (reached + 1) / steps
            for i in range(len(trial)):
                begin = nodes[other, origin, i]
                trial[i] = begin + share * (nodes[side, added, i] - begin)
            if not is_free_line(nodes[other, node], trial, True, clearance, memory, scene):
                break
            node = _add(other, trial, node, nodes, parents, domains, sizes)
            reached += 1
        if reached == steps:
            return taken + 1, (added if side == 0 else node), (node if side == 0 else added), side
        side = other
    return len(samples), -1, -1, side


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
