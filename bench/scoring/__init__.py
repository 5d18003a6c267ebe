"""Scores as pure functions: arrays in, values out. Every formula with its source:
docs/scoring.md.
"""
