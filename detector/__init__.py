"""Pixels to millimetres: calibration, geometry, teat detectors. numpy, OpenCV and scipy only."""
