"""Indoor visual SLAM and localization, anchored by the building itself."""

__version__ = "0.1.0"
