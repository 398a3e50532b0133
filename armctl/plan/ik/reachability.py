"""reachability: which part of its space an arm reaches, with how many orientations, and how dexterous it is there."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armctl import _core
from armctl._core import Constraint
from armctl.core.atomic import atomic_path, file_path
from armctl.core.defaults import MAX_FILE_VALUE
from armctl.core.errors import InputError
from armctl.core.file_reading import read_npz, reading
from armctl.core.plotting import AxesLayout, finish_axes
from armctl.core.pose import matrix_from_quat
from armctl.core.progress import progress_bar
from armctl.core.result import Verdict
from armctl.core.validation import Array, array, choice, frozen, integer, matrix, number, vector
from armctl.model.arm.arm import Arm
from armctl.plan.ik.closed_form_solutions import first_solutions
from armctl.plan.ik.lm import TOLERANCE_SHARE
from armctl.plan.ik.problem import IkChain, ik_chain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DEFAULT_ORIENTATIONS = 32
DEFAULT_SPACING_REACHES = 0.125
MAX_POINTS = 2_000_000
POINTS_PER_CHUNK = 16
PLANE_SAMPLES = 32  # configurations that show whether the tip stays in a plane
MAX_PLANE_DEVIATION = 1e-9  # m: above it a coordinate of the tip changes
# Starts of the numerical search for each orientation; most targets need one, and those that none can reach cost all of them.
NUMERICAL_STARTS = 24
POSITION_TOLERANCE = 1e-5  # m
ORIENTATION_TOLERANCE = 1e-4  # rad
FULL_ROTATIONS = (np.sqrt(2.0), 1.533751168755204288)  # constants of the super-Fibonacci spiral
_FILE_VERSION = 1
_MAX_FILE_BYTES = 128 * MAX_POINTS  # unpacked; a point has 40 bytes


@dataclass(frozen=True, eq=False, slots=True)
class Reachability(Verdict):
    """The points of a grid that an arm reaches.

    `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether any point is reachable.
        reason: Why `ok` is False; empty if it is True.
        arm: The name of the arm.
        points: (N, 3) m, in the world.
        fraction: (N,) of the orientations, in [0, 1]; 0 or 1 if only points are tested.
        manipulability: (N,) the largest of Yoshikawa's sqrt(det(J J^T)) over the configurations found at the point; 0 where
            there is none. Its unit is m^3, or m^2 and less with fewer joints.
        spacing: m, between the points.
        orientations: (M, 4) the orientations tried, wxyz; M is 0 if only points are tested.
    """

    ok: bool
    reason: str
    arm: str
    points: Array
    fraction: Array
    manipulability: Array
    spacing: float
    orientations: Array

    def __str__(self) -> str:
        if not self.ok:
            return f"nothing reached: {self.reason}"
        reached = self.fraction > 0
        is_one_layer = (np.ptp(self.points, axis=0) == 0).sum() == 1
        size = f"{self.volume / self.spacing:.3g} m^2" if is_one_layer else f"{self.volume:.3g} m^3"
        text = f"{int(reached.sum())} of {len(reached)} points reached, {size}"
        if len(self.orientations):
            text += f"; on average {100 * self.fraction[reached].mean():.0f} % of {len(self.orientations)} orientations there"
        return text

    @property
    def volume(self) -> float:
        """The volume of the grid cells around the reached points, m^3."""
        return float((self.fraction > 0).sum()) * self.spacing**3

    def to_dict(self) -> dict[str, float | int | str | bool]:
        """The figures of the whole map, for JSON."""
        reached = self.fraction > 0
        return {
            "arm": self.arm,
            "ok": self.ok,
            "reason": self.reason,
            "points": len(self.points),
            "reached": int(reached.sum()),
            "volume_m3": self.volume,
            "spacing_m": self.spacing,
            "orientations": len(self.orientations),
            "mean_fraction": float(self.fraction[reached].mean()) if self.ok else 0.0,
            "max_manipulability": float(self.manipulability.max()),
        }

    def cloud(self, values: str = "fraction") -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The reached points as a coloured cloud, in the form that viser's `scene.add_point_cloud` takes.

        Args:
            values: What the colour shows, from dark to bright: "fraction" or "manipulability".

        Returns:
            The points (K, 3) m and the colours (K, 3) RGB.

        Raises:
            InputError: There are no such values.
        """
        reached = self.fraction > 0
        share = self._values(values)[reached]
        share = share / max(float(share.max(initial=0.0)), 1e-300)
        stops = np.linspace(0.0, 1.0, len(_COLOURS))
        colours = np.stack([np.interp(share, stops, _COLOURS[:, k]) for k in range(3)], axis=1)
        return self.points[reached].astype(np.float32), np.round(colours).astype(np.uint8)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes all of it as a NumPy file.

        Args:
            path: A file that ends in ".npz".

        Raises:
            InputError: It has another file extension.
            OSError: The file cannot be written.
        """
        with atomic_path(file_path("path", path, (".npz",))) as temporary:
            np.savez_compressed(
                temporary,
                version=_FILE_VERSION,
                arm=self.arm,
                reason=self.reason,
                points=self.points,
                fraction=self.fraction,
                manipulability=self.manipulability,
                spacing=self.spacing,
                orientations=self.orientations,
            )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Reachability:
        """What `save` wrote.

        Args:
            path: A file that ends in ".npz".

        Raises:
            InputError: There is no such file, or it holds something else.
        """
        file = file_path("path", path, (".npz",))
        with reading(file, "no map that Reachability.save wrote"):
            data = read_npz(file, _MAX_FILE_BYTES)
            points = matrix("points", data["points"], 3)
            result = cls(
                ok=not str(data["reason"]),
                reason=str(data["reason"]),
                arm=str(data["arm"]),
                points=points,
                fraction=vector("fraction", data["fraction"], len(points)),
                manipulability=vector("manipulability", data["manipulability"], len(points)),
                spacing=number("spacing", data["spacing"].item(), 1e-9, MAX_FILE_VALUE),
                orientations=matrix("orientations", data["orientations"], 4),
            )
            if result.ok != (result.fraction > 0).any() or not ((result.fraction >= 0) & (result.fraction <= 1)).all():
                raise InputError("fraction: the values are not those of its reason")
            if max(np.abs(points).max(initial=0.0), np.abs(result.manipulability).max(initial=0.0)) > MAX_FILE_VALUE:
                raise InputError(f"points: a number is above {MAX_FILE_VALUE:g}")
            return result

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        values: str = "fraction",
        *,
        size: tuple[float, float] | None = None,
        ax: Axes | Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws slices through the middle of the reached points: seen from above, from the front and from the side.

        If the grid is one layer, only this layer is drawn.

        Args:
            path: An image file, such as "reach.png" or ".pdf"; without it a window opens.
            values: "fraction" or "manipulability".
            size: Width and height in inches.
            ax: Axes of matplotlib to draw into instead, one for each slice.

        Raises:
            InputError: There are no such values, the path has another ending, or the axes are not one for each slice.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        shown_values = self._values(values)
        extent = np.ptp(self.points, axis=0)
        slices = [(0, 1, 2), (0, 2, 1), (1, 2, 0)]
        layers = [each for each in slices if extent[each[2]] == 0]
        slices = layers if len(layers) == 1 else slices

        def draw(axes: list[Axes]) -> None:
            for panel, (i, j, across) in zip(axes, slices, strict=True):
                heights = self.points[self.fraction > 0, across] if self.ok else self.points[:, across]
                level = float(heights[np.abs(heights - np.median(heights)).argmin()])
                rows = np.abs(self.points[:, across] - level) < 0.25 * self.spacing
                highest = max(float(shown_values.max()), 1e-12)
                panel.scatter(
                    self.points[rows, i], self.points[rows, j], c=shown_values[rows], s=12, marker="s", vmin=0.0, vmax=highest
                )
                panel.set_xlabel(f"{'xyz'[i]}, m")
                panel.set_ylabel(f"{'xyz'[j]}, m")
                panel.set_title(f"{'xyz'[across]} = {level:.3f} m")
                panel.set_aspect("equal")
                panel.margins(0.05)
            axes[0].figure.colorbar(axes[0].collections[0], ax=axes, label=values)

        return finish_axes(draw, (1, len(slices)), size or (1.0 + 4.0 * len(slices), 4.5), path, ax, AxesLayout(sharex=False))

    def _values(self, name: str) -> Array:
        return self.fraction if choice("values", name, ("fraction", "manipulability")) == "fraction" else self.manipulability


# From dark blue to yellow, evenly in brightness (viridis).
_COLOURS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float)


def reachability(
    arm: Arm,
    spacing: float | None = None,
    orientations: int | None = None,
    region: Sequence[ArrayLike] | None = None,
    *,
    threads: int | None = None,
) -> Reachability:
    """The points that an arm reaches, with how many orientations, and its manipulability there.

    Each orientation is tried at each point of a grid, inside the joint limits; contacts are not considered. The orientations
    are spread evenly (Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR 2022). Arms of six joints
    with a closed form are answered exactly. Of seven joints one is swept in 64 steps, which misses poses that need a small part
    of its range. Other arms are searched numerically from 24 starts, which may miss poses, too. If the tip stays in a plane
    across an axis of the world, the grid is one layer in that plane.

    If stderr is a terminal, a progress bar appears after two seconds.

    Args:
        spacing: m, between the points; by default an eighth of the arm's length.
        orientations: How many to try at each point; 0 tests points only. By default 32, or 0 with fewer than six joints.
        region: Two opposite corners of a box, (3,) m each; in one between two layers of the grid, its middle is the layer. By
            default the sphere that the stretched arm could reach.
        threads: How many threads to use; by default one per core. The result does not depend on it.

    Raises:
        InputError: An argument has a wrong shape, type or value, or there are more than two million points.
    """
    chain = ik_chain(arm)
    spacing = DEFAULT_SPACING_REACHES * chain.reach if spacing is None else number("spacing", spacing, 1e-6)
    default = DEFAULT_ORIENTATIONS if arm.n >= 6 else 0
    count = default if orientations is None else integer("orientations", orientations, 0, 100_000)
    tips, _ = arm.fk_many(arm.limits.random(arm.home, PLANE_SAMPLES, np.random.default_rng(0)))
    planes = np.where(np.ptp(tips, axis=0) <= MAX_PLANE_DEVIATION, tips[0], np.nan)
    points = _grid(chain, spacing, region, planes)
    quaternions = even_orientations(count)
    threads = (os.cpu_count() or 1) if threads is None else integer("threads", threads, 1)
    rows = np.zeros((max(count, 1), 12))
    if count:
        rows[:, :9] = matrix_from_quat(quaternions.T).reshape(9, -1).T
    fraction = np.zeros(len(points))
    manipulability = np.zeros(len(points))
    with progress_bar("reachability", len(points), "points") as progress, ThreadPoolExecutor(threads) as pool:
        chunks = [slice(k, min(k + POINTS_PER_CHUNK, len(points))) for k in range(0, len(points), POINTS_PER_CHUNK)]
        found = pool.map(lambda chunk: _reached(arm, points[chunk], rows, count > 0), chunks)
        try:
            for chunk, reached in zip(chunks, found, strict=True):
                fraction[chunk], manipulability[chunk] = reached
                progress.update(chunk.stop - chunk.start)
        finally:
            pool.shutdown(cancel_futures=True)
    ok = bool((fraction > 0).any())
    return Reachability(
        ok=ok,
        reason="" if ok else f"none of {len(points)} points is reachable",
        arm=arm.name,
        points=frozen(points),
        fraction=frozen(fraction),
        manipulability=frozen(manipulability),
        spacing=spacing,
        orientations=frozen(quaternions),
    )


def even_orientations(count: int) -> Array:
    """(count, 4) unit quaternions wxyz, spread evenly over all orientations."""
    s = np.arange(count) + 0.5
    inner = np.sqrt(s / max(count, 1))
    outer = np.sqrt(1.0 - s / max(count, 1))
    alpha = 2 * np.pi * s / FULL_ROTATIONS[0]
    beta = 2 * np.pi * s / FULL_ROTATIONS[1]
    return np.stack([outer * np.cos(beta), inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta)], axis=1)


def _grid(chain: IkChain, spacing: float, region: Sequence[ArrayLike] | None, planes: Array) -> Array:
    """(N, 3) m the points of a cubic grid around the first joint, inside a box or the stretched arm's sphere.

    Where the tip has a fixed coordinate in `planes` (3,), NaN elsewhere, or the box contains no layer of the grid, there is one
    layer.
    """
    centre = chain.base
    if region is None:
        low = centre - chain.reach
        high = centre + chain.reach
    else:
        corners = array("region", cast(ArrayLike, region), 2)
        if corners.shape != (2, 3):
            raise InputError(f"region: expected two opposite corners, shape (2, 3), m, got shape {corners.shape}")
        low = corners.min(axis=0)
        high = corners.max(axis=0)
    first = np.ceil((low - centre) / spacing - 1e-9)
    last = np.floor((high - centre) / spacing + 1e-9)
    in_plane = (low <= planes) & (planes <= high)
    is_layer = in_plane | (first > last)
    counts = np.where(is_layer, 1, last - first + 1)
    if counts.prod() > MAX_POINTS:
        raise InputError(f"spacing: {spacing:g} m makes {counts.prod():.3g} points, expected at most {MAX_POINTS}")
    layers = np.where(in_plane, planes, 0.5 * (low + high)) - centre
    axes = [layers[[k]] if is_layer[k] else spacing * np.arange(first[k], last[k] + 1) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if region is None:
        points = points[np.linalg.norm(points, axis=1) <= chain.reach]
    return points + centre


def _reached(arm: Arm, points: Array, rows: Array, is_oriented: bool) -> tuple[Array, Array]:
    """The fraction of the orientations (M, 12) and the largest manipulability at each of the points (K, 3)."""
    chain = ik_chain(arm)
    targets = np.tile(rows, (len(points), 1))
    targets[:, 9:] = np.repeat(points, len(rows), axis=0)
    q = np.tile(chain.home, (len(targets), 1))
    q0 = q.copy()
    candidates = np.ones(len(targets), bool)
    starts = NUMERICAL_STARTS
    if chain.closed_form is not None and is_oriented:
        candidates = first_solutions(chain, chain.closed_form, targets, chain.home, q)
        starts = 1
    solved = np.zeros(len(targets), bool)
    search = np.flatnonzero(candidates)
    found = q[search]
    outcomes = np.empty((len(search), 4), np.int64)
    chain.core.search(
        targets[search],
        Constraint.POSE if is_oriented else Constraint.POSITION,
        POSITION_TOLERANCE * TOLERANCE_SHARE,
        ORIENTATION_TOLERANCE * TOLERANCE_SHARE,
        q0[search],
        0,
        starts,
        0,
        found,
        outcomes,
    )
    solved[search] = outcomes[:, 0] == 1
    q[search] = found
    index = np.zeros(len(targets))
    index[solved] = _manipulabilities(arm, chain.from_units(q[solved]), 6 if is_oriented else 3)
    shape = (len(points), len(rows))
    return solved.reshape(shape).mean(axis=1), index.reshape(shape).max(axis=1)


def _manipulabilities(arm: Arm, q: Array, rows: int) -> Array:
    """Yoshikawa's manipulability at each of q (N, n), of the first rows of the Jacobian.

    With fewer joints than rows it is sqrt(det(J^T J)) (Yoshikawa, "Manipulability of robotic mechanisms", Int. J. Robotics
    Research 4(2), 1985).
    """
    J = np.empty((len(q), 6, arm.n))
    _core.tip_jacobians(arm.core_model, np.ascontiguousarray(q), J.reshape(len(q), 6 * arm.n))
    J = J[:, :rows]
    J_T = np.swapaxes(J, 1, 2)
    return np.sqrt(np.maximum(np.linalg.det(J @ J_T if arm.n >= rows else J_T @ J), 0.0))
