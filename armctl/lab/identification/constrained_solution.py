"""Least squares whose links are physically consistent, and whose friction is not negative."""

from typing import Any

import numpy as np

from armctl.core.validation import Array
from armctl.lab.identification.pseudo_inertia import PARAMETERS, from_log_cholesky, is_consistent, regularized, to_log_cholesky
from armctl.lab.identification.regressor import ArmRegressor

_MIN_MASS_KG = 1e-6
_MIN_LENGTH_M = 1e-4
_MAX_EVALUATIONS = 80
_DIAGONAL = 4  # of a Cholesky factor's ten parameters
# Standard deviation of the logarithm of a link's size before any data. It keeps links away from points and rods, which no
# simulator accepts.
_LOG_SIZE_PRIOR = 1.0


def constrained_solution(
    weighted: Array, targets: Array, linear: Array, regressor: ArmRegressor, prior: Array, consistent: bool
) -> Array:
    """(p,) parameters by least squares; friction and rotor inertias at least 0; physically consistent links on request.

    Args:
        weighted: (k, p), the regressor in units of the noise, for each standard deviation of the prior.
        targets: (k,), what the start of the parameters leaves of the torques, in units of the noise.
        linear: (p,), the solution without bounds.
        regressor: The start of the parameters, and what they are.
        prior: (p,), standard deviations before any data.
        consistent: Whether each link must be physically consistent.
    """
    from scipy.optimize import least_squares

    layout = regressor.layout
    n = layout.n
    positive = np.zeros(layout.size, bool)
    for part in (layout.rotor, layout.viscous, layout.coulomb, layout.stribeck):
        positive[part] = True
    links = [linear[layout.link(i)] for i in range(n)]
    all_consistent = not consistent or all(is_consistent(link) for link in links)
    if all_consistent and (linear[positive] >= 0).all():
        return linear
    start = regressor.start
    R: Any = np.linalg.qr(np.column_stack([weighted, targets]), mode="r")
    A = R[:, :-1]
    b = R[:, -1]

    def parameters(z: Array) -> Array:
        if not consistent:
            return z
        x = z.copy()
        for i in range(n):
            x[layout.link(i)] = from_log_cholesky(z[layout.link(i)])[0]
        return x

    def residual(z: Array) -> Array:
        dx = (parameters(z) - start) / prior
        return np.concatenate([A @ dx - b, dx, (z - first)[sizes] / _LOG_SIZE_PRIOR])

    def jacobian(z: Array) -> Array:
        change = np.eye(layout.size) / prior[:, None]
        for i in range(n if consistent else 0):
            link = layout.link(i)
            change[link, link] = from_log_cholesky(z[link])[1] / prior[link, None]
        return np.vstack([A @ change, change, np.eye(layout.size)[sizes] / _LOG_SIZE_PRIOR])

    z = np.maximum(linear, 1e-6 * prior)
    z[~positive] = start[~positive]
    for i in range(n if consistent else 0):
        z[layout.link(i)] = to_log_cholesky(regularized(start[layout.link(i)], _MIN_MASS_KG, _MIN_LENGTH_M))
    first = z.copy()
    sizes = np.flatnonzero(np.arange(layout.size) % PARAMETERS < _DIAGONAL)  # the logarithms in the Cholesky factors
    sizes = sizes[sizes < layout.rotor.start] if consistent else sizes[:0]
    low = np.where(positive, 0.0, -np.inf)
    solve: Any = least_squares  # its stubs demand a name for the Jacobian
    found = solve(residual, z, jacobian, bounds=(low, np.inf), x_scale="jac", max_nfev=_MAX_EVALUATIONS, ftol=1e-7, xtol=1e-9)
    return parameters(found.x)
