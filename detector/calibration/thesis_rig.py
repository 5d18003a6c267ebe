"""The thesis's published figures of its rig. Its printed world matrix isn't rigid (singular values
1.000, 0.990, 0.920); how the shipped calibrations follow is in tests/detector/thesis_fits.py.
"""

from __future__ import annotations

from detector.calibration.values import ThermalCamera
from detector.geometry import Camera

IMAGE_SIZE = (1360, 1024)  # section 3.1.1
# table 3.1
LEFT = Camera(IMAGE_SIZE, (1291.0, 1295.2), (727.4, 528.1), 0.0, (-0.186, 0.230, 0.0, 0.0, 0.0))
# table 3.2
RIGHT = Camera(IMAGE_SIZE, (1288.3, 1290.6), (701.4, 558.7), 0.0, (-0.212, 0.301, -0.003, 0.0, 0.0))
# section 3.2.1.2
STEREO_OM_RAD, STEREO_T_MM = (-0.0011, -0.0008, 0.0085), (-100.317, 0.242, -0.401)
# section 3.2.2
HOMOGRAPHY_LEFT = ((0.615, 0.007, 672.822), (-0.004, 0.616, 363.601), (0.0, 0.0, 1.0))
HOMOGRAPHY_RIGHT = ((0.618, 0.002, 536.133), (-0.002, 0.619, 401.948), (0.0, 0.0, 1.0))
WORLD_MATRIX = ((0.99, 0.0, 0.02), (-0.02, -0.01, 0.92), (0.0, -1.0, -0.01))  # section 3.3.2
WORLD_T_MM = (-161.80, -760.40, 64.52)
# table 5.2
TEAT_ENDS_MM = (
    (-109.8, 285.7, 135.5),
    (-161.3, 191.7, 137.8),
    (-224.2, 197.4, 137.4),
    (-260.5, 269.9, 137.4),
)
THERMAL_IMAGE_SIZE, THERMAL_SENSOR_SIZE = (640, 480), (160, 120)  # sections 3.1.1, 4.1.1
THERMAL = ThermalCamera(THERMAL_IMAGE_SIZE, THERMAL_SENSOR_SIZE, True, "hot_is_black", None)
