"""Time stamps lose no digit, disorder costs the fewest frames, partners are the nearest in time."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodelight.io.stamps import associate, increasing, ns_from_seconds, ns_from_text, seconds_text

small = st.lists(st.integers(0, 12), max_size=9).map(lambda v: np.array(v, dtype=np.int64))


@given(st.integers(-(10**18), 2 * 10**18))
def test_seconds_text_is_exact_both_ways(t_ns):
    assert ns_from_seconds(seconds_text(t_ns)) == t_ns


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1305031229.528748", 1_305_031_229_528_748_000),
        ("1403636579.763555584", 1_403_636_579_763_555_584),
        ("0", 0),
        ("12", 12_000_000_000),
        (".5", 500_000_000),
        ("1.036224e-01", 103_622_400),
        ("-0.000000001", -1),
        ("1.00000000051", 1_000_000_001),
    ],
)
def test_seconds_are_read_to_the_nanosecond(text, t_ns):
    assert ns_from_seconds(text) == t_ns


def test_nanoseconds_may_be_written_as_a_float():
    assert ns_from_text("1.403636579763555584e18") == 1_403_636_579_763_555_584


@pytest.mark.parametrize("text", ["", "x", "nan", "inf", "1,5", "frame.png", "1e99", "1e999999999", "99999999999.5"])
def test_what_is_no_stamp_is_refused(text):
    with pytest.raises(ValueError, match="no time stamp"):
        ns_from_seconds(text)


@given(small)
def test_the_fewest_stamps_are_given_up_for_order(t_ns):
    keep = increasing(t_ns)
    assert np.all(np.diff(t_ns[keep]) > 0)
    n = int(keep.sum())
    assert not any(np.all(np.diff(t_ns[list(c)]) > 0) for c in combinations(range(len(t_ns)), n + 1))
    # of all choices as long, the one that takes the earliest frames
    best = next((c for c in combinations(range(len(t_ns)), n) if np.all(np.diff(t_ns[list(c)]) > 0)), ())
    assert np.flatnonzero(keep).tolist() == list(best)


@given(small, small, st.integers(0, 5))
def test_partners_are_within_tolerance_used_once_and_none_nearer_is_free(a, b, tolerance):
    partner = associate(a, b, tolerance)
    used = partner[partner >= 0]
    assert len(set(used.tolist())) == len(used)
    for i, j in enumerate(partner):
        if j >= 0:
            assert abs(a[i] - b[j]) <= tolerance
        limit = abs(a[i] - b[j]) if j >= 0 else tolerance + 1
        free = [k for k in range(len(b)) if abs(a[i] - b[k]) < limit and k not in used]
        assert free == []  # a nearer one, if any, is taken by a stamp nearer still
