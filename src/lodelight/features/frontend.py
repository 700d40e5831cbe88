"""A frame's images to features with depth, whatever sensors there are."""

from __future__ import annotations

from lodelight.errors import CalibrationError, SourceError
from lodelight.features.depth import depth_of_features
from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig, OrbExtractor
from lodelight.features.stereo import StereoMatcher
from lodelight.messages import Frame
from lodelight.rig import Rig


class FrontEnd:
    """sensors : "mono", "stereo" or "rgbd"."""

    def __init__(self, rig: Rig, sensors: str, orb: OrbConfig) -> None:
        self._spec = rig.cameras[0]
        self._extractor = OrbExtractor(self._spec.camera, orb)
        self._depth = rig.depth if sensors == "rgbd" else None
        if sensors == "rgbd" and rig.depth is None:
            raise CalibrationError("rgbd was asked for, but the rig has no depth sensor; give it a [depth] table")
        if sensors == "stereo" and len(rig.cameras) < 2:
            raise CalibrationError("stereo was asked for, but the rig has one camera; give it a second one")
        self._stereo = StereoMatcher(rig.cameras[0], rig.cameras[1], orb) if sensors == "stereo" else None

    def process(self, frame: Frame) -> Features:
        """Raises SourceError where an image is not of the rig's size."""
        image, camera = frame.images[0], self._spec.camera
        if image.shape != (camera.height, camera.width):
            raise SourceError(
                f"image is {image.shape[1]}x{image.shape[0]}, but the rig's {self._spec.name} is "
                f"{camera.width}x{camera.height}; correct the rig or the recording"
            )
        pyramid = self._extractor.pyramid(image)
        seen = self._extractor.extract(pyramid)
        if self._stereo is not None:
            return self._stereo.measure(seen, pyramid, frame.images[1])
        if self._depth is not None and frame.depth is not None:
            return depth_of_features(seen, frame.depth, self._depth)
        return seen
