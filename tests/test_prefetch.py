"""Decoding ahead keeps the order, passes errors on, and leaves no thread behind."""

import threading
import time

import pytest

from lodelight.io import open_source
from lodelight.io.prefetch import prefetch
from recordings import write_tum


def prefetch_threads():
    return [t for t in threading.enumerate() if t.name.startswith("prefetch")]


def test_results_come_in_order_whatever_each_takes():
    def work(i):
        time.sleep(0.002 * ((7 * i) % 3))
        return i * i

    assert list(prefetch(range(20), work)) == [i * i for i in range(20)]
    assert prefetch_threads() == []


def test_no_more_is_done_than_what_was_asked_for_and_a_few_ahead():
    done = []
    stream = prefetch(range(100), lambda i: done.append(i) or i, ahead=3)
    for expected in range(5):
        assert next(stream) == expected
    stream.close()
    assert len(done) <= 5 + 3


def test_an_error_comes_out_where_its_result_would():
    def work(i):
        if i == 3:
            raise RuntimeError("third")
        return i

    stream = prefetch(range(10), work)
    assert [next(stream) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(RuntimeError, match="third"):
        next(stream)
    assert prefetch_threads() == []


@pytest.mark.parametrize("sensors", ["rgbd", "mono"])
def test_closing_a_stream_of_messages_early_ends_its_thread(tmp_path, sensors):
    stream = open_source(write_tum(tmp_path)).messages(sensors)
    next(stream)
    assert len(prefetch_threads()) == 1
    stream.close()
    assert prefetch_threads() == []


def test_leaving_a_loop_over_messages_ends_its_thread(tmp_path):
    for _ in open_source(write_tum(tmp_path)).messages("rgbd"):
        break
    assert prefetch_threads() == []
