"""Wendland's C2 kernel in three dimensions and what becomes of it at a plane wall.

All functions take the smoothing length h [m]; the support is 2 h. With u = 1 - s / (2 h) for a plane at distance s:
area integral `w1`, filled share `gamma`, first moment `moment` (Wendland 1995; Ferrand et al. 2013 for gamma).
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

SUPPORT = 2.0  # smoothing lengths to which the kernel reaches


@njit(cache=True, error_model="numpy")
@no_type_check
def slope_factor(h):
    """Constant c of `W'(r) / r = c (1 - r / 2h)^3` [1/m^5]."""
    return -105.0 / (16.0 * math.pi * h**5)


def kernel(r: Float[np.ndarray, "*shape"], h: float) -> Float[np.ndarray, "*shape"]:
    """W(r) = 21 / (16 pi h^3) (1 - q/2)^4 (2 q + 1), q = r / h < 2 [1/m3]."""
    t = np.maximum(1.0 - 0.5 * r / h, 0.0)
    return 21.0 / (16.0 * math.pi * h**3) * t**4 * (2.0 * r / h + 1.0)


def kernel_slope(r: Float[np.ndarray, "*shape"], h: float) -> Float[np.ndarray, "*shape"]:
    """W'(r) / r [1/m5]: the gradient of W(|x|) is this times x."""
    return slope_factor(h) * np.maximum(1.0 - 0.5 * r / h, 0.0) ** 3


def plane_area(s: Float[np.ndarray, "*shape"], h: float) -> Float[np.ndarray, "*shape"]:
    """Integral of W over a plane at distance s [1/m]: the size of grad gamma at a plane wall."""
    u = np.maximum(1.0 - 0.5 * np.abs(s) / h, 0.0)
    return 10.5 / h * u**5 * (1.0 - 1.5 * u + 4.0 / 7.0 * u**2)


def plane_beyond(s: Float[np.ndarray, "*shape"], h: float) -> Float[np.ndarray, "*shape"]:
    """Integral of W beyond a plane at distance s >= 0 [-]: one minus gamma."""
    u = np.maximum(1.0 - 0.5 * s / h, 0.0)
    return 21.0 * u**6 * (1.0 / 6.0 - 1.5 / 7.0 * u + u**2 / 14.0)


def plane_moment(s: Float[np.ndarray, "*shape"], h: float) -> Float[np.ndarray, "*shape"]:
    """Integral of `n.(x' - x) n.grad W` beyond a plane at distance s >= 0 [-]: the share of a linear field's slope
    that a particle does not see because of the wall; 1/2 at the wall, 0 from 2 h on."""
    return s * plane_area(s, h) + plane_beyond(s, h)
