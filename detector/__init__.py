"""Pixels to millimetres: calibration, geometry, teat detectors. numpy, OpenCV, scipy and
numba only.
"""
