"""The renderer's hot loops, compiled by numba when this module is imported, and kept on disk.

They are written out in numpy's order of operations, and without fast mathematics: a picture is the
same to the bit wherever it is drawn. What is kept is as old as this file, so one file has all.

A loop fills arrays and gives back a number at most. A Ctrl-C that comes amid a loop is raised where
an array is handed back, in numba's own code, which then crashes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Words = NDArray[np.uint16]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
Point = tuple[float, float]
Number = Any  # float, or float32
Vector = tuple[Number, Number, Number]
Loop = TypeVar("Loop", bound=Callable[..., Any])


def _compiled(signature: str) -> Callable[[Loop], Loop]:
    how: dict[str, Any] = {"error_model": "numpy", "nogil": True}

    def compiled(loop: Loop) -> Loop:
        for anew in (False, True):  # where what is kept is damaged, as by a power cut
            with suppress(Exception):  # a damaged pickle raises anything; others come again
                kept = numba.njit(cache=True, **how)(loop)
                if anew:
                    kept.recompile()  # empties the index of what is kept
                kept.compile(signature)
                kept.disable_compile()
                return cast("Loop", kept)
        # No folder for it may be written, or the disk is full: each process compiles anew.
        return cast("Loop", numba.njit(signature, **how)(loop))

    return compiled


def _within(loop: Loop) -> Loop:
    """Compiled as a part of those that call it."""
    return cast("Loop", numba.njit(error_model="numpy")(loop))


STEP_PX = 8.0  # longest straight piece of an outline: the lens bends it by less than 1e-4 px
NEARLY_ALL = 1.0 - 1e-9
NOTHING = 1e-4  # less cover than this is no cover
RAYS = 1024  # at a time: what is worked out on the way stays in the processor's cache


@_within
def _dot(a: Vector, b: Vector) -> Number:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_within
def _plus(a: Vector, times: Number, b: Vector) -> Vector:
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


@_within
def _unit(a: Vector) -> Vector:
    length = np.sqrt(_dot(a, a))
    return a[0] / length, a[1] / length, a[2] / length


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


@_compiled("i8(i8[::1], f8[:, ::1], f8[::1], i8[::1], i8[::1])")
def parted(counts: Ints, corners: Floats, fc: Floats, after: Ints, parts: Ints) -> int:
    """Closed outlines of ``counts`` corners (n, 2) in the ideal plane: fills which corner comes
    ``after`` each, and in how many pieces of STEP_PX the way to it is; how many these are.
    """
    total, first = 0, 0
    for i in range(len(counts)):
        for j in range(first, first + counts[i]):
            after[j] = j + 1
        after[first + counts[i] - 1] = first
        first += counts[i]
    for j in range(len(corners)):
        x = (corners[after[j], 0] - corners[j, 0]) * fc[0]
        y = (corners[after[j], 1] - corners[j, 1]) * fc[1]
        parts[j] = int(max(np.ceil(np.sqrt(x * x + y * y) / STEP_PX), 1.0))
        total += parts[j]
    return total


@_compiled("void(f8[:, ::1], i8[::1], i8[::1], f8[:, ::1], f8[:, ::1])")
def pieces(corners: Floats, after: Ints, parts: Ints, window: Floats, points: Floats) -> None:
    """Fills where the pieces of `parted` outlines begin, (m, 2), within a ``window`` (2, 2)."""
    at = 0
    for j in range(len(corners)):
        for axis in range(2):
            step = (corners[after[j], axis] - corners[j, axis]) / parts[j]
            for part in range(parts[j]):
                place = max(corners[j, axis] + part * step, window[0, axis])
                points[at + part, axis] = min(place, window[1, axis])
        at += parts[j]


@_within
def _edge(
    number: int, start: Point, end: Point, base: int, width: int, change: Floats, spill: Floats
) -> None:
    """Adds an edge's signed areas, pixel by pixel, to a window ``width`` wide whose pixel (0, 0)
    would be at ``base``: what changes at a pixel, and at the next one.
    """
    (x, y), (to_x, to_y) = start, end
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


@_compiled("i8(i8[::1], i8[:, ::1], f8[:, ::1], i8, i8, i8[:, ::1], f8[::1])")
def areas(
    counts: Ints, windows: Ints, points: Floats, wide: int, tall: int, places: Ints, shares: Floats
) -> int:
    """Which share of each pixel closed outlines of ``counts`` points (n, 2) cover: fills (3, m)
    outline, row, column, and shares (m,), by outline, and says how many. Signed areas in
    ``windows`` (k, 4), left, right, top and bottom of each; their rows sum to zero.
    """
    cells = len(shares)  # at most
    change, spill = np.zeros(cells + 1), np.zeros(cells + 1)
    cells, stop = 0, 0
    for i in range(len(counts)):
        left, right, top, bottom = windows[i]
        base = cells - top * (right - left) - left
        first, stop = stop, stop + counts[i]
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            start, end = (points[j, 0], points[j, 1]), (points[after, 0], points[after, 1])
            _edge(j, start, end, base, right - left, change, spill)
        cells += (right - left) * (bottom - top)
    cell, at, total = 0, 0, 0.0
    for i in range(len(counts)):
        left, right, top, bottom = windows[i]
        for row in range(top, bottom):
            for column in range(left, right):
                total += change[cell] + spill[cell]
                share = min(abs(total), 1.0)
                cell += 1
                if share > NOTHING and 0 <= row < tall and 0 <= column < wide:
                    places[0, at], places[1, at], places[2, at] = i, row, column
                    shares[at] = share
                    at += 1
    return at


@_compiled("void(f8[:, ::1], f8[:, ::1], f8, f8[:, :, ::1])")
def rims(solids: Floats, circle: Floats, stretch: float, seen: Floats) -> None:
    """Fills outlines of both ends of solids (k, 13), a, b, axis, radii, and whether each is flat,
    in the ideal plane, (k, 2 m, 2): a disc's rim, or a ball's limb, a ``circle`` (m, 2) stretched.
    """
    for i in range(len(solids)):
        for end in range(2):
            centre = (solids[i, 3 * end], solids[i, 3 * end + 1], solids[i, 3 * end + 2])
            radius, x, y, z = solids[i, 9 + end], solids[i, 6], solids[i, 7], solids[i, 8]
            if not solids[i, 11 + end]:
                x, y, z = _unit(centre)
                shrink = radius / np.sqrt(_dot(centre, centre))
                shrink *= shrink
                centre = (
                    centre[0] * (1.0 - shrink), centre[1] * (1.0 - shrink),
                    centre[2] * (1.0 - shrink),
                )  # fmt: skip
                radius *= np.sqrt(1.0 - shrink)
            radius *= stretch
            u = _unit((0.0, z, -y) if abs(x) < 0.7 else (-z, 0.0, x))
            v = (y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0])
            for j in range(len(circle)):
                cos, sin = circle[j]
                way = (cos * u[0] + sin * v[0], cos * u[1] + sin * v[1], cos * u[2] + sin * v[2])
                point = _plus(centre, radius, way)
                seen[i, end * len(circle) + j, 0] = point[0] / point[2]
                seen[i, end * len(circle) + j, 1] = point[1] / point[2]


@_compiled("void(f8[:, ::1], i8[:], f8[::1], f8[::1], f8[::1], f8[:, ::1], b1[::1])")
def meet(
    columns: Floats, which: Ints, x: Floats, y: Floats, depth: Floats, normal: Floats, hit: Bools
) -> None:
    """Ray (x, y, 1) with solid ``which``, (n,) each: fills depth (n,), normal (3, n), hit (n,).
    ``columns`` (k, 23): axis, qb by ray (3), bend, h0, qc, slope, radius_0, low, high, ways from
    ends a and b to the camera, both radii, and whether each end is flat.
    """
    body, stop = np.empty(2 * RAYS), 0  # heights where rays meet the body, and which do
    while stop < len(which):
        first, stop = stop, stop + 1
        while stop < min(first + RAYS, len(which)) and which[stop] == which[first]:
            stop += 1
        u, v, far, met = x[first:stop], y[first:stop], depth[first:stop], hit[first:stop]
        out_x, out_y, out_z = normal[0, first:stop], normal[1, first:stop], normal[2, first:stop]
        solid = columns[which[first]]
        axis, by_ray = (solid[0], solid[1], solid[2]), (solid[3], solid[4], solid[5])
        bend, h0, qc, slope, radius_0, low, high = solid[6:13]
        from_a = (solid[13], solid[14], solid[15])
        # Loops without branches are done with vectors: the body, and of the few others an end.
        for i in range(len(u)):
            ray = (u[i], v[i], 1.0)
            dh, qb = _dot(ray, axis), _dot(ray, by_ray)
            # a ray along the axis meets an end, never the body
            qa = max(_dot(ray, ray) - bend * dh * dh, 1e-9)
            under = qb * qb - qa * qc
            there = (-qb - np.sqrt(max(under, 0.0))) / qa
            far[i], body[i], body[RAYS + i] = there, h0 + there * dh, under
        for i in range(len(u)):
            # Off the axis, and tilted by the cone's slope: n = p - a - h axis - k (r0 + k h) axis.
            along = body[i] + slope * (radius_0 + slope * body[i])
            outward = _plus(_plus(from_a, far[i], (u[i], v[i], 1.0)), -along, axis)
            out_x[i], out_y[i], out_z[i] = _unit(outward)
        for i in range(len(u)):
            ray, met[i] = (u[i], v[i], 1.0), body[RAYS + i] >= 0.0
            for end in range(2):
                if not (body[i] > high if end else body[i] < low):
                    continue
                back = (solid[13 + 3 * end], solid[14 + 3 * end], solid[15 + 3 * end])
                square = solid[19 + end] * solid[19 + end]
                if solid[21 + end]:
                    # A ray that misses keeps the rim's depth and normal from the cone.
                    turn = 1.0 if end else -1.0
                    towards = turn * _dot(ray, axis)
                    there = -turn * _dot(back, axis) / (towards if towards < -1e-9 else -1.0)
                    off = _plus(back, there, ray)
                    met[i] = towards < -1e-9 and _dot(off, off) <= square
                    if not met[i]:
                        continue
                    far[i], outward = there, (turn * axis[0], turn * axis[1], turn * axis[2])
                else:
                    # Distance of the centre from the ray first: b^2 - a c would lose half of the
                    # digits at a metre.
                    middle = -_dot(ray, back) / _dot(ray, ray)
                    off = _plus(back, middle, ray)
                    under = square - _dot(off, off)
                    far[i] = middle - np.sqrt(max(under, 0.0) / _dot(ray, ray))
                    met[i], outward = under >= 0.0, _plus(back, far[i], ray)
                out_x[i], out_y[i], out_z[i] = _unit(outward)


@_compiled("i8(i8[::1], f8[::1], i8[::1])")
def by_pixel(pixel: Ints, depth: Floats, found: Ints) -> int:
    """Fills which surfaces (m,) are alone in their pixel, and says how many; then the others by
    pixel, the nearest first.
    """
    low = high = pixel[0]
    for i in range(len(pixel)):
        low, high = min(low, pixel[i]), max(high, pixel[i])
    often, start, filled = np.zeros((3, high - low + 1), np.int32)
    for i in range(len(pixel)):
        often[pixel[i] - low] += 1
    shared = 0
    for cell in range(len(often)):
        if often[cell] > 1:
            start[cell], shared = shared, shared + often[cell]
    at, order = 0, found[len(pixel) - shared :]
    for i in range(len(pixel)):
        cell = pixel[i] - low
        if often[cell] == 1:
            found[at], at = i, at + 1
            continue
        place = start[cell] + filled[cell]
        filled[cell] += 1
        while place > start[cell] and depth[order[place - 1]] > depth[i]:
            order[place], place = order[place - 1], place - 1
        order[place] = i
    return at


@_compiled("i8(i8[::1], i8[::1], f8[::1], i8[::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[::1])")
def stacked(
    order: Ints,
    pixel: Ints,
    share: Floats,
    owner: Ints,
    value: Floats,
    nearest: Ints,
    light: Floats,
    behind: Floats,
) -> int:
    """Surfaces (m,) in pixels, in an ``order`` by pixel, then depth, with values (m, c): fills the
    nearest of each pixel, its light (n, c), from zeros, and the share seen past all (n,); how many.
    """
    at, widest, past = -1, 0.0, 1.0
    for i in range(len(order)):
        now = order[i]
        if i == 0 or pixel[now] != pixel[order[i - 1]]:
            at, widest, past = at + 1, 0.0, 1.0
            nearest[at] = now
        elif owner[now] != owner[order[i - 1]]:
            widest, past = 0.0, past * (1.0 - widest)
        after = max(widest, share[now])
        for channel in range(value.shape[1]):
            light[at, channel] += past * (after - widest) * value[now, channel]
        widest = after
        behind[at] = past * (1.0 - widest)
    return at + 1


@_compiled("void(f4[:, ::1], f4[:, ::1], f4[::1], f4, f4[::1])")
def lamp_left(
    casters: Singles, points: Singles, lamp: Singles, lamp_radius: float, left: Singles
) -> None:
    """Lowers ``left`` (n,) to the share of a round lamp that points (3, n) see beside casters
    (k, 8): one end, the way to the other, radius, how much wider there. Rays' gaps by penumbra.
    """
    none, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    for caster in casters:
        span, radius, wider = (caster[3], caster[4], caster[5]), caster[6], caster[7]
        for i in range(len(left)):
            point = (points[0, i], points[1, i], points[2, i])
            way = _plus((lamp[0], lamp[1], lamp[2]), -one, point)
            far, way = np.sqrt(_dot(way, way)), _unit(way)
            # the ray's and the segment's nearest points: least distance, place on ray and segment
            off = _plus(point, -one, (caster[0], caster[1], caster[2]))
            cross, d_way, d_span = _dot(way, span), _dot(off, way), _dot(off, span)
            under = max(_dot(span, span) - cross * cross, np.float32(1e-3))
            part = min(max((d_span - d_way * cross) / under, none), one)
            along = max(part * cross - d_way, none)
            off = _plus(_plus(off, along, way), -part, span)
            gap, half_shade = np.sqrt(_dot(off, off)), max(along, one + one) * (lamp_radius / far)
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
    none, one = np.float32(0.0), np.float32(1.0)
    for i in range(len(albedo)):
        point = (points[0, i], points[1, i], points[2, i])
        normal = (normals[0, i], normals[1, i], normals[2, i])
        way = _plus((lamp[0], lamp[1], lamp[2]), -one, point)
        square, way = _dot(way, way), _unit(way)
        half = _plus(way, one, _unit(_plus((eye[0], eye[1], eye[2]), -one, point)))
        parts[0, i] = power / square
        parts[1, i] = albedo[i] * max(_dot(way, normal), none)
        parts[2, i] = max(_dot(half, normal), none) / np.sqrt(_dot(half, half))


@_compiled("void(f4[:, ::1], i8, f4[:, ::1], i8, f4[:, ::1], f4[:, ::1], f4)")
def paint(
    picture: Singles,
    left: int,
    light: Singles,
    across: int,
    share: Singles,
    varies: Singles,
    texture: float,
) -> None:
    """Lays a patch with a ``share`` of each pixel (h, w) over those of a picture from column
    ``left`` on: its ``light`` from column ``across`` on, times 1 + ``texture`` of what ``varies``.
    """
    one = np.float32(1.0)
    for i in range(share.shape[0]):
        for j in range(share.shape[1]):
            behind = picture[i, left + j]
            seen = light[i, across + j] * (varies[i, j] * texture + one)
            picture[i, left + j] = behind + (seen - behind) * share[i, j]


@_compiled("void(f4[:, ::1], f4[:, ::1], f4[:, ::1], u2[:, ::1], f4[::1], f4[::1], u2[:, ::1])")
def expose(
    light: Singles,
    response: Singles,
    dark_e: Singles,
    noise: Words,
    levels: Singles,
    constants: Singles,
    exposed: Words,
) -> None:
    """Fills pixels (h, w) with whole grey levels: the noise is the one of ``levels`` that each of
    ``noise`` names, its variance K^2 (electrons + read noise^2), EMVA 1288.
    """
    filled, dark, full, read2, gain2, gain, offset, most = constants
    named = np.empty(light.shape[1], np.float32)
    for i in range(light.shape[0]):
        # in a loop of its own: the next one is then done with vectors
        for j in range(len(named)):
            named[j] = levels[noise[i, j]]
        for j in range(len(named)):
            electrons = min(light[i, j] * response[i, j] * filled + dark, full)
            mean = (electrons + dark_e[i, j]) * gain + offset
            grey = np.rint(named[j] * np.sqrt((electrons + read2) * gain2) + mean)
            exposed[i, j] = np.uint16(min(max(grey, np.float32(0.0)), most))
