"""Visible light positioning: codes, the receiver of a rolling-shutter camera, and where the camera was."""
