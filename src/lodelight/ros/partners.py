"""Images that came one by one, put together into frames."""

from __future__ import annotations

from collections import OrderedDict

from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Frame
from lodelight.types import AnyArray, ArrayF32

STEREO_S, DEPTH_S = 0.005, 0.020  # within which images of one frame are stamped
WAITING = 30  # images of one kind that wait for partners


class Partners:
    """cameras : images a frame has; depth : and a depth image. The stamp is that of camera 0."""

    def __init__(self, cameras: int, depth: bool) -> None:
        names = [*(f"cam{i}" for i in range(cameras)), *(["depth"] if depth else [])]
        self._waiting: dict[str, OrderedDict[int, AnyArray]] = {name: OrderedDict() for name in names}
        self.unmatched = 0

    def add(self, name: str, t_ns: int, image: AnyArray) -> Frame | None:
        """An image of "cam0", "cam1" or "depth"; the frame that it completes."""
        queue = self._waiting[name]
        queue[t_ns] = image
        while len(queue) > WAITING:
            queue.popitem(last=False)
            self.unmatched += name == "cam0"
        for t0_ns in list(self._waiting["cam0"]):
            found = {other: self._nearest(other, t0_ns) for other in self._waiting if other != "cam0"}
            if all(t is not None for t in found.values()):
                return self._frame(t0_ns, found)
        return None

    def _nearest(self, name: str, t_ns: int) -> int | None:
        within_ns = (DEPTH_S if name == "depth" else STEREO_S) * NS_PER_S
        near = min(self._waiting[name], key=lambda t: abs(t - t_ns), default=None)
        return near if near is not None and abs(near - t_ns) <= within_ns else None

    def _frame(self, t_ns: int, partners: dict[str, int | None]) -> Frame:
        images, depth = [self._waiting["cam0"][t_ns]], None
        for name, t in partners.items():
            assert t is not None
            image = self._waiting[name][t]
            if name == "depth":
                depth = image
            else:
                images.append(image)
        for name, t in {"cam0": t_ns, **partners}.items():
            queue = self._waiting[name]
            while queue and t is not None and next(iter(queue)) <= t:
                gone, _ = queue.popitem(last=False)
                self.unmatched += name == "cam0" and gone != t_ns
        kept: ArrayF32 | None = depth
        return Frame(t_ns, tuple(images), kept)
