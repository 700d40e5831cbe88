"""What QR codes say of themselves: ours round-trip, strangers' are none of ours, broken ones are named."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodelight.anchors import Tag
from lodelight.anchors.payload import MAX_CHARS, tag_from_payload, tag_payload
from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3


def test_what_a_tag_says_is_what_is_read():
    T = SE3.exp(np.array([0.4, -1.0, 2.0, 1.234, -20.5, 0.0]))
    for tag in (Tag("qr", "A17", 0.2), Tag("qr", "dock/3", 0.125, T), Tag("qr", "B", 0.165)):
        back = tag_from_payload(tag_payload(tag))
        assert (back.id, back.size_m) == (tag.id, tag.size_m)
        if tag.T_world_tag is not None:
            assert np.abs((back.T_world_tag.inverse() @ T).log()).max() < 1e-3  # a millimetre, four decimals
    assert tag_payload(Tag("qr", "A17", 0.2)) == "LODE1;id=A17;size=0.20"


@pytest.mark.parametrize("text", ["", "https://example.org", "LODE2;id=A;size=1", "lode1;id=A;size=1", "LODE10;x"])
def test_other_codes_are_none_of_ours(text):
    assert tag_from_payload(text) is None


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("LODE1", "no id"),
        ("LODE1;id=A", "no size"),
        ("LODE1;id=;size=0.2", "1 to 64 characters"),
        ("LODE1;id=A\nB;size=0.2", "1 to 64 characters"),
        ("LODE1;id=A;size=0", "above 0"),
        ("LODE1;id=A;size=-0.2", "above 0"),
        ("LODE1;id=A;size=1e9", "above 0"),
        ("LODE1;id=A;size=nan", "plain number"),
        ("LODE1;id=A;size=1_0", "plain number"),
        ("LODE1;id=A;size=0.2;size=0.3", "stands twice"),
        ("LODE1;id=A;size=0.2;xyz=1,2,3", "come together"),
        ("LODE1;id=A;size=0.2;xyz=1,2;quat=0,0,0,1", "3 plain numbers"),
        ("LODE1;id=A;size=0.2;xyz=1,2,inf;quat=0,0,0,1", "3 plain numbers"),
        ("LODE1;id=A;size=0.2;xyz=1,2,9e9;quat=0,0,0,1", "farther"),
        ("LODE1;id=A;size=0.2;xyz=1,2,3;quat=0,0,0,0", "length 0"),
        ("LODE1;id=A;size=0.2;xyz=1,2,3;quat=0,0,0,1.1", "length 1.1"),
        ("LODE1;id=A;size=0.2;xyz=1,2,3;quat=0,0,0,1e99", "length 1e"),
        ("LODE1;id=A;size=0.2;x=" + "9" * 5000, f"{MAX_CHARS} are allowed"),
    ],
)
def test_broken_payloads_are_named_in_one_short_line(text, why):
    with pytest.raises(SourceError, match=why) as caught:
        tag_from_payload(text)
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


@given(st.text(max_size=200))
def test_no_text_does_harm(text):
    for payload in (text, f"LODE1;{text}", f"LODE1;id={text};size=0.2", f"LODE1;id=A;size=0.2;xyz={text};quat=0,0,0,1"):
        try:
            tag = tag_from_payload(payload)
        except SourceError:
            continue
        if tag is not None:
            assert 0.0 < tag.size_m <= 10.0
            assert tag.T_world_tag is None or np.isfinite(tag.T_world_tag.matrix).all()
