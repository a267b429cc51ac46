"""The bare step as others would write it: plain C++, NumPy, numba. Each steps a sheet and gives its positions."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.sheets import ALPHA, PRESSURE, THICKNESS, Array, C, Sheet

Stepper = Callable[[int], Array]


@cache
def load_functions(name: str) -> ctypes.CDLL | None:
    """The functions of a C++ file in this folder, compiled; None where there is no compiler."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    folder = Path(tempfile.mkdtemp(prefix="jaxform-bench-"))
    source, target = Path(__file__).with_name(f"{name}.cpp"), folder / f"{name}.so"
    command = [compiler, "-std=c++20", "-O3", "-march=native", "-shared", "-fPIC", str(source), "-o", str(target)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(target))


def cpp(sheet: Sheet, dtype: Any = np.float64) -> Stepper | None:
    """The plain C++ loop; None where there is no compiler."""
    compiled = load_functions("bare")
    if compiled is None:
        return None
    real = ctypes.c_double if dtype == np.float64 else ctypes.c_float
    function = compiled.steps_float64 if dtype == np.float64 else compiled.steps_float32

    def step(count: int) -> Array:
        x = np.array(sheet.positions, dtype, order="C")
        fixed = [np.ascontiguousarray(a, dtype) for a in (sheet.metric, sheet.area * THICKNESS, sheet.compliance)]
        arrays = [np.ascontiguousarray(sheet.triangles), *fixed, x, np.zeros_like(x), np.zeros_like(x)]
        function(
            ctypes.c_long(len(sheet.triangles)),
            ctypes.c_long(len(x)),
            *(a.ctypes.data_as(ctypes.c_void_p) for a in arrays),
            *(real(value) for value in (C, ALPHA, PRESSURE, sheet.step)),
            ctypes.c_long(count),
        )
        return x

    return step


def with_numpy(sheet: Sheet) -> Stepper:
    """Whole arrays, the shares summed by bincount."""
    triangles, weight = sheet.triangles, sheet.area * THICKNESS
    r11, r12, r22 = sheet.metric.T

    def step(count: int) -> Array:
        x, v = sheet.positions.copy(), np.zeros_like(sheet.positions)
        for _ in range(count):
            a, b, d = (x[triangles[:, k]] for k in range(3))
            u, w = b - a, d - a
            g11, g12, g22 = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, w), (w, w)))
            trace, area = r11 * g11 + 2 * r12 * g12 + r22 * g22, r11 * r22 - r12 * r12
            thinning = 1 / ((g11 * g22 - g12 * g12) * area)
            first, second = 2 * C * weight, 2 * C * ALPHA * weight
            one = first + second * thinning
            two = area * (second - thinning * thinning * (first + second * trace))
            s11, s12, s22 = one * r11 + two * g22, one * r12 - two * g12, one * r22 + two * g11
            push = PRESSURE / 6 * np.cross(u, w)
            pull2, pull3 = s11[:, None] * u + s12[:, None] * w, s12[:, None] * u + s22[:, None] * w
            shares = np.stack([push + pull2 + pull3, push - pull2, push - pull3], axis=1).reshape(-1, 3)
            nodal = [np.bincount(triangles.ravel(), shares[:, k], len(x)) for k in range(3)]
            v += sheet.step * np.stack(nodal, axis=1) * sheet.compliance
            x += sheet.step * v
        return x

    return step


def with_numba(sheet: Sheet) -> Stepper | None:
    """The plain loop compiled by numba; None where it is not installed."""
    try:
        import numba
    except ImportError:
        return None
    loop = numba.njit(fastmath=False)(_loop)
    weight = sheet.area * THICKNESS

    def step(count: int) -> Array:
        x = sheet.positions.copy()
        loop(sheet.triangles, sheet.metric, weight, sheet.compliance, x, np.zeros_like(x), sheet.step, count)
        return x

    return step


def _loop(triangles: Any, metric: Any, weight: Any, compliance: Any, x: Any, v: Any, dt: float, count: int) -> None:
    force = np.zeros_like(x)
    p = PRESSURE / 6
    for _ in range(count):
        force[:] = 0.0
        for e in range(len(triangles)):
            a, b, d = triangles[e, 0], triangles[e, 1], triangles[e, 2]
            u0, u1, u2 = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            w0, w1, w2 = x[d, 0] - x[a, 0], x[d, 1] - x[a, 1], x[d, 2] - x[a, 2]
            g11, g12, g22 = u0 * u0 + u1 * u1 + u2 * u2, u0 * w0 + u1 * w1 + u2 * w2, w0 * w0 + w1 * w1 + w2 * w2
            r11, r12, r22 = metric[e, 0], metric[e, 1], metric[e, 2]
            trace, area = r11 * g11 + 2 * r12 * g12 + r22 * g22, r11 * r22 - r12 * r12
            thinning = 1 / ((g11 * g22 - g12 * g12) * area)
            first, second = 2 * C * weight[e], 2 * C * ALPHA * weight[e]
            one = first + second * thinning
            two = area * (second - thinning * thinning * (first + second * trace))
            s11, s12, s22 = one * r11 + two * g22, one * r12 - two * g12, one * r22 + two * g11
            n0, n1, n2 = p * (u1 * w2 - u2 * w1), p * (u2 * w0 - u0 * w2), p * (u0 * w1 - u1 * w0)
            h0, h1, h2 = s11 * u0 + s12 * w0, s11 * u1 + s12 * w1, s11 * u2 + s12 * w2
            k0, k1, k2 = s12 * u0 + s22 * w0, s12 * u1 + s22 * w1, s12 * u2 + s22 * w2
            force[a, 0] += n0 + h0 + k0
            force[a, 1] += n1 + h1 + k1
            force[a, 2] += n2 + h2 + k2
            force[b, 0] += n0 - h0
            force[b, 1] += n1 - h1
            force[b, 2] += n2 - h2
            force[d, 0] += n0 - k0
            force[d, 1] += n1 - k1
            force[d, 2] += n2 - k2
        for i in range(len(x)):
            for k in range(3):
                v[i, k] += dt * force[i, k] * compliance[i, k]
                x[i, k] += dt * v[i, k]
