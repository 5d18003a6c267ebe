"""Scenes drawn by Mitsuba, a path tracer of others: light, gloss, shade and warmth as nobody here
wrote them. Shapes and cameras are its own; of the detector only the calibration is read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.external.serve import Pictures

Array = NDArray[np.float64]
KINDS = ("plain", "gloss", "cow", "rods", "legs", "liners")
_UDDER_MM = np.array([[-34.0, -55.0], [34.0, -55.0], [-88.0, 55.0], [88.0, 55.0]])
_MIDDLE_MM = np.array([-160.0, 235.0, 30.0])  # of the udder, on the table
_LEVEL = np.linspace(0, np.pi / 2, 60)
_COLDEST_C, _SPAN_K = -10.0, 80.0  # a reflectance of 0 and of 1 in the thermal picture
_SEEN = 0.7  # share of an end's front that all cameras see, of a visible one


@dataclass(frozen=True)
class Traced:
    """The pictures, ends (n, 3) in the world, mm, and which all cameras see (n,)."""

    pictures: Pictures
    ends_mm: Array
    visible: NDArray[np.bool_]

    @property
    def rows(self) -> list[dict[str, str]]:
        """As a recording's truth.csv has them."""
        return [
            {"x_mm": f"{x}", "y_mm": f"{y}", "z_mm": f"{z}", "visible": f"{int(seen)}"}
            for (x, y, z), seen in zip(self.ends_mm.tolist(), self.visible, strict=True)
        ]


def without_distortion(rig: Calibration) -> Calibration:
    """The rig with pinholes for lenses, and square pixels, as this path tracer has them."""
    straight = {"kc": (0.0,) * 5, "alpha_c": 0.0}

    def pinhole(camera: Any) -> Any:
        return replace(camera, fc=(camera.fc[0],) * 2, **straight)

    thermal = replace(rig.thermal, lens=pinhole(rig.thermal.lens))
    return replace(rig, left=pinhole(rig.left), right=pinhole(rig.right), thermal=thermal)


def _moved(axis: Array, foot: Array) -> Array:
    """The motion (4, 4) that puts a shape's z along ``axis`` and its origin at ``foot``."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    motion = np.eye(4)
    motion[:3] = np.column_stack([x, np.cross(z, x), z, foot])
    return motion


class Scene:
    """Things with a surface and a temperature, as a path tracer takes them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.things: list[tuple[dict[str, Any], dict[str, Any], float]] = []

    def add(self, shape: dict[str, Any], surface: dict[str, Any], celsius: float) -> None:
        self.things.append((shape, surface, celsius))

    def lathe(self, z: Array, radius: Array, motion: Array) -> dict[str, Any]:
        """A surface of revolution about z, by its profile (n,), as a file of triangles."""
        turn = np.linspace(0, 2 * np.pi, 128, endpoint=False)
        ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(128)], axis=1)
        out = np.gradient(z)[:, None, None] * ring
        out[..., 2] = -np.gradient(radius)[:, None]
        out /= np.linalg.norm(out, axis=2, keepdims=True)
        points = radius[:, None, None] * ring
        points[..., 2] = z[:, None]
        first = np.arange(len(z) - 1)[:, None] * 128
        here, after = np.arange(128), (np.arange(128) + 1) % 128
        corners = np.array([[here, after, 128 + after], [here, 128 + after, 128 + here]])
        faces = (first[:, None, None] + corners).transpose(0, 1, 3, 2).reshape(-1, 3)
        vertices = np.concatenate(
            [points.reshape(-1, 3) @ motion[:3, :3].T + motion[:3, 3],
             out.reshape(-1, 3) @ motion[:3, :3].T], axis=1,
        )  # fmt: skip
        kinds = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        head = (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{kinds}"
            f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        rows = np.zeros(len(faces), dtype=[("n", "u1"), ("at", "<i4", 3)])
        rows["n"], rows["at"] = 3, faces
        path = self.folder / f"{len(self.things)}.ply"
        path.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
        return {"type": "ply", "filename": str(path)}


def _matt(grey: float) -> dict[str, Any]:
    return {
        "type": "twosided",
        "of": {"type": "diffuse", "reflectance": {"type": "rgb", "value": grey}},
    }


def _glossy(grey: float, rough: float) -> dict[str, Any]:
    colour = {"type": "rgb", "value": grey}
    plastic = {"type": "roughplastic", "diffuse_reflectance": colour, "alpha": rough}
    return {"type": "twosided", "of": plastic}


def traced(seed: int, rig: Calibration, folder: Path) -> Traced:
    """A scene of ``KINDS[seed % 6]``; ``rig`` as `without_distortion` gives it."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    rng, kind, scene = np.random.default_rng([seed, 7]), KINDS[seed % len(KINDS)], Scene(folder)
    draw = rng.uniform
    room, warm, grey = draw(8, 24), draw(33, 38), float(rng.choice([0.06, 0.2, 0.45]))
    wall = float(rng.choice([v for v in (0.15, 0.35, 0.6, 0.8) if abs(v - grey) > 0.12]))
    skin = _glossy(grey, draw(0.08, 0.3)) if kind in ("gloss", "legs") else _matt(grey)
    flat = {"table": (draw(0.15, 0.7), np.eye(4)), "wall": (wall, np.eye(4))}
    flat["wall"][1][:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    flat["wall"][1][:3, 3] = [0.0, draw(300, 700), 400.0]
    for shade, motion in flat.values():
        motion = motion @ np.diag([1500.0, 1500.0, 1.0, 1.0])
        motion[:3, 3] += _MIDDLE_MM
        square = {"type": "rectangle", "to_world": mi.ScalarTransform4f(motion)}
        scene.add(square, _matt(shade), room + draw(-1, 1))
    teats = list[tuple[Array, float, float, float]]()
    for place in _UDDER_MM[rng.permutation(4)[: rng.choice([2, 3, 4, 4, 4])]]:
        foot = _MIDDLE_MM + np.append(place + draw(-9, 9, 2), 45.0 if kind == "cow" else 0.0)
        length, radius = draw(65, 90) if kind == "cow" else draw(80, 110), draw(9.5, 12.5)
        height = draw(0.85, 1.15)
        motion = _moved(np.array([*rng.normal(0, 0.08, 2), 1.0]), foot)
        straight = length - height * radius
        z = np.concatenate([[-15.0, 0.5 * straight], straight + height * radius * np.sin(_LEVEL)])
        across = np.concatenate([[radius, radius], radius * np.cos(_LEVEL) + 1e-4])
        scene.add(scene.lathe(z, across, motion), skin, warm + rng.normal(0, 0.8))
        teats.append((motion, length, radius, height))
    if kind == "cow":
        flank = _moved(np.array([0.0, 0.0, 1.0]), _MIDDLE_MM - [0, 0, 2])
        dome = scene.lathe(draw(55, 75) * np.sin(_LEVEL), 140 * np.cos(_LEVEL) + 1e-3, flank)
        scene.add(dome, skin, warm - draw(0, 3))
    _things(scene, kind, rng, room, warm, np.array([motion[:3, 3] for motion, *_ in teats]))
    lights: dict[str, Any] = {"sky": {"type": "constant", "radiance": draw(0.05, 0.35)}}
    for k in range(rng.integers(1, 3)):
        at = _MIDDLE_MM + draw([-700, -900, 500], [700, 100, 1100])
        aimed = mi.ScalarTransform4f().look_at(at.tolist(), _MIDDLE_MM.tolist(), [0.1, 0.9, 0.3])
        glow = {"type": "area", "radiance": {"type": "rgb", "value": draw(8, 25)}}
        size = mi.ScalarTransform4f().scale(draw(60, 250))
        lights[f"lamp{k}"] = {"type": "rectangle", "to_world": aimed @ size, "emitter": glow}
    return _taken(scene, lights, teats, rig, rng, seed)


def _things(
    scene: Scene, kind: str, rng: np.random.Generator, room: float, warm: float, feet: Array
) -> None:
    """What stands about the teats, the feet of which are given (n, 3)."""
    up, draw = np.array([0.0, 0.0, 1.0]), rng.uniform
    for _ in range(rng.integers(1, 3)):
        foot, surface = rng.choice(feet), _matt(draw(0.05, 0.7))
        if kind == "rods":
            there = foot + draw([-14, 60, 0], [14, 250, 0])
            rod = {"type": "cylinder", "p0": there.tolist(), "radius": draw(4, 10)}
            scene.add(rod | {"p1": (there + draw(150, 400) * up).tolist()}, surface, room)
        elif kind == "legs":
            there, wide = _MIDDLE_MM + draw([-110, 120, 0], [110, 260, 0]), draw(25, 45)
            leg = np.array([wide, 1.25 * wide, 1.5 * wide])
            shape = scene.lathe(np.array([0.0, 225.0, 450.0]), leg, _moved(up, there))
            scene.add(shape, surface, draw(room + 4, warm - 2))
        elif kind == "liners":
            there, wide, high = (
                foot + draw([-70, 60, 0], [70, 90, 0]),
                draw(18, 25),
                draw(80, 120),
            )
            if np.linalg.norm(feet - there, axis=1).min() > 48:
                z = np.array([-5.0, high - 2, high, high, high - 2, high - 40])
                rim = wide - np.array([0.0, 0.0, 1.0, 3.0, 4.0, 4.0])
                shape = scene.lathe(z, rim, _moved(up + rng.normal(0, [0.1, 0.1, 0]), there))
                scene.add(shape, _glossy(0.2, 0.2), draw(room, warm))


def _taken(
    scene: Scene,
    lights: dict[str, Any],
    teats: list[tuple[Array, float, float, float]],
    rig: Calibration,
    rng: np.random.Generator,
    seed: int,
) -> Traced:
    import mitsuba as mi

    shown: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 5}}
    warmth: dict[str, Any] = {"type": "scene", "sky": {"type": "constant"}}
    warmth["integrator"] = {"type": "aov", "aovs": "warmth:albedo"}
    for k, (shape, surface, celsius) in enumerate(scene.things):
        shown[f"{k}"] = shape | {"surface": surface}
        warmth[f"{k}"] = shape | {"surface": _matt((celsius - _COLDEST_C) / _SPAN_K)}
    lit, warm = mi.load_dict(shown | lights), mi.load_dict(warmth)
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    world = rig.world_from_right
    poses = [world @ rig.right_from_left, world, world @ rig.thermal_from_right.inverse()]

    def sensor(which: int, size: tuple[int, int], window: Array, samples: int, sd: float) -> Any:
        camera = (rig.left, rig.right, rig.thermal.lens)[which]
        assert camera is not None
        scale = camera.image_size[0] / size[0]
        focal, middle = camera.fc[0] / scale, (np.array(camera.cc) + 0.5) / scale
        off = (np.array(size) / 2 - middle) / size
        place = np.eye(4)
        place[:3] = np.column_stack([poses[which].R, poses[which].T])
        film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgb"}
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(names, map(int, window), strict=True))
        film["rfilter"] = {"type": "gaussian", "stddev": sd}
        return mi.load_dict({
            "type": "perspective", "fov": float(np.degrees(2 * np.arctan(size[0] / 2 / focal))),
            "fov_axis": "x", "principal_point_offset_x": off[0],
            "principal_point_offset_y": off[1], "near_clip": 10.0, "far_clip": 1e5,
            "to_world": mi.ScalarTransform4f(place @ np.diag([-1.0, -1.0, 1.0, 1.0])),
            "film": film, "sampler": {"type": "independent", "sample_count": samples},
        })  # fmt: skip

    about = _MIDDLE_MM + np.array(np.meshgrid([-190, 190], [-120, 300], [-20, 180])).T.reshape(
        -1, 3
    )
    pictures, exposure = list[NDArray[Any]](), 0.0
    for which, places in enumerate(rig.project(about)):
        size = rig.right.image_size
        low = np.clip(places.min(axis=0), 0, np.array(size) - 64).astype(int)
        high = np.clip(places.max(axis=0), low + 64, size).astype(int)
        window = np.concatenate([low, high - low])
        grey = np.asarray(mi.render(lit, sensor=sensor(which, size, window, 32, 0.5), seed=seed))
        grey = grey[..., :3].mean(axis=2)
        exposure = exposure or _exposure_of(grey, rng)
        levels = np.full(size[::-1], np.median(grey) * exposure)
        levels[low[1] : high[1], low[0] : high[0]] = grey * exposure
        levels += rng.normal(0, 1, levels.shape) * np.sqrt(0.02 * levels + 0.6**2)
        pictures.append(np.clip(np.rint(levels), 0, 255).astype(np.uint8))
    size = rig.thermal.sensor_size
    seen = np.asarray(
        mi.render(warm, sensor=sensor(2, size, np.array([0, 0, *size]), 128, 0.6), seed=seed)
    )
    kelvin = seen[..., -3] * _SPAN_K + _COLDEST_C + 273.15
    kelvin += rng.normal(0, 0.05, kelvin.shape) + 0.02 * rng.normal(0, 1, (1, size[0]))
    ends = np.array([(motion @ [0, 0, length, 1])[:3] for motion, length, *_ in teats])
    shares = [min(_share_seen(warm, pose.T, *teat) for pose in poses) for teat in teats]
    left, right = pictures
    return Traced(Pictures(left, right, None, np.rint(100 * kelvin) / 100), ends,
                  np.array(shares) > _SEEN)  # fmt: skip


def _exposure_of(grey: Array, rng: np.random.Generator) -> float:
    """What takes a bright part of the picture to a bright level."""
    return float(255 * rng.uniform(0.45, 0.95) / np.percentile(grey, rng.uniform(80, 97)))


def _share_seen(
    scene: Any, eye: Array, motion: Array, length: float, radius: float, height: float
) -> float:
    """Of the half of a teat's end that faces an eye, the share that nothing hides."""
    import mitsuba as mi

    rng = np.random.default_rng(1)
    turn, level = rng.uniform(0, 2 * np.pi, 200), rng.uniform(0.1, 1.0, 200)
    ball = np.stack(
        [np.sqrt(1 - level**2) * np.cos(turn), np.sqrt(1 - level**2) * np.sin(turn), level], axis=1
    )
    points = (ball * [radius, radius, height * radius] + [0, 0, length - height * radius]) @ motion[
        :3, :3
    ].T + motion[:3, 3]
    out = (ball / [1, 1, height]) @ motion[:3, :3].T
    ways = points - eye
    facing = (ways * out).sum(axis=1) < 0
    far = np.linalg.norm(ways[facing], axis=1)
    rays = (
        mi.Ray3f(eye.tolist(), (way / d).tolist()) for way, d in zip(ways[facing], far, strict=True)
    )
    hits = np.array([scene.ray_intersect(ray).t for ray in rays])
    return float((hits > far - 1.2).mean())
