"""The scenes that the fused detector is tried on, drawn with OpenCV alone."""

from tests.detector.fused.conftest import draw_scene, udder

__all__ = ["draw_scene", "udder"]
