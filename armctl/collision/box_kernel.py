"""How far all joints may move from a configuration before any pair of geoms can meet.

The scene is packed as `armctl.collision.kernel` describes.
"""

from armctl.collision.kernel import (
    COMMON,
    COMMON_DEPTH,
    FRAME,
    INFO,
    IS_KNOWN,
    JOINT,
    LAST_HIT,
    PARENT,
    PLANE,
    SHAPE,
    A,
    B,
    _gap,
    _motion_along,
    _motion_along_direction,
    _relative_motion,
    distance,
    place,
)
from armctl.core.jit import njit

_MIN_SHARE = 1e-3  # of the motion that is asked for


@njit
def shrink_to_free(
    q,
    delta,
    clearances,
    group_clearances,
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
    """Reduces delta until all pairs keep their clearances while joint j stays within delta[j] of q; False if one is too near.

    The bounds of a pair's motion are linear in delta or grow faster, and only the joints between both geoms matter. A pair
    that can use up its distance reduces the motion of these joints in proportion; pairs that were settled before stay so.
    """
    place(q, geoms, tree, frames, spheres)
    hint = int(work[LAST_HIT, 0])
    if hint >= 0:  # the pair that was too near last time
        if not _keep_apart(hint, delta, clearances[hint], geoms, points, neighbors, pairs, tree, frames, spheres, work):
            return False
        work[LAST_HIT, 0] = -1.0
    for row in range(len(groups)):
        common_depth = int(pairs[groups[row, 2], COMMON_DEPTH])
        motion = _relative_motion(groups[row, 0], groups[row, 1], common_depth, delta, geoms, tree, frames, spheres)
        if _gap(groups[row, 0], groups[row, 1], geoms, spheres) - group_clearances[row] >= motion:
            continue
        for p in range(groups[row, 2], groups[row, 3]):
            if not _keep_apart(p, delta, clearances[p], geoms, points, neighbors, pairs, tree, frames, spheres, work):
                work[LAST_HIT, 0] = p
                return False
    return True


@njit
def _keep_apart(p, delta, clearance, geoms, points, neighbors, pairs, tree, frames, spheres, work):
    """Reduces delta until a pair keeps its clearance; False if it is too near."""
    a = int(pairs[p, A])
    b = int(pairs[p, B])
    motion = _relative_motion(a, b, int(pairs[p, COMMON_DEPTH]), delta, geoms, tree, frames, spheres)
    if _gap(a, b, geoms, spheres) - clearance >= motion:
        return True
    enough = clearance + motion
    lower, upper = distance(p, enough, clearance, False, geoms, points, neighbors, pairs, frames, spheres, work)
    if lower >= enough:
        return True
    if not upper > clearance:
        return False
    if lower - clearance >= _motion_along_pair(p, a, b, delta, geoms, pairs, tree, frames, spheres):
        return True
    lower, _ = distance(p, enough, clearance, True, geoms, points, neighbors, pairs, frames, spheres, work)
    motion = min(motion, _motion_along_pair(p, a, b, delta, geoms, pairs, tree, frames, spheres))
    if lower - clearance >= motion:
        return True
    share = (lower - clearance) / motion
    if not share >= _MIN_SHARE:
        return False
    for side in range(2):
        walk = int(geoms[int(pairs[p, side]), FRAME])
        while walk != int(pairs[p, COMMON]):
            joint = tree[walk - 1]
            delta[int(joint[JOINT])] *= share
            walk = int(joint[PARENT])
    for g in range(len(spheres)):
        spheres[g, IS_KNOWN] = 0.0
    return True


@njit
def _motion_along_pair(p, a, b, delta, geoms, pairs, tree, frames, spheres):
    """Bounds the motion of a pair along the direction in which the last query separated it."""
    plane = geoms[a]
    if int(plane[SHAPE]) == PLANE:
        common = int(pairs[p, COMMON])
        return _motion_along(b, common, plane[INFO], plane[INFO + 1], plane[INFO + 2], delta, geoms, tree, frames, spheres)
    return _motion_along_direction(p, a, b, delta, geoms, pairs, tree, frames, spheres)
