"""The plots of a report: arrays in, SVG text out, the same bytes for the same arrays.

Without data a figure says "not measured"; numbers that are not finite are refused. Its modules load
matplotlib (some tenths of a second), so importers do it late.
"""
