"""Closed forms that several parallel mechanisms share: real roots, input links, intersections of spheres."""

from __future__ import annotations

import torch
from torch import Tensor


def real_sqrt(square: Tensor) -> tuple[Tensor, Tensor]:
    """Square root, any shape, and where it is real (bool); elsewhere 0.

    What follows from a root that is not real is set to NaN last, by the mask: a NaN on the way, times a zero gradient,
    would become the gradient of everything that the rows share.
    """
    real = square >= 0
    return torch.where(real, torch.sqrt(torch.where(real, square, 1.0)), 0.0), real


def real_acos(cosine: Tensor) -> tuple[Tensor, Tensor]:
    """Arc cosine, any shape [rad], and where it is real (bool); elsewhere 0. See `real_sqrt`."""
    real = cosine.abs() <= 1
    return torch.where(real, torch.acos(torch.where(real, cosine, 0.0)), 0.0), real


def upward_angle(x: Tensor, y: Tensor) -> Tensor:
    """Angle of the direction (x, y) from +x, `...` [rad] in (-pi/2, 3 pi/2]: it jumps straight below, not at the left.

    A gain acts on the angle itself and not on its sine: the angle must be continuous over the workspace above.
    """
    return torch.atan2(-x, y) + torch.pi / 2


def crank_angle(cosine: Tensor, sine: Tensor, constant: Tensor, side: float | Tensor) -> Tensor:
    """Solve cosine * cos(b) + sine * sin(b) + constant = 0; `...` each, any common unit.

    With t = tan(b/2) this is the quadratic whose roots are printed as b = 2 arctan((-B ± √(B² - C² + A²)) / (C - A)),
    (Sun et al. 2018, eq. 13); the form used here, the direction of (A, B) less or plus an arc cosine, has no pole at
    C = A.

    Args:
        side: -1 for the root with + before the square root, +1 for the one with -.

    Returns:
        `...` [rad]; NaN where there is no real root.
    """
    away, real = real_acos(-constant / torch.hypot(cosine, sine))
    return torch.where(real, upward_angle(cosine, sine) + side * away, torch.nan)


def meeting_point(centres: Tensor, radii: Tensor, below: bool) -> Tensor:
    """Point at given distances from three centres.

    Args:
        centres: `... x 3 x 3` [m], counter-clockwise seen from above.
        radii: `... x 3` [m].
        below: which of the two points: the one below the plane of the centres, or above.

    Returns:
        `... x 3` [m]; NaN where the spheres do not meet.
    """
    first, second, third = centres.unbind(-2)
    r1, r2, r3 = radii.unbind(-1)
    u, v = second - first, third - first
    # The point is first + a u + b v + c n with n = u x v; the differences of the spheres' equations give a and b.
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    area = uu * vv - uv**2
    along_u, along_v = (r1**2 - r2**2 + uu) / 2, (r1**2 - r3**2 + vv) / 2
    a, b = (vv * along_u - uv * along_v) / area, (uu * along_v - uv * along_u) / area
    normal = torch.linalg.cross(u, v, dim=-1)
    foot = a[..., None] * u + b[..., None] * v
    height, real = real_sqrt((r1**2 - (foot * foot).sum(-1)) / area)
    point = first + foot + (-height if below else height)[..., None] * normal
    return torch.where(real[..., None], point, torch.nan)
