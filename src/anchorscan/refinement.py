"""Poses moved until readings lie on surfaces: Gauss-Newton on the distances that the map tells.

Distances are robust: a reading far from all surfaces pulls at nothing.
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import inlined, kernel
from .tiles import FAR, cell_code, index_of, note_place

__all__ = ["descended", "normal_equations", "put_hessian", "refined"]

_CODE = np.uint8(FAR)
_1, _64 = np.uint64(1), np.uint64(64)


@inlined
def _corners(pose, room, tiles):  # type: ignore[no-untyped-def]
    """For each reading the arm from the pose, the place in a square of four cells, their codes.

    Two loops, as in ``look_up``.
    """
    across, up, places, codes, numbers = room
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(across)):
        rx, ry = c * across[i] - s * up[i], s * across[i] + c * up[i]
        gx = (pose[0] + rx) / tiles.resolution - tiles.column - 0.5
        gy = (pose[1] + ry) / tiles.resolution - tiles.row - 0.5
        cx, cy = np.int32(gx), np.int32(gy)
        numbers[0, i], numbers[1, i] = rx, ry
        numbers[2, i], numbers[3, i] = gx - cx, gy - cy
        note_place(cx, cy, tiles, places, i)
    for i in range(len(across)):
        at = index_of(tiles, places, i)
        place = places[2, i]
        codes[0, i] = tiles.codes[at]
        if place & 63 != 63 and place >> 6 != 63:
            # All four cells lie in one tile, as they do for 97 readings of 100.
            codes[1, i] = tiles.codes[at + _1]
            codes[2, i] = tiles.codes[at + _64]
            codes[3, i] = tiles.codes[at + _64 + _1]
        else:
            v, u = place >> 6, place & 63
            v += (places[0, i] // tiles.width << 12) + (places[1, i] >> 6 << 6)
            u += (places[0, i] % tiles.width << 12) + ((places[1, i] & 63) << 6)
            codes[1, i] = cell_code(tiles, u + 1, v)
            codes[2, i] = cell_code(tiles, u, v + 1)
            codes[3, i] = cell_code(tiles, u + 1, v + 1)


@inlined
def _gradients(room, tiles, scale):  # type: ignore[no-untyped-def]
    """Distance to the nearest surface and its gradient at each reading, and its weight.

    Bilinear, in metres; the gradient is by x, y and the turn of the pose.  The weights are those
    of Geman and McClure, and zero where no surface is near.
    """
    _, _, _, codes, numbers = room
    unit = tiles.reach / FAR
    for i in range(len(codes[0])):
        fx, fy = numbers[2, i], numbers[3, i]
        a, b = (codes[0, i] & _CODE) * unit, (codes[1, i] & _CODE) * unit
        c, d = (codes[2, i] & _CODE) * unit, (codes[3, i] & _CODE) * unit
        value = (a * (1.0 - fx) + b * fx) * (1.0 - fy) + (c * (1.0 - fx) + d * fx) * fy
        dx = ((b - a) * (1.0 - fy) + (d - c) * fy) / tiles.resolution
        dy = ((c - a) * (1.0 - fx) + (d - b) * fx) / tiles.resolution
        weight = 1.0 / (1.0 + (value / scale) ** 2)
        numbers[4, i], numbers[5, i], numbers[6, i] = value, dx, dy
        numbers[7, i] = weight * weight if value < 0.9 * tiles.reach else 0.0


@kernel
def normal_equations(pose, room, tiles, scale):  # type: ignore[no-untyped-def]
    """Gauss-Newton terms of the robust distances of points to surfaces.

    Returns the upper triangle of the Hessian, row by row, the gradient, the weighted sum of
    squared distances and the sum of weights (Geman-McClure weights of the given scale).
    """
    _corners(pose, room, tiles)
    _gradients(room, tiles, scale)
    numbers = room[4]
    xx, xy, xt, yy, yt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x, y, t = 0.0, 0.0, 0.0
    squares, total = 0.0, 0.0
    for i in range(numbers.shape[1]):
        value, dx, dy, weight = numbers[4, i], numbers[5, i], numbers[6, i], numbers[7, i]
        dt = dy * numbers[0, i] - dx * numbers[1, i]
        x += weight * dx * value
        y += weight * dy * value
        t += weight * dt * value
        xx += weight * dx * dx
        xy += weight * dx * dy
        xt += weight * dx * dt
        yy += weight * dy * dy
        yt += weight * dy * dt
        tt += weight * dt * dt
        squares += weight * value * value
        total += weight
    return (xx, xy, xt, yy, yt, tt), (x, y, t), squares, total


@kernel
def put_hessian(triangle, hessian):  # type: ignore[no-untyped-def]
    """Write a Hessian of which the upper triangle is known into a (3, 3) array."""
    xx, xy, xt, yy, yt, tt = triangle
    hessian[0, 0], hessian[1, 1], hessian[2, 2] = xx, yy, tt
    hessian[0, 1] = hessian[1, 0] = xy
    hessian[0, 2] = hessian[2, 0] = xt
    hessian[1, 2] = hessian[2, 1] = yt


@kernel
def _solved(h, g, damping):  # type: ignore[no-untyped-def]
    """Solve the damped symmetric 3 x 3 system by Cramer's rule; ``h`` is its upper triangle."""
    a, b, c, d, e, f = h
    a, d, f = a + damping, d + damping, f + damping
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * p + b * q + c * r
    x = (p * g[0] + q * g[1] + r * g[2]) / determinant
    y = (q * g[0] + (a * f - c * c) * g[1] + (b * c - a * e) * g[2]) / determinant
    z = (r * g[0] + (b * c - a * e) * g[1] + (a * d - b * b) * g[2]) / determinant
    return x, y, z


@kernel
def descended(pose, hessian, gradient):  # type: ignore[no-untyped-def]
    """Move a (3,) pose by one damped step of 10 cm at most; tell whether it hardly moved."""
    x, y, theta = _solved(hessian, gradient, 1.0)
    size = math.hypot(x, y)
    share = 1.0 if size < 0.1 else 0.1 / size
    pose[0] -= share * x
    pose[1] -= share * y
    pose[2] -= share * theta
    return size < 0.002 and abs(theta) < 0.0005


@kernel
def refined(pose, room, tiles, iterations):  # type: ignore[no-untyped-def]
    """Move a (3,) pose so that points lie on surfaces: damped Gauss-Newton, bounded steps."""
    moved = pose.copy()
    for step in range(iterations):
        # From coarse to fine: wide weights first, so that the pose can still travel.
        scale = 0.2 if 2 * step < iterations else 0.1
        hessian, gradient, _, _ = normal_equations(moved, room, tiles, scale)
        if descended(moved, hessian, gradient) and 2 * step >= iterations:
            break
    return moved
