"""The arm of the data sheet under PD with feedforward: rigid links, dry friction, give of the gears."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EACH = {
    "kp": (6e3, 6e3, 2200, 0.1),
    "kd": (220, 220, 70, 0.15),
    "forward": (0.8, 0.8, 0.8, 0.2),
    "balance": (0.8, 0.8, 0.8, 0.2),
    "motor": (0.6, 0.6, 0.25, 0.15),
    "dry": (8, 8, 4, 0.5),
    "rest": (1.5, 1.5, 0.8, 1),
    "wet": (12, 12, 5, 0.5),
    "give": (4e-5, 4e-5, 1e-4, 0.5),
}
ONE = {
    "m2": (6.0, 0.1),
    "c2": (0.18, 0.1),
    "m3": (5.5, 0.1),
    "c3": (0.15, 0.15),
    "load": (2.0, 0.2),
    "base": (0.15, 0.3),
    "delay": (4e-3, 0.5),
}
NAMES = [f"{name}{k + 1}" for name in EACH for k in range(3)] + list(ONE)
START = np.array([x for value in EACH.values() for x in value[:3]] + [value[0] for value in ONE.values()], dtype=float)
SIZES = START * np.array([value[3] for value in EACH.values() for _ in range(3)] + [s for _, s in ONE.values()])


@numba.njit(cache=False)
def driven(c: Array, step: float, p: Array) -> Array:
    """Positions by set points `s x 3`; steps of about 1 ms, friction and damping implicit."""
    kp, kd, forward, balance, motor, dry, rest, wet, give = (
        p[0:3],
        p[3:6],
        p[6:9],
        p[9:12],
        p[12:15],
        p[15:18],
        p[18:21],
        p[21:24],
        p[24:27],
    )
    m2, c2, m3, c3, load, base, delay = p[27], p[28], p[29], p[30], p[31], p[32], p[33]
    k2, k3 = np.sqrt(0.09 / 6.0), np.sqrt(0.08 / 5.5)
    weights = np.array([m2 / 2, m2 / 2, m3 / 2, m3 / 2, load])
    along = np.array([c2 - k2, c2 + k2, c3 - k3, c3 + k3, 0.42])
    parts = max(round(step / 1e-3), 1)
    h, lead = step / parts, 500
    found, q, v = np.empty_like(c), c[0].copy(), np.zeros(3)
    before, fed = c[0].copy(), np.zeros(3)
    m, free = np.zeros((3, 3)), np.zeros((3, 3))
    bias, weight, bent, ref, whole, push, most, brake, new = np.zeros((9, 3))
    for i in range(-lead, (len(c) - 1) * parts + 1):
        late = min(max((i * h - delay) / step, 0.0), len(c) - 1.0)
        k = int(late)
        for n in range(3):
            ref[n] = c[k, n] + (late - k) * (c[min(k + 1, len(c) - 1), n] - c[k, n])
            fed[n] += h / (h + 1e-3) * ((ref[n] - before[n]) / h - fed[n])
            before[n] = ref[n]
        m[:], bias[:], weight[:] = 0.0, 0.0, 0.0
        m[0, 0] = base
        er, ez = 0.4 * np.cos(q[1]), 0.4 * np.sin(q[1])
        for n in range(5):
            # Of a point: where it is, what the joints make of that, and the acceleration that speeds alone give it.
            second = n >= 2
            angle = q[1] + q[2] if second else q[1]
            ur, uz = along[n] * np.cos(angle), along[n] * np.sin(angle)
            turn = v[1] + v[2] if second else v[1]
            ar, az = -(turn**2) * ur, -(turn**2) * uz
            r, z, r3, z3 = ur, uz, 0.0, 0.0
            if second:
                r, z, r3, z3 = ur + er, uz + ez, -uz, ur
                ar, az = ar - v[1] ** 2 * er, az - v[1] ** 2 * ez
            w, ar = weights[n], ar - r * v[0] ** 2
            m[0, 0] += w * r * r
            m[1, 1] += w * (r * r + z * z)
            m[1, 2] += w * (-z * r3 + r * z3)
            m[2, 2] += w * (r3 * r3 + z3 * z3)
            bias[0] += 2 * w * r * v[0] * (-z * v[1] + r3 * v[2])
            bias[1] += w * (-z * ar + r * az)
            bias[2] += w * (r3 * ar + z3 * az)
            weight[1] += w * 9.81 * r
            weight[2] += w * 9.81 * z3
        m[2, 1] = m[1, 2]
        held3 = 9.81 * (5.5 * 0.15 + 2.0 * 0.42) * np.cos(ref[1] + ref[2])
        held2 = 9.81 * (6.0 * 0.18 + 7.5 * 0.4) * np.cos(ref[1]) + held3
        for n in range(3):
            whole[n] = m[n, n] + motor[n] + h * (wet[n] + kd[n])
            held = 0.0 if n == 0 else held2 if n == 1 else held3
            push[n] = (
                m[n, 0] * v[0]
                + m[n, 1] * v[1]
                + m[n, 2] * v[2]
                + motor[n] * v[n]
                + h * (kp[n] * (ref[n] - q[n]) + kd[n] * forward[n] * fed[n] + balance[n] * held - bias[n] - weight[n])
            )
            most[n], brake[n] = h * max(dry[n] + rest[n] * np.exp(-((v[n] / 0.05) ** 2)), 0.0), 0.0
        below = whole[1] * whole[2] - m[1, 2] ** 2
        free[0, 0], free[1, 1], free[2, 2] = 1 / whole[0], whole[2] / below, whole[1] / below
        free[1, 2] = free[2, 1] = -m[1, 2] / below
        for n in range(3):
            new[n] = free[n, 0] * push[0] + free[n, 1] * push[1] + free[n, 2] * push[2]
        for _ in range(3):
            for n in range(3):
                wish = min(max(brake[n] + new[n] / free[n, n], -most[n]), most[n])
                for other in range(3):
                    new[other] -= free[other, n] * (wish - brake[n])
                brake[n] = wish
        for n in range(3):
            bent[n] = bias[n] + weight[n]
            for other in range(3):
                bent[n] += m[n, other] * (new[other] - v[other]) / h
        v[:] = new
        if i >= 0 and i % parts == 0:
            for n in range(3):
                found[i // parts, n] = q[n] - give[n] * bent[n]
        for n in range(3):
            q[n] += h * v[n]
    return found


class ARM:
    parameters: ClassVar[dict[str, float]] = dict(zip(NAMES, START.tolist(), strict=True))

    def simulate(self, time: Array, commands: Array, parameters: Mapping[str, float]) -> Array:
        step = (time[-1] - time[0]) / (len(time) - 1)
        numbers = np.array([float(parameters[name]) for name in NAMES])
        return np.asarray(driven(np.ascontiguousarray(commands), step, numbers))
