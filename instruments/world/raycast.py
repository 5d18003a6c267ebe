"""Where a ray meets a solid: depth, normal and whether it meets it at all, over any number of pairs at once.

Rays start at the camera and pass through (x, y, 1), so the parameter along a ray is the depth. A ray that just misses
still gets the depth and normal of the limb: a pixel that is half covered has its centre off the solid. Vectors are
rows, (3, n): sums over three rows are several times as fast as sums along three columns.
May not know of pixels, paint or lights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world.optics import Floats
from instruments.world.solids import Bools, Ints, Solids

BLOCK = 8192  # pairs at a time: what is worked out on the way stays in the processor's cache


def dot(u: NDArray[Any], v: NDArray[Any]) -> NDArray[Any]:
    """Scalar products of the columns of (3, n) with those of (3, n), (3, 1) or (3,), float32 or float64."""
    return np.asarray(u[0] * v[0] + u[1] * v[1] + u[2] * v[2])


def meet(solids: Solids, which: Ints, x: Floats, y: Floats) -> tuple[Floats, Floats, Bools]:
    """Ray (x, y, 1) with solid ``which``, each (n,): depth (n,) mm, outward unit normal (3, n), truly hit (n,).

    ``solids`` are in the camera's frame; the camera must be outside of them.
    """
    depth, hit, normal = np.empty(len(x)), np.empty(len(x), dtype=np.bool_), np.empty((3, len(x)))
    for start in range(0, len(x), BLOCK):
        part = slice(start, start + BLOCK)
        depth[part], normal[:, part], hit[part] = _meet_block(solids, which[part], x[part], y[part])
    return depth, normal, hit


def _meet_block(solids: Solids, which: Ints, x: Floats, y: Floats) -> tuple[Floats, Floats, Bools]:
    depth, height, hit = _meet_cone(solids, which, x, y)
    rays = np.stack([x, y, np.ones_like(x)])
    slope, radius_0, *vectors = np.take(np.stack([solids.slope, solids.radius_0, *solids.a.T, *solids.axis.T]), which, axis=1)
    # Off the axis, and tilted by the cone's slope: n = p - a - h axis - k (r0 + k h) axis.
    along = height + slope * (radius_0 + slope * height)
    normal = np.stack([depth * ray - start - along * axis for ray, start, axis in zip(rays, vectors[:3], vectors[3:], strict=True)])
    for below in (True, False):
        beyond = height < solids.low[which] if below else height > solids.high[which]
        flat = (solids.flat_a if below else solids.flat_b)[which]
        for solve, chosen in ((_meet_disc, beyond & flat), (_meet_ball, beyond & ~flat)):
            index = np.flatnonzero(chosen)
            if len(index):
                hit[index] = solve(solids, which[index], rays[:, index], below, depth, normal, index)
    normal /= np.sqrt(dot(normal, normal))
    return depth, normal, hit


def _meet_cone(solids: Solids, which: Ints, x: Floats, y: Floats) -> tuple[Floats, Floats, Bools]:
    """The endless cone of the body: |p|^2 - h^2 = (r0 + k h)^2, a quadratic in the depth, with the camera as origin."""
    a, axis, r0, k = solids.a.T, solids.axis.T, solids.radius_0, solids.slope
    h0 = -dot(a, axis)
    bend = 1.0 + k * k
    # qb is linear in the ray: its coefficients, and those of the height, are one for each solid.
    to_b = -a - (bend * h0 + k * r0) * axis
    qc = dot(a, a) - bend * h0 * h0 - 2.0 * k * r0 * h0 - r0 * r0
    axis_x, axis_y, axis_z, b_x, b_y, b_z, bend, h0, qc = np.take(np.stack([*axis, *to_b, bend, h0, qc]), which, axis=1)
    dh = x * axis_x + y * axis_y + axis_z
    qb = x * b_x + y * b_y + b_z
    qa = np.maximum(x * x + y * y + 1.0 - bend * dh * dh, 1e-9)  # a ray along the axis meets an end, never the body
    under = qb * qb - qa * qc
    depth = (-qb - np.sqrt(np.maximum(under, 0.0))) / qa
    return depth, h0 + depth * dh, under >= 0.0


def _meet_ball(solids: Solids, which: Ints, rays: Floats, below: bool, depth: Floats, normal: Floats, index: Ints) -> Bools:
    centre = (solids.a if below else solids.b)[which].T
    radius = (solids.radius_a if below else solids.radius_b)[which]
    qa = dot(rays, rays)
    middle = dot(rays, centre) / qa
    # Distance of the centre from the ray first: b^2 - a c would lose half of the digits at a metre.
    foot = middle * rays - centre
    under = radius * radius - dot(foot, foot)
    depth[index] = middle - np.sqrt(np.maximum(under, 0.0) / qa)
    normal[:, index] = depth[index] * rays - centre
    return np.asarray(under >= 0.0)


def _meet_disc(solids: Solids, which: Ints, rays: Floats, below: bool, depth: Floats, normal: Floats, index: Ints) -> Bools:
    centre = (solids.a if below else solids.b)[which].T
    radius = (solids.radius_a if below else solids.radius_b)[which]
    outward = solids.axis[which].T * (-1.0 if below else 1.0)
    towards = dot(rays, outward)
    facing = towards < -1e-9
    at = dot(centre, outward) / np.where(facing, towards, -1.0)
    off = at * rays - centre
    hit = facing & (dot(off, off) <= radius * radius)
    # A ray that misses keeps the rim's depth and normal from the cone.
    depth[index[hit]] = at[hit]
    normal[:, index[hit]] = outward[:, hit]
    return np.asarray(hit)
