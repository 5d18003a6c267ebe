"""The renderer's hot loops, compiled by numba when this module is imported, and kept on disk.

They are written out in numpy's order of operations, and without fast mathematics: a picture is the
same to the bit wherever it is drawn. What is kept is as old as this file, so one file has all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Words = NDArray[np.uint16]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
Loop = TypeVar("Loop", bound=Callable[..., Any])


def _compiled(signature: str) -> Callable[[Loop], Loop]:
    def compiled(loop: Loop) -> Loop:
        how: dict[str, Any] = {"error_model": "numpy", "nogil": True}
        try:
            return cast("Loop", numba.njit(signature, cache=True, **how)(loop))
        except RuntimeError:  # no folder for it may be written: each process compiles anew
            return cast("Loop", numba.njit(signature, **how)(loop))

    return compiled


def _within(loop: Loop) -> Loop:
    """Compiled as a part of those that call it."""
    return cast("Loop", numba.njit(error_model="numpy")(loop))


STEP_PX = 8.0  # longest straight piece of an outline: the lens bends it by less than 1e-4 px
MARGIN_PX = 16.0  # beyond the image, where outlines are cut off; more than STEP_PX
NEARLY_ALL = 1.0 - 1e-9
NOTHING = 1e-4  # less cover than this is no cover


@_compiled("b1(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i8, f8)")
def undistort(
    x_d: Floats, y_d: Floats, kc: Floats, x: Floats, y: Floats, steps: int, enough: float
) -> bool:
    """Newton's iteration from ``x`` and ``y`` (n,) on, until each one's last step is small
    enough: whether it came to that.
    """
    k1, k2, p1, p2, k3 = kc
    for _ in range(steps):
        far = 0
        for i in range(len(x)):
            u, v = x[i], y[i]
            r2 = u * u + v * v
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # d radial / d r2, twice
            uv = u * v
            miss_u = u * radial + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u * u) - x_d[i]
            miss_v = v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * uv - y_d[i]
            uu = radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u
            vv = radial + slope * v * v + 6.0 * p1 * v + 2.0 * p2 * u
            cross = slope * uv + 2.0 * p1 * u + 2.0 * p2 * v
            scale = 1.0 / (uu * vv - cross * cross)
            step_u = (vv * miss_u - cross * miss_v) * scale
            step_v = (uu * miss_v - cross * miss_u) * scale
            x[i], y[i] = u - step_u, v - step_v
            far += not (abs(step_u) < enough and abs(step_v) < enough)
        if not far:
            return True
    return False


@_compiled("f8[:, :, ::1](f8[:, ::1], f8[:, ::1])")
def rings(placed: Floats, circle: Floats) -> Floats:
    """Circles of ``circle`` (m, 2) in the ideal plane, (k, m, 2). ``placed`` (k, 10): centre,
    radius, and two unit vectors across.
    """
    seen = np.empty((len(placed), len(circle), 2))
    for i in range(len(placed)):
        c_x, c_y, c_z, radius, u_x, u_y, u_z, v_x, v_y, v_z = placed[i]
        for j in range(len(circle)):
            cos, sin = circle[j]
            z = c_z + radius * (cos * u_z + sin * v_z)
            seen[i, j, 0] = (c_x + radius * (cos * u_x + sin * v_x)) / z
            seen[i, j, 1] = (c_y + radius * (cos * u_y + sin * v_y)) / z
    return seen


@_compiled("Tuple((i8[::1], f8[:, ::1]))(i8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def distorted(
    counts: Ints, corners: Floats, lens: Floats, window: Floats, size: Floats
) -> tuple[Ints, Floats]:
    """Closed outlines of ``counts`` corners (n, 2) in the ideal plane, in pieces of STEP_PX, those
    near the image kept: how many pieces each, and their starts (m, 2) as the lens puts them, from
    the first pixel's corner, px.
    """
    fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = lens
    pieces = np.empty(len(corners), np.int64)
    parts = np.empty(len(counts), np.int64)
    first = 0
    for i in range(len(counts)):
        stop, parts[i] = first + counts[i], 0
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            x = (corners[after, 0] - corners[j, 0]) * fx
            y = (corners[after, 1] - corners[j, 1]) * fy
            pieces[j] = int(max(np.ceil(np.sqrt(x * x + y * y) / STEP_PX), 1.0))
            parts[i] += pieces[j]
        first = stop
    points = np.empty((parts.sum(), 2))
    first, at = 0, 0
    for i in range(len(counts)):
        stop = first + counts[i]
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            step_x = (corners[after, 0] - corners[j, 0]) / pieces[j]
            step_y = (corners[after, 1] - corners[j, 1]) / pieces[j]
            for part in range(pieces[j]):
                x = min(max(corners[j, 0] + part * step_x, window[0, 0]), window[1, 0])
                y = min(max(corners[j, 1] + part * step_y, window[0, 1]), window[1, 1])
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
                v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
                u, v = fx * (u + skew * v) + cx, fy * v + cy
                points[at, 0] = min(max(u + 0.5, -MARGIN_PX), size[0] + MARGIN_PX)
                points[at, 1] = min(max(v + 0.5, -MARGIN_PX), size[1] + MARGIN_PX)
                at += 1
        first = stop
    return parts, points


@_within
def _edge(
    number: int,
    x: float,
    y: float,
    to_x: float,
    to_y: float,
    base: int,
    width: int,
    change: Floats,
    spill: Floats,
) -> None:
    """Adds an edge's signed areas, pixel by pixel, to a window ``width`` wide whose pixel (0, 0)
    would be at ``base``: what changes at a pixel, and at the next one.
    """
    way_x, way_y = to_x - x, to_y - y
    # lines between pixels that it crosses: the next ones, and how many are left
    low_x, low_y = np.floor(min(x, to_x)), np.floor(min(y, to_y))
    left_x = int(max(np.ceil(max(x, to_x)) - low_x - 1.0, 0.0))
    left_y = int(max(np.ceil(max(y, to_y)) - low_y - 1.0, 0.0))
    turn_x, turn_y = 1.0 if way_x > 0.0 else -1.0, 1.0 if way_y > 0.0 else -1.0
    line_x = low_x + (1.0 if way_x > 0.0 else left_x)
    line_y = low_y + (1.0 if way_y > 0.0 else left_y)
    here_x, here_y, last = x, y, False
    while not last:
        part_x = min((line_x - x) / way_x, NEARLY_ALL) if left_x else np.inf
        part_y = min((line_y - y) / way_y, NEARLY_ALL) if left_y else np.inf
        if left_x and part_x <= part_y:
            part, left_x, line_x = part_x, left_x - 1, line_x + turn_x
        elif left_y:
            part, left_y, line_y = part_y, left_y - 1, line_y + turn_y
        else:
            part, last = 1.0, True
        part = (number + part) - number  # as exact as one sort of all edges' crossings was
        there_x = to_x if last else x + part * way_x
        there_y = to_y if last else y + part * way_y
        middle = 0.5 * (here_x + there_x)
        column = np.floor(middle)
        cell = base + int(np.floor(0.5 * (here_y + there_y))) * width + int(column)
        rise = there_y - here_y
        right = rise * (middle - column)
        change[cell] += rise - right
        spill[cell + 1] += right
        here_x, here_y = there_x, there_y


@_compiled("Tuple((i8[:, ::1], f8[::1]))(i8[::1], f8[:, ::1], i8, i8)")
def areas(counts: Ints, points: Floats, wide: int, tall: int) -> tuple[Ints, Floats]:
    """Which share of each pixel closed outlines of ``counts`` points (n, 2) cover: (3, m) outline,
    row, column, and shares (m,), by outline. Signed areas in windows, whose rows sum to zero.
    """
    windows = np.empty((len(counts), 4), np.int64)
    cells, first = 0, 0
    for i in range(len(counts)):
        low_x, low_y = points[first]
        high_x, high_y = low_x, low_y
        for j in range(first, first + counts[i]):
            low_x, high_x = min(low_x, points[j, 0]), max(high_x, points[j, 0])
            low_y, high_y = min(low_y, points[j, 1]), max(high_y, points[j, 1])
        left, top = int(np.floor(low_x)), int(np.floor(low_y))
        windows[i, 0], windows[i, 1] = left, int(np.floor(high_x)) + 2
        windows[i, 2], windows[i, 3] = top, int(np.floor(high_y)) + 1
        cells += (windows[i, 1] - left) * (windows[i, 3] - top)
        first += counts[i]
    change, spill = np.zeros(cells + 1), np.zeros(cells + 1)
    cells, first = 0, 0
    for i in range(len(counts)):
        left, right, top, bottom = windows[i]
        base = cells - top * (right - left) - left
        stop = first + counts[i]
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            x, y = points[after]
            _edge(j, points[j, 0], points[j, 1], x, y, base, right - left, change, spill)
        cells += (right - left) * (bottom - top)
        first = stop
    places, shares = np.empty((3, cells), np.int64), np.empty(cells)
    cell, at, sum_ = 0, 0, 0.0
    for i in range(len(counts)):
        left, right, top, bottom = windows[i]
        for row in range(top, bottom):
            for column in range(left, right):
                sum_ += change[cell] + spill[cell]
                share = min(abs(sum_), 1.0)
                cell += 1
                if share > NOTHING and 0 <= row < tall and 0 <= column < wide:
                    places[0, at], places[1, at], places[2, at] = i, row, column
                    shares[at] = share
                    at += 1
    return places[:, :at].copy(), shares[:at].copy()


@_compiled("void(f8[:, ::1], i8[:], f8[::1], f8[::1], f8[::1], f8[:, ::1], b1[::1])")
def meet(
    columns: Floats, which: Ints, x: Floats, y: Floats, depth: Floats, normal: Floats, hit: Bools
) -> None:
    """Ray (x, y, 1) with solid ``which``, (n,) each: fills depth (n,), normal (3, n), hit (n,).
    ``columns`` (k, 23): axis, qb by ray (3), bend, h0, qc, slope, radius_0, low, high, a,
    b, both radii, and whether each end is flat.
    """
    for i in range(len(which)):
        solid, u, v = columns[which[i]], x[i], y[i]
        axis_x, axis_y, axis_z, b_x, b_y, b_z, bend, h0, qc, slope, radius_0 = solid[:11]
        dh = u * axis_x + v * axis_y + axis_z
        qb = u * b_x + v * b_y + b_z
        # a ray along the axis meets an end, never the body
        qa = max(u * u + v * v + 1.0 - bend * dh * dh, 1e-9)
        under = qb * qb - qa * qc
        far = (-qb - np.sqrt(max(under, 0.0))) / qa
        height, met = h0 + far * dh, under >= 0.0
        # Off the axis, and tilted by the cone's slope: n = p - a - h axis - k (r0 + k h) axis.
        along = height + slope * (radius_0 + slope * height)
        n_x = far * u - solid[13] - along * axis_x
        n_y = far * v - solid[14] - along * axis_y
        n_z = far - solid[15] - along * axis_z
        for end in range(2):
            if height <= solid[12] if end else height >= solid[11]:
                continue
            c_x, c_y, c_z = solid[13 + 3 * end], solid[14 + 3 * end], solid[15 + 3 * end]
            radius = solid[19 + end]
            if solid[21 + end] > 0.0:
                # A ray that misses keeps the rim's depth and normal from the cone.
                turn = 1.0 if end else -1.0
                o_x, o_y, o_z = turn * axis_x, turn * axis_y, turn * axis_z
                towards = u * o_x + v * o_y + o_z
                there = (c_x * o_x + c_y * o_y + c_z * o_z) / (towards if towards < -1e-9 else -1.0)
                off_x, off_y, off_z = there * u - c_x, there * v - c_y, there - c_z
                met = off_x * off_x + off_y * off_y + off_z * off_z <= radius * radius
                met = met and towards < -1e-9
                if met:
                    far, n_x, n_y, n_z = there, o_x, o_y, o_z
            else:
                # Distance of the centre from the ray first: b^2 - a c would lose half of the
                # digits at a metre.
                long = u * u + v * v + 1.0
                middle = (u * c_x + v * c_y + c_z) / long
                off_x, off_y, off_z = middle * u - c_x, middle * v - c_y, middle - c_z
                left = radius * radius - (off_x * off_x + off_y * off_y + off_z * off_z)
                far, met = middle - np.sqrt(max(left, 0.0) / long), left >= 0.0
                n_x, n_y, n_z = far * u - c_x, far * v - c_y, far - c_z
        length = np.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
        depth[i], hit[i] = far, met
        normal[0, i], normal[1, i], normal[2, i] = n_x / length, n_y / length, n_z / length


@_compiled("Tuple((i8[::1], i8))(i8[::1], f8[::1])")
def by_pixel(pixel: Ints, depth: Floats) -> tuple[Ints, int]:
    """An order of surfaces (m,): those alone in their pixel, and how many; then by pixel, the
    nearest first.
    """
    low = high = pixel[0]
    for i in range(len(pixel)):
        low, high = min(low, pixel[i]), max(high, pixel[i])
    often = np.zeros(high - low + 1, np.int32)
    for i in range(len(pixel)):
        often[pixel[i] - low] += 1
    alone = 0
    for i in range(len(pixel)):
        alone += often[pixel[i] - low] == 1
    order, at = np.empty(len(pixel), np.int64), 0
    start, filled = np.zeros(len(often), np.int32), np.zeros(len(often), np.int32)
    end = alone
    for cell in range(len(often)):
        if often[cell] > 1:
            start[cell], end = end, end + often[cell]
    for i in range(len(pixel)):
        cell = pixel[i] - low
        if often[cell] == 1:
            order[at], at = i, at + 1
            continue
        place = start[cell] + filled[cell]
        filled[cell] += 1
        while place > start[cell] and depth[order[place - 1]] > depth[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
    return order, alone


@_compiled("Tuple((i8[::1], f8[:, ::1], f8[::1]))(i8[:], i8[::1], f8[::1], i8[::1], f8[:, ::1])")
def stacked(
    order: Ints, pixel: Ints, share: Floats, owner: Ints, value: Floats
) -> tuple[Ints, Floats, Floats]:
    """Surfaces (m,) in pixels, in an ``order`` by pixel, then depth, with values (m, c): the
    nearest of each pixel, its light (n, c), the share seen past all (n,).
    """
    count = 0
    for i in range(len(order)):
        count += i == 0 or pixel[order[i]] != pixel[order[i - 1]]
    nearest, behind = np.empty(count, np.int64), np.empty(count)
    light = np.zeros((count, value.shape[1]))
    place, widest, past = -1, 0.0, 1.0
    for i in range(len(order)):
        now = order[i]
        if i == 0 or pixel[now] != pixel[order[i - 1]]:
            place, widest, past = place + 1, 0.0, 1.0
            nearest[place] = now
        elif owner[now] != owner[order[i - 1]]:
            widest, past = 0.0, past * (1.0 - widest)
        after = max(widest, share[now])
        for channel in range(value.shape[1]):
            light[place, channel] += past * (after - widest) * value[now, channel]
        widest = after
        behind[place] = past * (1.0 - widest)
    return nearest, light, behind


@_compiled("void(f4[:, ::1], f4[:, ::1], f4[::1], f4, f4[::1])")
def lamp_left(
    casters: Singles, points: Singles, lamp: Singles, lamp_radius: float, left: Singles
) -> None:
    """Lowers ``left`` (n,) to the share of a round lamp that points (3, n) see beside casters
    (k, 8): one end, the way to the other, radius, how much wider there. Rays' gaps by penumbra.
    """
    none, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    for k in range(len(casters)):
        a_x, a_y, a_z, span_x, span_y, span_z, radius, wider = casters[k]
        square = span_x * span_x + span_y * span_y + span_z * span_z
        for i in range(len(left)):
            x, y, z = points[0, i], points[1, i], points[2, i]
            way_x, way_y, way_z = lamp[0] - x, lamp[1] - y, lamp[2] - z
            far = np.sqrt(way_x * way_x + way_y * way_y + way_z * way_z)
            way_x, way_y, way_z = way_x / far, way_y / far, way_z / far
            # the ray's and the segment's nearest points: least distance, place on ray and segment
            off_x, off_y, off_z = x - a_x, y - a_y, z - a_z
            cross = way_x * span_x + way_y * span_y + way_z * span_z
            d_way = off_x * way_x + off_y * way_y + off_z * way_z
            d_span = off_x * span_x + off_y * span_y + off_z * span_z
            under = max(square - cross * cross, np.float32(1e-3))
            part = min(max((d_span - d_way * cross) / under, none), one)
            along = max(part * cross - d_way, none)
            off_x = off_x + along * way_x - part * span_x
            off_y = off_y + along * way_y - part * span_y
            off_z = off_z + along * way_z - part * span_z
            gap = np.sqrt(off_x * off_x + off_y * off_y + off_z * off_z)
            half_shade = max(along, np.float32(2.0)) * (lamp_radius / far)
            lit = half + half * (gap - (radius + part * wider)) / half_shade
            left[i] = min(left[i], min(max(lit, none), one))


@_compiled("void(f4[:, ::1], f4[:, ::1], f4[::1], f4[::1], f4, f4[::1], f4[:, ::1])")
def lamp_light(
    points: Singles,
    normals: Singles,
    eye: Singles,
    lamp: Singles,
    power: float,
    albedo: Singles,
    parts: Singles,
) -> None:
    """Fills ``parts`` (3, n) with a lamp's light of ``power`` at 1 mm on points (3, n) with unit
    normals: how strong it comes, which share Lambert's law sends on, and how near it comes to the
    mirrored ``eye`` (3,), 0 to 1.
    """
    none = np.float32(0.0)
    for i in range(len(albedo)):
        x, y, z = points[0, i], points[1, i], points[2, i]
        view_x, view_y, view_z = eye[0] - x, eye[1] - y, eye[2] - z
        near = np.sqrt(view_x * view_x + view_y * view_y + view_z * view_z)
        way_x, way_y, way_z = lamp[0] - x, lamp[1] - y, lamp[2] - z
        square = way_x * way_x + way_y * way_y + way_z * way_z
        far = np.sqrt(square)
        way_x, way_y, way_z = way_x / far, way_y / far, way_z / far
        half_x, half_y, half_z = way_x + view_x / near, way_y + view_y / near, way_z + view_z / near
        n_x, n_y, n_z = normals[0, i], normals[1, i], normals[2, i]
        length = np.sqrt(half_x * half_x + half_y * half_y + half_z * half_z)
        parts[0, i] = power / square
        parts[1, i] = albedo[i] * max(way_x * n_x + way_y * n_y + way_z * n_z, none)
        parts[2, i] = max(half_x * n_x + half_y * n_y + half_z * n_z, none) / length


@_compiled("void(f4[:, :], f4[:, :], f4, f4, f4, f4[:, :])")
def fill(
    light: Singles, response: Singles, filled: float, dark: float, full: float, electrons: Singles
) -> None:
    """Fills pixels (h, w): ``filled`` electrons at light 1, and ``dark``, ``full`` at most."""
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            electrons[i, j] = min(light[i, j] * response[i, j] * filled + dark, full)


@_compiled("void(f4[::1], f4[::1], u2[::1], f4[::1], f4, f4, f4, f4, f4, u2[::1])")
def expose(
    electrons: Singles,
    offsets_e: Singles,
    noise: Words,
    levels: Singles,
    read2: float,
    gain2: float,
    gain: float,
    offset: float,
    most: float,
    exposed: Words,
) -> None:
    """Fills pixels (n,) with whole grey levels, 0 to ``most``; the noise is the one of ``levels``
    that each of ``noise`` names. Variance: gain2 (electrons + read2), EMVA 1288.
    """
    for i in range(len(electrons)):
        spread = np.sqrt((electrons[i] + read2) * gain2)
        mean = (electrons[i] + offsets_e[i]) * gain + offset
        grey = np.rint(levels[noise[i]] * spread + mean)
        exposed[i] = np.uint16(min(max(grey, np.float32(0.0)), most))
