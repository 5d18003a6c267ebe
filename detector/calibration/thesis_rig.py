"""The thesis's published figures of its rig. How the shipped calibrations follow, and its printed
world matrix, which isn't rigid (singular values 1.000, 0.990, 0.920), are in
tests/detector/thesis_fits.py.
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
THERMAL_IMAGE_SIZE, THERMAL_SENSOR_SIZE = (640, 480), (160, 120)  # sections 3.1.1, 4.1.1
THERMAL = ThermalCamera(THERMAL_IMAGE_SIZE, THERMAL_SENSOR_SIZE, True, "hot_is_black", None)
