"""Calibrations of other tools, in and out: OpenCV's YAML, Bouguet's stereo .mat, and ROS
camera_info.

Strategy: each format gives and takes a `Part`: lenses, and the stereo motion where the format has
one. What a format can't hold is not written, and named by `lacks`. Sources: OpenCV FileStorage (the
keys of its stereo_calib sample: M1 D1 M2 D2 in intrinsics.yml, R T in extrinsics.yml); Bouguet's
toolbox, Calib_Results_stereo.mat (om, T, fc_left ...); ROS sensor_msgs/CameraInfo as
camera_calibration_parsers writes it, P[0,3] = -fx B for the right camera of a rectified pair.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.io import loadmat, savemat
from scipy.io.matlab import MatReadError

from bench.config import ConfigError
from detector.calibration import Part
from detector.geometry import Array, Camera, Motion

PLUMB_BOB = "plumb_bob"
SIDES = ("left", "right")


def read_opencv(path: Path, image_size: tuple[int, int] | None = None) -> Part:
    """OpenCV's M1 D1 M2 D2 and, if there, R T; ``image_size`` for files without. ConfigError."""
    if not path.is_file():
        raise ConfigError.plain(f"{path}: no such file")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise ConfigError.plain(f"{path}: OpenCV can't read it: {str(error).strip()}") from error
    if not storage.isOpened():
        raise ConfigError.plain(
            f"{path}: OpenCV can't read it as YAML or XML; does it begin with %YAML:1.0?"
        )
    names = ("M1", "D1", "M2", "D2", "R", "T", "image_size")
    found = {name: storage.getNode(name).mat() for name in names}
    storage.release()
    if missing := [name for name in names[:4] if found[name] is None]:
        raise ConfigError.plain(
            f"{path}: lacks {', '.join(missing)}; wanted: the stereo pair's M1 D1 M2 D2, and R T"
        )
    M1, D1, M2, D2, R, T, size = found.values()
    if image_size is None:
        if size is None or np.size(size) != 2:
            raise ConfigError.plain(
                f"{path}: lacks image_size; say it with --image-size COLUMNSxROWS"
            )
        columns, rows = np.ravel(size).astype(int).tolist()
        image_size = columns, rows
    try:
        motion = (
            None if R is None or T is None else Motion(R.astype(float), T.ravel().astype(float))
        )
    except ValueError as error:
        raise ConfigError.plain(f"{path}: R and T are no motion: {error}") from error
    left, right = _camera(M1, D1, image_size, path), _camera(M2, D2, image_size, path)
    return Part(left=left, right=right, right_from_left=motion)


def write_opencv(part: Part, path: Path) -> None:
    """OpenCV's YAML, keys as `read_opencv` wants them."""
    left, right, motion = _pair(part)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_size", np.array(left.image_size, dtype=np.int32).reshape(1, 2))
    for number, camera in ((1, left), (2, right)):
        storage.write(f"M{number}", camera.matrix)
        storage.write(f"D{number}", np.array(camera.kc).reshape(1, 5))
    if motion:
        storage.write("R", np.array(motion.R))
        storage.write("T", np.array(motion.T).reshape(3, 1))
    storage.release()


def read_bouguet(path: Path) -> Part:
    """Bouguet's Calib_Results_stereo.mat. Raises ConfigError."""
    try:
        found = loadmat(path)
    except (OSError, ValueError, NotImplementedError, MatReadError) as error:
        raise ConfigError.plain(
            f"{path}: can't be read as a .mat file (version 7 or older): {error}"
        ) from error
    wanted = [f"{key}_{side}" for side in SIDES for key in ("fc", "cc", "kc")]
    if missing := [name for name in (*wanted, "om", "T", "nx", "ny") if name not in found]:
        raise ConfigError.plain(
            f"{path}: lacks {', '.join(missing)}; wanted: the file that the stereo calibration of"
            " Bouguet's toolbox saves"
        )
    size = (int(found["nx"].item()), int(found["ny"].item()))

    cameras = {}
    for side in SIDES:
        fc, cc, kc = (np.ravel(found[f"{key}_{side}"]).tolist() for key in ("fc", "cc", "kc"))
        skew = float(np.ravel(found.get(f"alpha_c_{side}", 0.0))[0])
        K = np.array([[fc[0], fc[0] * skew, cc[0]], [0.0, fc[1], cc[1]], [0.0, 0.0, 1.0]])
        cameras[side] = _camera(K, kc, size, path)
    motion = Motion.from_vectors(found["om"], found["T"])
    return Part(left=cameras["left"], right=cameras["right"], right_from_left=motion)


def write_bouguet(part: Part, path: Path) -> None:
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
    with path.open("wb") as file:
        savemat(file, values)


def read_ros(left: Path, right: Path | None = None) -> Part:
    """camera_info of the left and, if given, the right camera; no motion. Raises ConfigError."""
    return Part(left=_ros_camera(left), right=_ros_camera(right) if right else None)


def write_ros(part: Part, path: Path, camera: str) -> None:
    """The camera_info of one camera, unrectified. Raises ConfigError if it isn't there."""
    lens = {
        "left": part.left,
        "right": part.right,
        "thermal": part.thermal.lens if part.thermal else None,
    }.get(camera)
    if lens is None:
        raise ConfigError.plain(
            f"the calibration has no lens of the {camera} camera: name another with --camera"
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
    path.write_text(yaml.safe_dump(read, sort_keys=False), encoding="utf-8", newline="\n")


def _ros_camera(path: Path) -> Camera:
    try:
        read = yaml.safe_load(path.read_text(encoding="utf-8"))
        size = (int(read["image_width"]), int(read["image_height"]))
        K = np.array(read["camera_matrix"]["data"], dtype=np.float64).reshape(3, 3)
        kc = np.array(read["distortion_coefficients"]["data"], dtype=np.float64)
        model = read.get("distortion_model", PLUMB_BOB)
    except OSError as error:
        raise ConfigError.plain(f"{path}: can't be read: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise ConfigError.plain(
            f"{path}: is no camera_info: {type(error).__name__} {error}"
        ) from error
    if model != PLUMB_BOB:
        raise ConfigError.plain(
            f"{path}: the distortion model is {model!r}; only {PLUMB_BOB} (k1 k2 p1 p2 k3) can be"
            " taken over"
        )
    return _camera(K, kc, size, path)


def _camera(K: Any, kc: Any, size: tuple[int, int], path: Path) -> Camera:
    matrix, values = np.asarray(K, dtype=np.float64), np.ravel(np.asarray(kc, dtype=np.float64))
    if matrix.shape != (3, 3) or not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ConfigError.plain(
            f"{path}: a camera matrix must be 3 x 3 with focal lengths above zero, is"
            f" {matrix.tolist()}"
        )
    if len(values) not in (4, 5) and np.any(values[5:]):
        raise ConfigError.plain(
            f"{path}: {len(values)} distortion coefficients; only k1 k2 p1 p2 k3 can be taken over"
        )
    k1, k2, p1, p2, k3 = (float(v) for v in np.append(values[:5], np.zeros(5))[:5])
    (fx, skew, u), (_, fy, v) = (row.tolist() for row in matrix[:2])
    return Camera(size, (fx, fy), (u, v), skew / fx, (k1, k2, p1, p2, k3))


def _pair(part: Part) -> tuple[Camera, Camera, Motion | None]:
    if part.left is None or part.right is None:
        raise ConfigError.plain(
            "the file holds no stereo pair ([cameras.left] and [cameras.right])"
        )
    return part.left, part.right, part.right_from_left
