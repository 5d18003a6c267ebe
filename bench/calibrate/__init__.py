"""Guided procedures that each write a dated file: cameras, thermal camera, world, stage, arm."""
