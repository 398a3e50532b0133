"""The proof that nothing touches near a configuration, as a C function that the tick loop calls by its address.

Only a loop that skips collision detection imports this, so that others do not load the collision kernels.
"""

# Intrinsics are called without their first argument, and numba does not list what it exports.
# pyright: reportCallIssue=false, reportPrivateImportUsage=false

import numba
from numba import types

from armctl.collision.box_kernel import shrink_to_free
from armctl.collision.kernel import GEOM_COLUMNS, PAIR_COLUMNS, TREE_COLUMNS, WORK_ROWS
from armctl.core.addresses import call_with_table, integers, matrix, vector
from armctl.core.jit import c_function, njit_borrowing

# Entries of the table. SIZES:
JOINTS = 0
GEOMS = 1  # groups included
POINTS_COUNT = 2
NEIGHBORS_COUNT = 3
PAIRS_COUNT = 4
GROUPS_COUNT = 5
SPHERE_COLUMNS = 6
# Addresses, as the arguments of `shrink_to_free`:
POSITIONS = 7
DELTA = 8
CLEARANCES = 9
GROUP_CLEARANCES = 10
GEOM_ROWS = 11
POINT_ROWS = 12
NEIGHBORS = 13
PAIR_ROWS = 14
GROUP_ROWS = 15
TREE = 16
FRAMES = 17
SPHERES = 18
WORK = 19
TABLE_SIZE = 20

FRAME_COLUMNS = 18
_ROWS_AHEAD = 8  # of a motion, that a box is to contain
_BOX_MARGIN = 1e-4  # rad (m), more than that
_POINT_COLUMNS = 5
_GROUP_COLUMNS = 4


@c_function(types.intp(types.intp), borrows=True)
def prove_box(address):
    """Reduces a box until nothing touches in it, for the table at an address; 0 if there is none."""
    table = numba.carray(integers(address), (TABLE_SIZE,))
    joints = table[JOINTS]
    pairs = table[PAIRS_COUNT]
    groups = table[GROUPS_COUNT]
    is_free = shrink_to_free(
        vector(table[POSITIONS], joints),
        vector(table[DELTA], joints),
        vector(table[CLEARANCES], pairs),
        vector(table[GROUP_CLEARANCES], groups),
        matrix(table[GEOM_ROWS], table[GEOMS], GEOM_COLUMNS),
        matrix(table[POINT_ROWS], table[POINTS_COUNT], _POINT_COLUMNS),
        numba.carray(integers(table[NEIGHBORS]), (table[NEIGHBORS_COUNT],)),
        matrix(table[PAIR_ROWS], pairs, PAIR_COLUMNS),
        numba.carray(integers(table[GROUP_ROWS]), (groups, _GROUP_COLUMNS)),
        matrix(table[TREE], joints, TREE_COLUMNS),
        matrix(table[FRAMES], joints + 1, FRAME_COLUMNS),
        matrix(table[SPHERES], table[GEOMS], table[SPHERE_COLUMNS]),
        matrix(table[WORK], WORK_ROWS, 3),
    )
    return 1 if is_free else 0


PROVE_BOX = int(prove_box.address or 0)


@njit_borrowing
def mark_free_rows(prove, argument, rows, positions, delta, is_free):
    """Marks the rows (T, m) of a motion at which it is proved that nothing touches; positions and delta are scratch."""
    k = 0
    while k < len(rows):
        last = min(k + _ROWS_AHEAD, len(rows))
        for j in range(len(positions)):
            positions[j] = rows[k, j]
            delta[j] = _BOX_MARGIN
            for row in range(k, last):
                delta[j] = max(delta[j], abs(rows[row, j] - positions[j]) + _BOX_MARGIN)
        is_free[k] = call_with_table(prove, argument) != 0
        has_box = is_free[k]
        k += 1
        while has_box and k < len(rows):
            for j in range(len(positions)):
                has_box = has_box and abs(rows[k, j] - positions[j]) <= delta[j]
            if has_box:
                is_free[k] = True
                k += 1
