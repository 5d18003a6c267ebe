"""The hot loops of the fits, and of the fused detector's searches, compiled by numba.

Compiled for one signature when this module is imported, and kept on disk (beside the module, else
in the user's cache, or in NUMBA_CACHE_DIR). What is kept is as old as the file of a loop: so one
file has all.

No array is assigned to a slice: what numba would say of a wrong shape takes 2 s to compile. A loop
fills arrays and gives back a number at most. A Ctrl-C that comes amid a loop is raised where
an array is handed back, in numba's own code, which then crashes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array

Field = NDArray[np.float32]
Ids = NDArray[np.intp]
Arrays = tuple[Array, ...]
Loop = TypeVar("Loop", bound=Callable[..., Any])
_f4 = np.float32
_STEP_MM = 0.1  # outward, to see how far an outline moves


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


def _summing(loop: Loop) -> Loop:
    """The same; its sums in any order."""
    return cast("Loop", numba.njit(error_model="numpy", fastmath={"contract", "reassoc"})(loop))


@_within
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # type: ignore[no-any-return]


@_within
def _cross(a: Array, b: Array) -> Array:
    result = np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        result[i] = a[j] * b[k] - a[k] * b[j]
    return result


@_within
def _pixel(
    centre: Array, arm: Array, normal: Array, step: float, lens: Array
) -> tuple[float, float]:
    """`Camera.project` of a point a ``step`` along the normal from ``centre + arm``."""
    z = centre[2] + arm[2] + step * normal[2]
    if not z > 0:
        return np.nan, np.nan
    u = (centre[0] + arm[0] + step * normal[0]) / z
    v = (centre[1] + arm[1] + step * normal[1]) / z
    r2 = u * u + v * v
    radial = 1 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    p1, p2 = lens[6], lens[7]
    s = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    t = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    return lens[0] * (s + lens[9] * t) + lens[2], lens[1] * t + lens[3]


@_within
def _contour(
    teat: Array, centre: Array, axis: Array, along: Array, over: Array, arms: Array, normals: Array
) -> None:
    """The outline of one teat (8,) whose middle and axis are in the camera's frame: fills
    points from the middle and normals, (n, 3) each.
    """
    radius, taper, height = teat[5], teat[6], teat[7]
    c = centre + (1 / height - 1) * _dot(centre, axis) * axis
    depth = _dot(c, axis)
    towards = depth * axis - c
    distance = np.sqrt(_dot(towards, towards))
    towards /= distance
    sideways = _cross(axis, towards)
    x = (radius - taper * depth) / distance
    y2 = 1 - taper**2 - x**2
    y = np.sqrt(y2) if y2 > 0 else np.nan
    level, other_level = towards * x + sideways * y, towards * x - sideways * y
    start, stop = level - taper * axis, other_level - taper * axis
    cosine = np.sqrt(1 - taper**2)
    up = cosine * axis + (taper / cosine) * level
    down = cosine * axis + (taper / cosine) * other_level
    far = np.sqrt(_dot(c, c))
    middle = -(radius / far**2) * c
    e1, last = start - middle, stop - middle
    reach = np.sqrt(_dot(e1, e1))
    e1 /= reach
    e2 = _cross(c / far, e1)
    angle = np.arctan2(_dot(last, e2), _dot(last, e1)) % (2 * np.pi)
    k, e = len(along), len(over)
    for j in range(k):
        for i in range(3):
            normals[j, i], normals[k + e + j, i] = start[i], stop[i]
            arms[j, i] = radius * start[i] + along[k - 1 - j] * up[i]
            arms[k + e + j, i] = radius * stop[i] + along[j] * down[i]
    for j in range(e):
        cos, sin = np.cos(angle * over[j]), np.sin(angle * over[j])
        for i in range(3):
            normals[k + j, i] = middle[i] + reach * (cos * e1[i] + sin * e2[i])
            arms[k + j, i] = radius * normals[k + j, i]
    for j in range(2 * k + e):
        by_arm, by_normal = (height - 1) * _dot(arms[j], axis), _dot(normals[j], axis)
        by_normal *= 1 / height - 1
        for i in range(3):
            arms[j, i] += by_arm * axis[i]
            normals[j, i] += by_normal * axis[i]
        length = np.sqrt(_dot(normals[j], normals[j]))
        for i in range(3):
            normals[j, i] /= length


@_within
def _slope(
    teat: Array,
    axis: Array,
    turned: Array,
    R: Array,
    px_a_mm: float,
    arm: Array,
    normal: Array,
    result: Array,
) -> None:
    """How far one point moves outward with each number: fills (8,); ``axis`` and how it ``turned``
    (2, 3) by either lean are in the teats' frame.
    """
    along_q = along_n = round_q = 0.0
    for i in range(3):
        n = R[0, i] * normal[0] + R[1, i] * normal[1] + R[2, i] * normal[2]
        q = R[0, i] * arm[0] + R[1, i] * arm[1] + R[2, i] * arm[2]
        result[i], result[5 + i] = n, q
        along_q += q * axis[i]
        along_n += n * axis[i]
        round_q += n * q
    for k in range(2):
        by_turn, towards = _dot(result[:3], turned[k]), _dot(result[5:], turned[k])
        result[3 + k] = (along_q * by_turn - towards * along_n) * px_a_mm
    below = max(along_q, 0.0)
    for i in range(3):
        result[i] *= px_a_mm
    result[5] = px_a_mm * (1.0 if below > 0 else round_q / teat[5])
    result[6] = px_a_mm * below / teat[7]
    result[7] = px_a_mm * (0.0 if below > 0 else along_n * along_q / teat[7])


@_compiled("void(f8[:,::1],f8[:,::1],UniTuple(f8[::1],2),b1,i8[::1],UniTuple(f8[:,:,::1],3))")
def outlines(
    teats: Array, cameras: Array, outline: Arrays, slopes_too: bool, which: Ids, found: Arrays
) -> None:
    """`model.outlines` of teats (m, 8) in ``cameras`` (views, 22 or more), `numbers_of` them:
    fills rows ``which`` (m,) of pixels, normals (., views * n, 2) and Jacobians (., views * n, 8).
    """
    (along, over), (pixels, normals, jacobian) = outline, found
    n = 2 * len(along) + len(over)
    arms, outward, turned = np.empty((n, 3)), np.empty((n, 3)), np.empty((2, 3))
    axis, centre = np.empty(3), np.empty(3)
    for i in range(len(teats)):
        teat = teats[i]
        own = np.array([teat[3], 1.0, teat[4]])
        length = np.sqrt(_dot(own, own))
        own /= length
        for d in range(3):
            turned[0, d] = ((d == 0) - own[d] * own[0]) / length
            turned[1, d] = ((d == 2) - own[d] * own[2]) / length
        for v in range(len(cameras)):
            lens, R, T = cameras[v, :10], cameras[v, 10:19].reshape(3, 3), cameras[v, 19:22]
            for d in range(3):
                axis[d] = _dot(R[d], own)
                centre[d] = _dot(R[d], teat[:3]) + T[d]
            _contour(teat, centre, axis, along, over, arms, outward)
            at, first = slice(v * n, (v + 1) * n), v * n
            place, normal = pixels[which[i], at], normals[which[i], at]
            for j in range(n):
                place[j, 0], place[j, 1] = _pixel(centre, arms[j], outward[j], 0.0, lens)
            for j in range(n):
                before, after = place[max(j - 1, 0)], place[min(j + 1, n - 1)]
                x, y = after[0] - before[0], after[1] - before[1]
                length = np.sqrt(x * x + y * y)
                normal[j, 0], normal[j, 1] = y / length, -x / length
            if slopes_too:
                for j in range(n):
                    x, y = _pixel(centre, arms[j], outward[j], _STEP_MM, lens)
                    px = (x - place[j, 0]) * normal[j, 0] + (y - place[j, 1]) * normal[j, 1]
                    slope = jacobian[which[i], first + j]
                    _slope(teat, own, turned, R, px / _STEP_MM, arms[j], outward[j], slope)


@_within
def _likeliest(
    left: Field,
    straight: Field,
    grid: tuple[Array, Field, float],
    floor: np.float32,
    freedom: np.float32,
    which: Ids,
    result: Array,
) -> None:
    """The edge of some of lines (n, g) by residuals of steps and of a straight line: fills offset,
    standard deviation, clarity (3, n) of these. ``grid``: places, what each costs, how far apart.
    """
    places, pull, apart_px = grid
    g = left.shape[1]
    cost = np.empty(g, dtype=_f4)
    for j in which:
        least = left[j, 0]
        for i in range(1, g):
            least = min(least, left[j, i])
        scale, best = max(least, floor) / freedom, 0
        for i in range(g):
            cost[i] = left[j, i] / scale + pull[i]
        for i in range(1, g):
            if cost[i] < cost[best]:
                best = i
        inner = min(max(best, 1), g - 2)
        before, here, after = cost[inner - 1], cost[inner], cost[inner + 1]
        before, here, after = np.float64(before), np.float64(here), np.float64(after)
        bend = max(before - 2 * here + after, 1e-9)
        shift = min(max(0.5 * (before - after) / bend, -1.0), 1.0)
        result[0, j] = places[inner] + shift * apart_px if best == inner else np.nan
        result[1, j] = np.sqrt(2.0 / bend) * apart_px
        result[2, j] = (straight[j, 0] - left[j, best]) / scale if best == inner else 0.0


@_within
def _summed(values: Field, size: int, result: Field) -> None:
    """Sums of neighbouring lines (n, g), as scipy's uniform filter has them; ends repeated."""
    n, g = values.shape
    half, total = size // 2, np.zeros(g)
    for j in range(-half, half + 1):
        for i in range(g):
            total[i] += values[max(j, 0), i]
    for j in range(n):
        last, first = min(j + half + 1, n - 1), max(j - half, 0)
        for i in range(g):
            result[j, i] = _f4(total[i] / size) * _f4(size)
            total[i] += np.float64(values[last, i]) - np.float64(values[first, i])


@_summing
def _left_over(lines: Field, rows: Array, left: Field, straight: Field) -> None:
    """Of lines (n, s): fills residuals of steps (k, n, g), and of straight lines (n, 1)."""
    models, n, g = left.shape
    y = np.zeros(lines.shape)
    for j in range(n):
        if not np.isnan(lines[j, 0]):
            total = 0.0
            for k in range(lines.shape[1]):
                total += lines[j, k]
            for k in range(lines.shape[1]):
                y[j, k] = lines[j, k] - total / lines.shape[1]
    products = np.dot(y, rows.T)
    for j in range(n):
        along, energy = products[j], 0.0
        for k in range(lines.shape[1]):
            energy += y[j, k] * y[j, k]
        straight[j, 0] = max(energy - along[len(rows) - 1] ** 2, 1e-6)
        for q in range(g):
            one = energy - along[q] * along[q]
            left[models - 1, j, q] = max(one, 0.0)
            if models == 2:
                a, b = along[g + q], along[2 * g + q]
                left[0, j, q] = max(one - a * a - b * b, 0.0)


@_within
def _with_neighbours(
    left: Field,
    straight: Field,
    grid: tuple[Array, Field, float],
    floor: np.float32,
    freedom: np.float32,
    joining: tuple[int, float, float],
    result: Array,
) -> None:
    """Edges of faint lines anew, each taken together with its neighbours: fills ``result``
    (3, k, n). ``joining``: how many, the clarity of an edge beyond doubt, and what one counts less.
    """
    neighbours, clear, doubt = joining
    models, n, g = left.shape
    faint, many = np.empty(n, np.intp), 0
    for j in range(n):
        if result[2, 0, j] < clear:
            faint[many], many = j, many + 1
    if many == 0:
        return
    together, shared, joint = np.empty((n, g), _f4), np.empty((n, 1), _f4), np.empty((3, models, n))
    _summed(straight, neighbours, shared)
    least = _f4(neighbours) * floor
    for k in range(models):
        _summed(left[k], neighbours, together)
        _likeliest(together, shared, grid, least, freedom, faint[:many], joint[:, k])
        for j in faint[:many]:
            result[0, k, j] = joint[0, k, j]
            result[1, k, j] = joint[1, k, j] * np.sqrt(neighbours)
            result[2, k, j] = min(doubt * joint[2, k, j], 0.9 * clear)


@_compiled(
    "void(f4[:,:,:,::1],f8[::1],f8[:,::1],Tuple((f8[::1],f4[::1],f8)),Tuple((i8,f8,f8)),"
    "f8[:,:,:,:,::1])"
)
def edges(
    lines: Field,
    noise: Array,
    rows: Array,
    grid: tuple[Array, Field, float],
    joining: tuple[int, float, float],
    found: Array,
) -> None:
    """Edges of lines (views, m, n, s), NaN beyond a picture: fills offset, standard deviation and
    clarity by each model (3, k, m, views, n). ``rows``: `Profile.rows`; ``noise`` (views,).
    """
    views, m, n, s = lines.shape
    g, models = len(grid[0]), found.shape[1]
    every = np.arange(n)
    left, straight = np.empty((models, n, g), dtype=_f4), np.empty((n, 1), dtype=_f4)
    for v in range(views):
        floor, many = _f4(s * noise[v] ** 2), _f4(s * joining[0])
        for i in range(m):
            result = found[:, :, i, v]
            _left_over(lines[v, i], rows, left, straight)
            for k in range(models):
                _likeliest(left[k], straight, grid, floor, _f4(s), every, result[:, k])
            _with_neighbours(left, straight, grid, floor, many, joining, result)


@_compiled("void(f8[:,:,:,:,::1],f8[::1],f8[:,:,:,::1])")
def light_alike(edges: Array, limits: Array, light: Array) -> None:
    """Fills ``limb_px`` and ``unlike_px`` (2, m, views, n) of `edges.find_edges` by edges (3, 2, m,
    views, n) of plain steps and of shaded ones, and corrects the plain ones: neighbours along an
    outline, in all pictures, are lit alike.
    """
    most_px, neighbours, unlike_share, plain_px, shaded_px = limits
    _, _, m, views, n = edges.shape
    half, total, known = int(neighbours) // 2, np.empty(n), np.empty(n)
    for i in range(m):
        for j in range(n):
            total[j] = known[j] = 0.0
            for v in range(views):
                away = edges[0, 0, i, v, j] - edges[0, 1, i, v, j]
                if abs(away) < most_px:
                    total[j], known[j] = total[j] + away, known[j] + 1.0
        for j in range(n):
            added = counted = 0.0
            for k in range(j - half, j + half + 1):
                near = min(max(k, 0), n - 1)
                added, counted = added + total[near], counted + known[near]
            limb = added / max(counted, 0.5)
            unlike = (unlike_share * limb) ** 2 + plain_px**2
            for v in range(views):
                light[0, i, v, j] = limb
                away, sd = edges[0, 0, i, v, j] - edges[0, 1, i, v, j], edges[1, 0, i, v, j]
                if abs(away) < most_px:
                    noise = max(sd**2 - edges[1, 1, i, v, j] ** 2, 0.0)
                    own = unlike / (unlike + noise + shaded_px**2)
                    light[1, i, v, j] = (1 - own) * (away - limb)
                    edges[0, 0, i, v, j] -= light[1, i, v, j]
                    edges[1, 0, i, v, j] = np.sqrt(sd**2 - (1 - own**2) * noise)


@_within
def _gradient(
    above: Field, here: Field, below: Field, before: int, at: int, after: int
) -> tuple[float, float]:
    """Sobel's of the pixel ``at`` in a row between two, an eighth."""
    x = _f4(2) * (here[after] - here[before])
    x += (above[after] - above[before]) + (below[after] - below[before])
    y = _f4(2) * below[at] + (below[before] + below[after])
    y -= _f4(2) * above[at] + (above[before] + above[after])
    return _f4(0.125) * x, _f4(0.125) * y


@_compiled("void(f4[:,::1],i8,f4[:,::1])")
def steepness(field: Field, every: int, result: Field) -> None:
    """Fills lengths of gradients at one pixel of so many in either direction; the rim mirrors."""
    rows, columns = field.shape
    for i in range(len(result)):
        r = i * every
        above, here, below = field[abs(r - 1)], field[r], field[r + 1 if r + 1 < rows else r - 1]
        for j in range(result.shape[1]):
            c = j * every
            after = c + 1 if c + 1 < columns else c - 1
            x, y = _gradient(above, here, below, abs(c - 1), c, after)
            result[i, j] = np.sqrt(x * x + y * y)


@_compiled("void(f4[:,::1],f4,i8,f4[:,:,::1])")
def squeezed(field: Field, half: np.float32, border: int, result: Field) -> None:
    """Fills gradients (rows, columns, 2), each as long as a share of 1, one half at a length of
    ``half``, within a ``border``.
    """
    rows, columns = field.shape
    x, y, last = np.empty(columns, dtype=_f4), np.empty(columns, dtype=_f4), columns - 1
    for r in range(rows):
        above, here, below = field[abs(r - 1)], field[r], field[r + 1 if r + 1 < rows else r - 1]
        x[0], y[0] = _gradient(above, here, below, 1, 0, 1)
        x[last], y[last] = _gradient(above, here, below, last - 1, last, last - 1)
        for c in range(columns - 2):
            x[c + 1], y[c + 1] = _gradient(above, here, below, c, c + 1, c + 2)
        for c in range(columns):
            share = _f4(1) / (np.sqrt(x[c] * x[c] + y[c] * y[c]) + half)
            x[c] *= share
            y[c] *= share
        row = result[border + r]
        for c in range(columns):
            row[border + c, 0], row[border + c, 1] = x[c], y[c]


@_compiled(
    "void(f4[:,:,::1],f4[:,::1],f8[:,::1],f8[::1],f8[::1],Tuple((f8[:,::1],f8[::1])),b1,f4[:,::1])"
)
def across(
    gradients: Field,
    shifts: Field,
    teats: Array,
    swell: Array,
    view: Array,
    shape: Arrays,
    end: bool,
    result: Field,
) -> None:
    """Fills scores (shifts, m) of teats (m, 8), each with its ``swell`` (m,), in `squeezed`
    gradients with a border of one. ``view``: `fit.CameraView` in numbers; ``shape``: (k, 2) of the
    end, down and to the right, and of the sides.
    """
    (arc, below), corner = shape, view[22:24]
    rows, columns, _ = gradients.shape
    flat, moved = gradients.reshape(-1), shifts + _f4(1.5)
    lens, R, T = view[:10], view[10:19].reshape(3, 3), view[19:22]
    sums = np.ones((3, len(shifts)), _f4)
    middle, lower, none = np.empty(3), np.empty(3), np.zeros(3)
    left, right = moved[:, 0].min(), moved[:, 0].max()
    upper, under = moved[:, 1].min(), moved[:, 1].max()
    for i in range(len(teats)):
        teat = teats[i]
        for d in range(3):
            middle[d] = _dot(R[d], teat[:3]) + T[d]
            lower[d] = middle[d] + 20.0 * (R[d, 0] * teat[3] + R[d, 1])
        x0, y0 = _pixel(middle, none, none, 0.0, lens)
        x1, y1 = _pixel(lower, none, none, 0.0, lens)
        down_x, down_y = x1 - x0, y1 - y0
        length = np.sqrt(down_x * down_x + down_y * down_y)
        if not np.isfinite(length):
            result[:, i] = 0.0
            continue
        down_x, down_y = down_x / length, down_y / length
        half = swell[i] * teat[5] * lens[0] / max(middle[2], 1.0)
        for part in range(3 if end else 2):
            side, count = 2.0 * part - 1.0, len(below) if part < 2 else len(arc)
            total = sums[part]
            total[:] = 0.0
            for k in range(count):
                if part < 2:
                    nx, ny = side * down_y, -side * down_x
                    way_x, way_y = below[k] * down_x + nx, below[k] * down_y + ny
                else:
                    nx = arc[k, 0] * down_x + arc[k, 1] * down_y
                    ny = arc[k, 0] * down_y - arc[k, 1] * down_x
                    way_x, way_y = nx, ny
                x, y = _f4(x0 - corner[0] + half * way_x), _f4(y0 - corner[1] + half * way_y)
                normal_x, normal_y = _f4(nx), _f4(ny)
                inside = x + left >= 0 and x + right < columns
                inside = inside and y + upper >= 0 and y + under < rows
                for j in range(len(shifts)):
                    u, v = x + moved[j, 0], y + moved[j, 1]
                    if not inside:
                        u, v = (
                            min(max(u, _f4(0)), _f4(columns - 1)),
                            min(max(v, _f4(0)), _f4(rows - 1)),
                        )
                    at = 2 * (int(v) * columns + int(u))
                    total[j] += abs(flat[at] * normal_x + flat[at + 1] * normal_y)
            total /= _f4(count)
        for j in range(len(shifts)):
            better, other = max(sums[0, j], sums[1, j]), min(sums[0, j], sums[1, j])
            result[j, i] = sums[2, j] * (_f4(0.7) * better + _f4(0.3) * other)


@_compiled("void(f4[:,::1],i8[::1],i8[:,:,::1],f4[:,:,:,::1],b1,f4[:,:,::1])")
def along_shapes(
    flat: Field, start: Array, off: Array, normals: Field, absolute: bool, result: Field
) -> None:
    """Adds mean strengths (shapes, parts, n) at places ``off`` (shapes, parts, k) from ``start``
    (n,) in flat gradients (., 2), along normals (shapes, parts, k, 2), to zeros.
    """
    shapes, parts, k = off.shape
    for i in range(shapes):
        for part in range(parts):
            row = result[i, part]
            for j in range(k):
                x, y, step = normals[i, part, j, 0], normals[i, part, j, 1], off[i, part, j]
                for n in range(len(start)):
                    index = start[n] + step
                    value = flat[index, 0] * x + flat[index, 1] * y
                    row[n] += abs(value) if absolute else value
            row /= _f4(k)


@_compiled("void(f8[:,::1],f8[:,::1],f8[:,::1],b1[:,::1],i8,i8,f8[::1])")
def trusted(
    weight: Array,
    offset: Array,
    floor: Array,
    hidden: NDArray[np.bool_],
    of_side: int,
    of_end: int,
    limits: Array,
) -> None:
    """The last part of `fine.trusted`: takes from ``weight`` (m, k) what is doubtful. Points of
    a side and an end; ``limits``: `fine._LIMITS`.
    """
    close_floors, least_side, least_alone, most_other = limits
    m, n = len(weight), 2 * of_side + of_end
    views, third = weight.shape[1] // n, of_end // 3
    close = np.empty(weight.shape[1], dtype=np.bool_)
    share, covered = np.empty(views), np.empty(views, dtype=np.bool_)
    for i in range(m):
        for j in range(len(close)):
            near = abs(offset[i, j]) < min(close_floors * floor[i, j], 1.0)
            close[j] = near and weight[i, j] > 0
        for first, beside in ((0, of_side), (of_side + of_end, of_side + of_end - third)):
            for v in range(views):
                shown = good = 0
                for j in range(v * n + first, v * n + first + of_side):
                    shown += 0 if hidden[i, j] else 1
                    good += 1 if close[j] else 0
                share[v] = good / max(shown, 0.3 * of_side)
                covered[v] = shown < 0.5 * of_side
            least = min(1.0 if covered[0] else share[0], 1.0 if covered[1] else share[1])
            doubtful = least < most_other and max(share[0], share[1]) > least_alone
            for v in range(views):
                if share[v] < least_side or (v < 2 and doubtful):
                    weight[i, v * n + first : v * n + first + of_side] = 0.0
                if v < 2 and doubtful:
                    weight[i, v * n + beside : v * n + beside + third] = 0.0


@_compiled("void(f8[:,:,::1],f8[:,::1],f8[:,::1],f8[:,:,::1],f8[:,::1])")
def squares(jacobian: Array, offset: Array, weight: Array, H: Array, b: Array) -> None:
    """The sums of `fit.squares`, added to matrices (m, 8, 8) and right sides (m, 8) of zeros."""
    m, k = weight.shape
    weighted = np.empty(8)
    for i in range(m):
        for j in range(k):
            if weight[i, j] > 0:
                row = jacobian[i, j]
                for p in range(8):
                    weighted[p] = row[p] * weight[i, j]
                for p in range(8):
                    for q in range(8):
                        H[i, p, q] += weighted[p] * row[q]
                    b[i, p] += weighted[p] * offset[i, j]


@_within
def _solve(A: Array, b: Array, x: Array) -> None:
    """Fills ``x`` (n,) with the solution of a positive definite A (n, n), by Cholesky's factor,
    which A holds afterwards, on its diagonal and below.
    """
    n = len(b)
    for p in range(n):
        x[p] = b[p]
        for q in range(p + 1):
            total = A[p, q]
            for r in range(q):
                total -= A[p, r] * A[q, r]
            A[p, q] = np.sqrt(total) if p == q else total / A[q, q]
        for r in range(p):
            x[p] -= A[p, r] * x[r]
        x[p] /= A[p, p]
    for p in range(n - 1, -1, -1):
        for r in range(p + 1, n):
            x[p] -= A[r, p] * x[r]
        x[p] /= A[p, p]


@_compiled(
    "void(f8[:,::1],f8[:,:,::1],f8[:,::1],f8[:,::1],f8[::1],f8[::1],f8,UniTuple(f8[::1],3),"
    "f8[:,::1])"
)
def step(
    teats: Array,
    jacobian: Array,
    offset: Array,
    weight: Array,
    usual: Array,
    sure: Array,
    damping: float,
    limits: tuple[Array, Array, Array],
    moved: Array,
) -> None:
    """`fit.step`: fills teats (m, 8); ``limits``: of the step, and of teats after it."""
    longest, least, most = limits
    H, b, change = np.zeros((len(teats), 8, 8)), np.zeros((len(teats), 8)), np.empty(8)
    squares(jacobian, offset, weight, H, b)
    for i in range(len(teats)):
        A = H[i]
        for p in range(8):
            A[p, p] = (A[p, p] + sure[p]) * (1.0 + damping)
            if sure[p] > 1e-6:
                b[i, p] += sure[p] * (usual[p] - teats[i, p])
        _solve(A, b[i], change)
        too_long = 1.0
        for p in range(8):
            too_long = max(too_long, abs(change[p]) / longest[p])
        for p in range(8):
            moves = change[p] / too_long
            value = teats[i, p] + (0.0 if np.isnan(moves) else moves)
            moved[i, p] = min(max(value, least[p]), most[p])
