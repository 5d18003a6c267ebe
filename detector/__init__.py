"""Pixels to millimetres: calibration, geometry and the teat detectors. numpy, OpenCV and scipy
only.
"""
