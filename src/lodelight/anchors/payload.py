"""The text by which a QR code says itself how large it is and where it hangs.

`LODE1;id=A17;size=0.20[;xyz=1.2,0,1.5;quat=0.5,0.5,-0.5,-0.5]`. Anybody can print a QR code: what is read here comes
from strangers, and nothing of it is believed before it is checked.
"""

from __future__ import annotations

import math
import re

import numpy as np

from lodelight.anchors import Tag
from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3

HEAD = "LODE1"
MAX_CHARS = 400  # what is longer says more than a tag has to say
ID = re.compile(r"[^\x00-\x20\x7f;=]{1,64}")
NUMBER = re.compile(r"[+-]?([0-9]{1,9}(\.[0-9]{0,12})?|\.[0-9]{1,12})([eE][+-]?[0-9]{1,2})?")
MAX_SIZE_M, MAX_XYZ_M = 10.0, 1e5
QUAT_SLACK = 0.01  # in length; four decimals leave 1e-4


def tag_payload(tag: Tag) -> str:
    """What a QR code carries so that it needs no survey file. Raises SourceError on an id it cannot carry."""
    if not ID.fullmatch(tag.id):
        raise SourceError(f"tag {shown(tag.id)}: an id in a QR code must be 1 to 64 characters without blanks, ; and =")
    size = f"{tag.size_m:.4f}".rstrip("0")
    text = f"{HEAD};id={tag.id};size={size}{'0' * (2 - len(size.partition('.')[2]))}"
    if tag.T_world_tag is None:
        return text
    xyz = ",".join(f"{v:.3f}".rstrip("0").rstrip(".") for v in tag.T_world_tag.t + 0.0)
    quat = ",".join(f"{v:.4f}".rstrip("0").rstrip(".") for v in tag.T_world_tag.quat_xyzw + 0.0)
    return f"{text};xyz={xyz};quat={quat}"


def tag_from_payload(payload: str) -> Tag | None:
    """The tag a payload describes, or None where it is no payload of ours (any other QR code in the building).

    Raises SourceError, in one short line, where it begins like one of ours and is broken or makes no sense.
    """
    head, *fields = payload.strip().split(";")
    if head != HEAD:
        return None
    where = f"QR payload {shown(payload)}"
    if len(payload) > MAX_CHARS:
        raise SourceError(f"{where} is {len(payload)} characters long; {MAX_CHARS} are allowed")
    values: dict[str, str] = {}
    for text in fields:
        key, _, value = text.partition("=")
        if key in values:
            raise SourceError(f"{where}: {key} stands twice")
        if key in ("id", "size", "xyz", "quat"):  # a later version may say more
            values[key] = value
    for key in ("id", "size"):
        if key not in values:
            raise SourceError(f"{where} has no {key}")
    if not ID.fullmatch(values["id"]):
        raise SourceError(f"{where}: the id must be 1 to 64 characters without blanks")
    (size_m,) = _numbers(values["size"], 1, "size", where)
    if not 0.0 < size_m <= MAX_SIZE_M:
        raise SourceError(f"{where}: size must lie above 0 and up to {MAX_SIZE_M:g} m, got {size_m:g}")
    return Tag("qr", values["id"], size_m, _pose(values, where))


def shown(payload: str, most: int = 60) -> str:
    """A payload as one may print it: quoted, nothing that moves a cursor, cut where it is long."""
    return repr(payload if len(payload) <= most else payload[: most - 3] + "...")


def _pose(values: dict[str, str], where: str) -> SE3 | None:
    if ("xyz" in values) != ("quat" in values):
        raise SourceError(f"{where}: xyz and quat must come together, or both be left out")
    if "xyz" not in values:
        return None
    xyz = np.array(_numbers(values["xyz"], 3, "xyz", where))
    quat = np.array(_numbers(values["quat"], 4, "quat", where))
    if np.abs(xyz).max() > MAX_XYZ_M:
        raise SourceError(f"{where}: xyz is farther than {MAX_XYZ_M:g} m")
    length = math.sqrt(float(quat @ quat))
    if abs(length - 1.0) > QUAT_SLACK:
        raise SourceError(f"{where}: quat has length {length:.3g}; a rotation's is 1")
    return SE3.from_quat_xyzw(xyz, quat / length)


def _numbers(text: str, count: int, key: str, where: str) -> list[float]:
    parts = text.split(",")
    if len(parts) != count or not all(NUMBER.fullmatch(part) for part in parts):
        raise SourceError(f"{where}: {key} must be {count} plain number{'s' * (count > 1)}")
    return [float(part) for part in parts]
