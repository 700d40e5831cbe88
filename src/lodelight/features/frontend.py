"""A frame's images to features with depth, whatever sensors there are."""

from __future__ import annotations

import cv2
import numpy as np

from lodelight.errors import CalibrationError, SourceError
from lodelight.features.depth import depth_at
from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig, OrbExtractor
from lodelight.features.stereo import StereoConfig, StereoMatcher
from lodelight.messages import Frame
from lodelight.rig import Rig
from lodelight.types import Bytes


class FrontEnd:
    """sensors : "mono", "stereo" or "rgbd"

    factor : images are resized by it before anything is looked for in them
    rig : of the resized images, in whose pixels the features are
    """

    def __init__(self, rig: Rig, sensors: str, orb: OrbConfig, factor: float = 1.0) -> None:
        self.rig = rig.resized(factor) if factor != 1.0 else rig
        self._given = rig.cameras[0]
        self._factor = factor
        self._extractor = OrbExtractor(self.rig.cameras[0].camera, orb)
        self._depth = rig.depth if sensors == "rgbd" else None
        if sensors == "rgbd" and rig.depth is None:
            raise CalibrationError("rgbd was asked for, but the rig has no depth sensor; give it a [depth] table")
        if sensors == "stereo" and len(rig.cameras) < 2:
            raise CalibrationError("stereo was asked for, but the rig has one camera; give it a second one")
        self._stereo: StereoMatcher | None = None
        if sensors == "stereo":
            noise = StereoConfig(sigma_px=StereoConfig.sigma_px * factor)  # of the images as they were taken
            self._stereo = StereoMatcher(self.rig.cameras[0], self.rig.cameras[1], orb, noise)

    def process(self, frame: Frame) -> Features:
        """Raises SourceError where an image is not of the rig's size."""
        image, camera = frame.images[0], self._given.camera
        if image.shape != (camera.height, camera.width):
            raise SourceError(
                f"image is {image.shape[1]}x{image.shape[0]}, but the rig's {self._given.name} is "
                f"{camera.width}x{camera.height}; correct the rig or the recording"
            )
        pyramid = self._extractor.pyramid(self._resized(0, image))
        seen = self._extractor.extract(pyramid)
        if self._stereo is not None:
            return self._stereo.measure(seen, pyramid, self._resized(1, frame.images[1]))
        if self._depth is not None and frame.depth is not None:
            given_px = (seen.px + 0.5) / np.float32(self._factor) - 0.5
            return seen.with_depth(*depth_at(given_px.astype(np.float32), frame.depth, self._depth))
        return seen

    def _resized(self, number: int, image: Bytes) -> Bytes:
        if self._factor == 1.0:
            return image
        camera = self.rig.cameras[number].camera
        return np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR), np.uint8)
