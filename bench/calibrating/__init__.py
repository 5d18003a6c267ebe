"""Calibration as a lab does it: boards, pictures, steps that each write a file, and one calibration made of them."""
