r"""Emitted power: how loud the surface at the end of each beam is. Eq. (3).

The scan stage says how loud each bearing is *where the robot stands*. This room undoes the loss
of level along the path, so that visits from near and far describe the same surface alike. It
knows neither poses nor grids.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from soundmap.geometry import FloatArray


def emitted_power(
    received: ArrayLike, ranges: ArrayLike, *, alpha: float, d_min: float, d_max: float
) -> FloatArray:
    r"""Power emitted by the surface that each beam meets, Eq. (3).

    .. math:: C_n = J_n (\rho_n / d_{min})^{\alpha}, \quad d_{min} \le \rho_n \le d_{max}

    Parameters
    ----------
    received : array_like, shape (..., N)
        :math:`J_n`, steered response power on bearing n [linear], >= 0.
    ranges : array_like, shape (..., N)
        :math:`\rho_n`, distance to the first surface on bearing n [m]; NaN or inf where the ray
        meets none.
    alpha : float
        Decay exponent [-]; 2 for free-field spherical spreading.
    d_min, d_max : float
        Range over which the decay law is trusted [m], 0 < d_min < d_max.

    Returns
    -------
    ndarray, shape (..., N)
        :math:`C_n`, power referred to distance d_min [unit of `received`]. NaN outside
        [d_min, d_max]: "not measured" is not "silent".

    Raises
    ------
    ValueError
        If not 0 < d_min < d_max.

    Examples
    --------
    >>> emitted_power([1.0, 1.0, 1.0], [1.0, 2.0, 9.0], alpha=2.0, d_min=1.0, d_max=5.0)
    array([ 1.,  4., nan])
    """
    if not 0.0 < d_min < d_max:
        raise ValueError(f"need 0 < d_min < d_max, got d_min={d_min}, d_max={d_max}")
    received, ranges = np.asarray(received, dtype=np.float64), np.asarray(ranges, dtype=np.float64)
    trusted = (ranges >= d_min) & (ranges <= d_max)
    path_loss = (np.where(trusted, ranges, d_min) / d_min) ** alpha
    return np.where(trusted, received * path_loss, np.nan)
