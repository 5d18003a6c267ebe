"""Calibrations of other tools, in and out: OpenCV's FileStorage, Bouguet's stereo .mat, and ROS
camera_info; in only: Kalibr's camchain and MATLAB's stereo parameters as a structure.

Strategy: each format gives and takes a `Part`: lenses, and the stereo motion where the format has
one. What a format can't hold is not written, and named by `lacks`. Sources: OpenCV FileStorage (the
keys of its stereo_calib sample: M1 D1 M2 D2 in intrinsics.yml, R T in extrinsics.yml); Bouguet's
toolbox, Calib_Results_stereo.mat (om, T, fc_left ...); ROS sensor_msgs/CameraInfo as
camera_calibration_parsers writes it, P[0,3] = -fx B for the right camera of a rectified pair;
Kalibr, "YAML formats" (T_cn_cnm1 in metres); MATLAB, toStruct of stereoParameters (pixels from 1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.io import savemat

from bench.calibrate.foreign import ForeignFile, read_mat, read_storage, read_yaml
from bench.calibrate.mat_values import OBJECT
from bench.config import ConfigError, several, writing
from detector.calibration import ParameterCovariance, Part
from detector.calibration.gate import lens_faults
from detector.geometry import Array, Camera, Motion
from instruments.camera.cameras import MakersCalibration
from textfiles.whole import replace_whole

PLUMB_BOB = "plumb_bob"
ONLY = f"only {PLUMB_BOB} (k1 k2 p1 p2 k3) can be taken over"
SIDES = ("left", "right")
# what other programs call the model of k1 k2 p1 p2 k3; of the longer ones the rest must be zero
PLAIN_MODELS = ("", "plumb_bob", "radtan", "radial-tangential", "brown", "brown-conrady", "opencv")
LONGER_MODELS = ("rational_polynomial", "rational", "thin_prism")
PINHOLES = ("", "pinhole", "perspective", *PLAIN_MODELS[1:], *LONGER_MODELS)
COUNTS = (4, 5, 8, 12, 14)  # OpenCV's: with rational, thin prism and tilted terms from 8 on
METRE_MM = 1000.0
WORLD_UNITS_MM = {
    **dict.fromkeys(("", "mm", "millimeters", "millimetres", "millimeter"), 1.0),
    **dict.fromkeys(("m", "meters", "metres", "meter"), METRE_MM),
    **dict.fromkeys(("cm", "centimeters", "centimetres", "centimeter"), 10.0),
    **dict.fromkeys(("in", "inches", "inch"), 25.4),
}


def read_opencv(path: Path, image_size: tuple[int, int] | None = None) -> Part:
    """OpenCV's M1 D1 M2 D2 and, if there, R T; ``image_size`` for files without. ConfigError."""
    found = read_storage(path)
    _refuse_other_model(found)
    names: list[tuple[str, ...]] = [
        (f"M{n}", f"K{n}", f"cameraMatrix{n}", f"camera_matrix_{n}", f"CM{n}") for n in (1, 2)
    ]
    names += [(f"D{n}", f"distCoeffs{n}", f"dist_coeffs_{n}", f"distortion_{n}") for n in (1, 2)]
    (M1, M2, D1, D2) = (found.first(*each)[0] for each in names)
    if missing := [name for name in (M1, D1, M2, D2) if found.values.get(name) is None]:
        raise ConfigError.plain(
            f"{path}: lacks {', '.join(missing)}; wanted: the stereo pair's M1 D1 M2 D2, and R T"
        )
    size = image_size or _storage_size(found)
    left, right = (
        _camera(found, (M, found.numbers(M, 9)), (D, found.numbers(D)), size)
        for M, D in ((M1, D1), (M2, D2))
    )
    (R, turn), (T, _) = found.first("R"), found.first("T")
    motion = None
    if turn is not None and found.values.get(T) is not None:
        motion = _motion(found, R, found.numbers(R, 3, 9), T, found.numbers(T, 3))
    return Part(left=left, right=right, right_from_left=motion)


def _storage_size(found: ForeignFile) -> tuple[int, int]:
    name, value = found.first("image_size", "imageSize", "img_size", "image_Size")
    if isinstance(value, dict) and {"width", "height"} <= value.keys():
        value = [value["width"], value["height"]]
    if value is None:
        keys = ("image_width", "image_height")
        name, value = "image_size", [found.values.get(key) for key in keys]
    if None in (value if isinstance(value, list) else ()):
        raise ConfigError.plain(f"{found.path}: lacks image_size; say it with `image_size`")
    return _size(found, name, found.whole(name, 2, value=value))


def write_opencv(part: Part, path: Path | str) -> None:
    """OpenCV's YAML, keys as `read_opencv` wants them. Raises ConfigError."""
    left, right, motion = _pair(part)
    # in memory: OpenCV doesn't say where it can't write
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_size", np.array(left.image_size, dtype=np.int32).reshape(1, 2))
    for number, camera in ((1, left), (2, right)):
        storage.write(f"M{number}", camera.matrix)
        storage.write(f"D{number}", np.array(camera.kc).reshape(1, 5))
    if motion:
        storage.write("R", np.array(motion.R))
        storage.write("T", np.array(motion.T).reshape(3, 1))
    _write(path, storage.releaseAndGetString().encode())


def read_maker(given: MakersCalibration, sizes: Mapping[str, tuple[int, int]], source: str) -> Part:
    """What a camera group's maker states of pictures of these sizes. Raises ConfigError."""
    found = ForeignFile(Path(source), {})
    if {"left", "right"} - set(given.lenses) or set(given.lenses) - {"left", "right", "depth"}:
        raise found.refusal("lenses", f"are {', '.join(given.lenses)}; left, right, perhaps depth")
    lenses, motions = {}, {}
    for part, one in given.lenses.items():
        if tuple(one.size_px) != sizes.get(part):
            seen = f"is {one.size_px}, its pictures are {sizes.get(part, 'not there')}"
            raise found.refusal(f"{part} size_px", seen)
        K = found.numbers(f"{part} matrix", 9, value=np.asarray(one.matrix).tolist())
        D = found.numbers(f"{part} distortion", value=list(one.distortion))
        R = found.numbers(f"{part} R", 9, value=np.asarray(one.R).tolist())
        T_mm = found.numbers(f"{part} T_mm", 3, value=list(one.T_mm))
        lens = (f"{part} matrix", K), (f"{part} distortion", D)
        lenses[part] = _camera(found, *lens, _size(found, f"{part} size_px", one.size_px))
        motions[part] = _motion(found, f"{part} R", R, f"{part} T_mm", T_mm)
    names = [(owner, name) for owner, _, name in (key.rpartition(" ") for key in given.sd)]
    if odd := next((key for key, sd in given.sd.items() if not 0.0 <= sd < np.inf), None):
        raise found.refusal(f"sd of {odd}", f"is {given.sd[odd]:g}; 0 or more")
    try:
        sd = np.array(list(given.sd.values()), dtype=np.float64)
        covariance = ParameterCovariance(tuple(names), np.diag(sd**2)) if names else None
    except ValueError as error:
        raise found.refusal("sd", f"can't be: {error}") from error
    return Part(
        left=lenses["left"],
        right=lenses["right"],
        right_from_left=motions["right"],
        depth=lenses.get("depth"),
        depth_from_left=motions.get("depth"),
        covariance=covariance,
    )


def read_bouguet(path: Path) -> Part:
    """Bouguet's Calib_Results_stereo.mat. Raises ConfigError."""
    found = read_mat(path)
    wanted = [f"{key}_{side}" for side in SIDES for key in ("fc", "cc", "kc")]
    if missing := [n for n in (*wanted, "om", "T", "nx", "ny") if found.values.get(n) is None]:
        raise ConfigError.plain(
            f"{path}: lacks {', '.join(missing)}; wanted: the file that the stereo calibration of"
            " Bouguet's toolbox saves"
        )
    size = _size(found, "nx, ny", (*found.whole("nx", 1), *found.whole("ny", 1)))
    cameras = []
    for side in SIDES:
        (fx, fy), (cx, cy) = (found.numbers(f"{key}_{side}", 2).tolist() for key in ("fc", "cc"))
        alpha = f"alpha_c_{side}"
        skew = float(found.numbers(alpha, 1)[0]) if alpha in found.values else 0.0
        K = np.array([fx, fx * skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        kc = f"kc_{side}"
        cameras.append(_camera(found, (f"fc_{side}", K), (kc, found.numbers(kc)), size))
    motion = _motion(found, "om", found.numbers("om", 3), "T", found.numbers("T", 3))
    return Part(left=cameras[0], right=cameras[1], right_from_left=motion)


def write_bouguet(part: Part, path: Path | str) -> None:
    """A .mat file as Bouguet's toolbox loads it. Raises ConfigError without a stereo motion."""
    left, right, motion = _pair(part)
    if motion is None:
        raise ConfigError.plain(
            "Bouguet's stereo file needs the motion between the cameras ([stereo])"
        )
    columns, rows = left.image_size
    values: dict[str, Any] = {"nx": columns, "ny": rows, "om": motion.om.reshape(3, 1)}
    values |= {"T": motion.T.reshape(3, 1), "R": np.array(motion.R)}
    for side, camera in zip(SIDES, (left, right), strict=True):
        values |= {
            f"{key}_{side}": np.array(getattr(camera, key)).reshape(-1, 1)
            for key in ("fc", "cc", "kc")
        }
        values |= {f"alpha_c_{side}": camera.alpha_c, f"KK_{side}": camera.matrix}
    savemat(data := BytesIO(), values)
    _write(path, data.getvalue())


def read_ros(left: Path, right: Path | None = None) -> Part:
    """camera_info of the left and, if given, the right camera; no motion. Raises ConfigError."""
    return Part(left=_ros_camera(left), right=_ros_camera(right) if right else None)


def _ros_camera(path: Path) -> Camera:
    """A camera_info file, or the message as it is printed (K, D, width, height)."""
    found = read_yaml(path)
    _refuse_other_model(found)
    (width, _), (height, _) = (
        found.first("image_width", "width"),
        found.first("image_height", "height"),
    )
    size = _size(found, f"{width}, {height}", (*found.whole(width, 1), *found.whole(height, 1)))
    _refuse_part_of_sensor(found, size)
    (K, _), (D, _) = (
        found.first("camera_matrix", "K", "k"),
        found.first("distortion_coefficients", "D", "d"),
    )
    return _camera(found, (K, found.numbers(K, 9)), (D, found.numbers(D)), size)


def _refuse_part_of_sensor(found: ForeignFile, size: tuple[int, int]) -> None:
    """Raise ConfigError for pictures of a part of the sensor, or binned: K is of the whole."""
    for name in ("binning_x", "binning_y"):
        if found.values.get(name) is not None and found.whole(name, 1)[0] > 1:
            why = "K is of pictures without binning. Calibrate the pictures as they are delivered"
            raise found.refusal(name, f"is {found.whole(name, 1)[0]}: {why}")
    if found.values.get("roi") is None:
        return
    roi = found.table("roi")
    given = {name: roi.whole(name, 1)[0] for name in roi.values if name != "do_rectify"}
    whole = {"x_offset": (0,), "y_offset": (0,), "width": (0, size[0]), "height": (0, size[1])}
    if other := [name for name, value in given.items() if value not in whole.get(name, (value,))]:
        why = "the pictures are of a part of the sensor, K is of the whole. Calibrate that part"
        raise found.refusal("roi", f"has {other[0]} {given[other[0]]}: {why}")


def read_kalibr(path: Path) -> Part:
    """Kalibr's camchain: cam0 left, cam1 right, T_cn_cnm1 from metres. Raises ConfigError."""
    found = read_yaml(path)
    cameras = []
    for name in ("cam0", "cam1"):
        one = found.table(name)
        _refuse_other_model(one)
        fx, fy, cx, cy = one.numbers("intrinsics", 4).tolist()
        K = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        size = _size(one, "resolution", one.whole("resolution", 2))
        D = "distortion_coeffs"
        cameras.append(_camera(one, ("intrinsics", K), (D, one.numbers(D)), size))
    second, name = found.table("cam1"), "T_cn_cnm1"
    T = second.numbers(name, 16).reshape(4, 4)
    if not np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0)):
        raise second.refusal(name, f"must have 0 0 0 1 as its lowest row, has {T[3].tolist()}")
    motion = _motion(second, name, T[:3, :3].ravel(), name, METRE_MM * T[:3, 3])
    return Part(left=cameras[0], right=cameras[1], right_from_left=motion)


def read_matlab(path: Path) -> Part:
    """MATLAB's stereoParameters, saved as toStruct gives them. Raises ConfigError."""
    found = read_mat(path)
    held = [v for v in found.values.values() if isinstance(v, dict) and "CameraParameters1" in v]
    if not held and (OBJECT in found.values.values() or "" in found.values):
        raise ConfigError.plain(
            f"{path}: holds {OBJECT}, which MATLAB alone can read. In MATLAB: s ="
            " toStruct(stereoParams); save('stereo.mat', 's', '-v7')"
        )
    if len(held) != 1:
        raise ConfigError.plain(
            f"{path}: holds {len(held)} structures with CameraParameters1; wanted: one, as"
            " toStruct(stereoParams) gives it"
        )
    stereo = ForeignFile(path, held[0])
    tables = [stereo.table(f"CameraParameters{n}") for n in (1, 2)]
    left, right = (_matlab_camera(one) for one in tables)
    unit = tables[0].word("WorldUnits").lower()
    if unit not in WORLD_UNITS_MM:
        raise tables[0].refusal("WorldUnits", f"is {unit!r}; known are {', '.join(WORLD_UNITS_MM)}")
    pose = stereo.values.get("PoseCamera2")
    if isinstance(pose, dict):
        given, (R, T), transposed = stereo.table("PoseCamera2"), ("R", "Translation"), False
    else:
        given, (R, T) = stereo, ("RotationOfCamera2", "TranslationOfCamera2")
        transposed = True  # x2 = x1 R + t, of rows
    turn = given.numbers(R, 9).reshape(3, 3)
    turn = turn.T if transposed else turn
    T_mm = WORLD_UNITS_MM[unit] * given.numbers(T, 3)
    return Part(left=left, right=right, right_from_left=_motion(given, R, turn.ravel(), T, T_mm))


def _matlab_camera(one: ForeignFile) -> Camera:
    """Pixels count from 1 there, and rows come before columns."""
    rows, columns = one.whole("ImageSize", 2)
    name, K = one.first("K", "IntrinsicMatrix")
    matrix = one.numbers(name, 9, value=K).reshape(3, 3)
    matrix = matrix if name == "K" else matrix.T
    radial = np.append(one.numbers("RadialDistortion", 2, 3), 0.0)
    tangential = one.numbers("TangentialDistortion", 2)
    kc = np.array([*radial[:2], *tangential, radial[2]])
    matrix[:2, 2] -= matrix[2, 2]  # 1, or refused below
    size = _size(one, "ImageSize", (columns, rows))
    return _camera(one, (name, matrix.ravel()), ("RadialDistortion", kc), size)


READERS: dict[str, Callable[[Path], Part]] = {
    "bouguet": read_bouguet,
    "kalibr": read_kalibr,
    "matlab": read_matlab,
}


def read_foreign(
    files: Sequence[Path | str], kind: str, image_size: tuple[int, int] | None = None
) -> Part:
    """The files of another tool, with lenses that can be. Raises ConfigError."""
    paths = [*map(Path, several("files", files, 1))]
    if kind not in (kinds := ("opencv", "ros", *READERS)):
        raise ConfigError.plain(f"kind is {kind!r}, not one of: {', '.join(kinds)}")
    if len(files) > (2 if kind == "ros" else 1):
        most = "two files at most, left and right" if kind == "ros" else "one file"
        raise ConfigError.plain(f"{kind} takes {most}")
    if kind == "opencv":
        return read_opencv(paths[0], image_size)
    return read_ros(*paths) if kind == "ros" else READERS[kind](paths[0])


def write_ros(part: Part, path: Path | str, camera: str) -> None:
    """The camera_info of one camera, unrectified. Raises ConfigError if it isn't there."""
    lens = {
        "left": part.left,
        "right": part.right,
        "thermal": part.thermal.lens if part.thermal else None,
    }.get(camera)
    if lens is None:
        raise ConfigError.plain(
            f"the calibration has no lens of the {camera} camera: name another as `camera`"
        )
    K = lens.matrix

    def matrix(values: Array) -> dict[str, Any]:
        rows, columns = values.shape
        return {"rows": rows, "cols": columns, "data": values.reshape(-1).tolist()}

    read = {
        "image_width": lens.image_size[0],
        "image_height": lens.image_size[1],
        "camera_name": camera,
        "camera_matrix": matrix(K),
        "distortion_model": PLUMB_BOB,
        "distortion_coefficients": matrix(np.array([lens.kc])),
        "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(np.column_stack([K, np.zeros(3)])),
    }
    _write(path, yaml.safe_dump(read, sort_keys=False).encode())


def _write(path: Path | str, data: bytes) -> None:
    """The whole file or none. Raises ConfigError."""
    with writing(Path(path)):
        replace_whole(Path(path), data)


def _refuse_other_model(found: ForeignFile) -> None:
    """Raise ConfigError for a lens model that has no k1 k2 p1 p2 k3, by whichever key names it."""
    known = {"distortion_model": (*PLAIN_MODELS, *LONGER_MODELS, "none"), "camera_model": PINHOLES}
    for name, models in known.items():
        if (model := found.word(name).lower()) not in models:
            raise found.refusal(name, f"is {model!r}; {ONLY}")
    for name in ("fisheye_model", "fisheye", "is_fisheye"):
        if found.values.get(name) not in (None, 0, "0", False, "false"):
            raise found.refusal(name, f"is set; {ONLY}")


def _size(found: ForeignFile, name: str, size: tuple[int, ...]) -> tuple[int, int]:
    if not all(1 <= n <= 65535 for n in size):
        raise found.refusal(name, f"must be 1 to 65535 pixels, is {' x '.join(map(str, size))}")
    return size[0], size[1]


def _motion(found: ForeignFile, turn: str, R: Array, shift: str, T_mm: Array) -> Motion:
    """Of a rotation matrix by rows (9,) or a rotation vector (3,). Raises ConfigError."""
    try:
        if len(R) == 3:
            return Motion.from_vectors(R, T_mm)
        return Motion(R.reshape(3, 3), T_mm)
    except ValueError as error:
        names = turn if turn == shift else f"{turn} and {shift}"
        raise ConfigError.plain(f"{found.path}: {names} are no motion: {error}") from error


def _camera(
    found: ForeignFile, K: tuple[str, Array], D: tuple[str, Array], size: tuple[int, int]
) -> Camera:
    """A camera that can be, of its matrix (9,) and coefficients by their names. ConfigError."""
    (name, matrix), (of_lens, values) = K, D
    (fx, skew, u), (below, fy, v), last = matrix.reshape(3, 3).tolist()
    if last != [0.0, 0.0, 1.0] or below != 0.0:
        why = "its lower row must be 0 0 1, and 0 stand before fy"
        turned = " It is transposed" if matrix.reshape(3, 3).T[2].tolist() == [0, 0, 1] else ""
        raise found.refusal(name, f"is no camera matrix: {why}; is {matrix.tolist()}.{turned}")
    if not (fx > 0 and fy > 0):
        raise found.refusal(name, f"must have focal lengths above zero, has {fx:g} and {fy:g}")
    model = found.word("distortion_model").lower()
    none = model == "none" and not np.any(values)
    if len(values) not in COUNTS and not none:
        counts = ", ".join(map(str, COUNTS))
        raise found.refusal(of_lens, f"has {len(values)} coefficients; there may be {counts}")
    if np.any(values[5:]):
        raise found.refusal(
            of_lens, f"has {len(values)} coefficients; only k1 k2 p1 p2 k3 can be taken over"
        )
    k1, k2, p1, p2, k3 = (float(one) for one in np.append(values[:5], np.zeros(5))[:5])
    camera = Camera(size, (fx, fy), (u, v), skew / fx, (k1, k2, p1, p2, k3))
    for key, why in lens_faults(camera):
        raise found.refusal(of_lens if key == "kc" else name, f"can't be of a camera: {why}")
    return camera


def _pair(part: Part) -> tuple[Camera, Camera, Motion | None]:
    if part.left is None or part.right is None:
        raise ConfigError.plain(
            "the file holds no stereo pair ([cameras.left] and [cameras.right])"
        )
    return part.left, part.right, part.right_from_left
