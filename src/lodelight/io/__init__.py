"""Recordings, rigs and trajectories in and out: one file per format."""

from lodelight.io.sources import open_source

__all__ = ["open_source"]
