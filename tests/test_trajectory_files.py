"""Trajectories survive their files, and the files are what other tools read."""

from contextlib import suppress

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from conftest import shared_data
from lodelight.errors import SourceError
from lodelight.io.trajectories import read_trajectory, write_euroc, write_kitti, write_trajectory, write_tum
from lodelight.trajectory import Trajectory

START_NS = 1_403_636_579_763_555_584
DECIMALS = 1e-9  # as many as the files have


def random_trajectory(n=40, seed=0):
    rng = np.random.default_rng(seed)
    t_ns = START_NS + np.cumsum(rng.integers(1, 10**8, n))
    return Trajectory(t_ns, rng.normal(size=(n, 3)) * 10, Rotation.random(n, random_state=seed).as_quat())


def assert_same(a, b):
    assert a.t_ns.tolist() == b.t_ns.tolist()
    assert np.allclose(a.xyz, b.xyz, atol=DECIMALS, rtol=1e-8)
    turn = Rotation.from_quat(a.quat_xyzw) * Rotation.from_quat(b.quat_xyzw).inv()
    assert turn.magnitude().max() < 5e-9


@pytest.mark.parametrize("suffix", ["tum", "txt", "csv", "kitti"])
def test_a_trajectory_survives_its_file_with_every_nanosecond(tmp_path, suffix):
    trajectory = random_trajectory()
    write_trajectory(tmp_path / f"path.{suffix}", trajectory)
    assert_same(read_trajectory(tmp_path / f"path.{suffix}"), trajectory)


def test_evo_reads_what_we_write(tmp_path):
    trajectory = random_trajectory()
    write_tum(tmp_path / "a.tum", trajectory)
    write_euroc(tmp_path / "a.csv", trajectory)
    write_kitti(tmp_path / "a.kitti", trajectory)
    for theirs in (
        file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum")),
        file_interface.read_euroc_csv_trajectory(str(tmp_path / "a.csv")),
    ):
        assert np.allclose(theirs.positions_xyz, trajectory.xyz, atol=DECIMALS)
        quat = np.roll(theirs.orientations_quat_wxyz, -1, axis=1)
        assert np.abs(np.abs((quat * trajectory.quat_xyzw).sum(axis=1)) - 1).max() < DECIMALS
        assert np.abs(theirs.timestamps - trajectory.t_ns / 1e9).max() < 1e-6  # theirs are floats
    theirs = file_interface.read_kitti_poses_file(str(tmp_path / "a.kitti"))
    assert np.allclose(theirs.positions_xyz, trajectory.xyz, rtol=1e-8)


@pytest.mark.parametrize(
    ("recording", "file", "rows", "first"),
    [
        ("tum_fr1_rpy", "groundtruth.txt", 1368, 1305031225933400000),
        ("euroc_v1_01", "groundtruth/V1_01_easy.csv", 2895, 1403715273262142976),
        ("euroc_mh05", "mav0/state_groundtruth_estimate0/data.csv", 6608, 1403638519492829440),
    ],
)
def test_ground_truth_of_real_recordings_is_read_as_evo_reads_it(recording, file, rows, first):
    path = shared_data(recording) / file
    ours = read_trajectory(path)
    read = file_interface.read_euroc_csv_trajectory if file.endswith("csv") else file_interface.read_tum_trajectory_file
    theirs = read(str(path))
    assert (len(ours), ours.t_ns[0]) == (rows, first)
    assert np.allclose(ours.xyz, theirs.positions_xyz, atol=0)
    quat = np.roll(theirs.orientations_quat_wxyz, -1, axis=1)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)  # the files' few decimals leave them a little off unit length
    assert np.allclose(ours.quat_xyzw, quat, atol=1e-12)


def test_rows_are_sorted_and_of_one_stamp_the_first_counts(tmp_path):
    (tmp_path / "a.tum").write_text("2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 9 0 0 0 0 0 1\n")
    assert read_trajectory(tmp_path / "a.tum").xyz[:, 0].tolist() == [1.0, 2.0]


def test_nine_columns_after_a_stamp_are_euroc_whatever_the_line_ends(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbf#timestamp [ns], x\r\n1000, 1, 2, 3, 1, 0, 0, 0\r\n\r\n")
    trajectory = read_trajectory(tmp_path / "a.csv")
    assert trajectory.t_ns.tolist() == [1000]
    assert trajectory.quat_xyzw.tolist() == [[0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("# only a comment\n", "is empty"),
        ("1 2 3\n", "3 columns are no pose"),
        ("1 0 0 0 0 0 0 1\n2 0 0 nan 0 0 0 1\n", "line 2 is no pose"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0\n", "line 2 is no pose"),
        ("1 0 0 0 0 0 0 0\n", "length 0"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "times.txt"),
        ("x 0 0 0 0 0 0 1\n", "line 1 is no pose"),
    ],
)
def test_what_is_no_trajectory_is_told_with_file_and_line(tmp_path, text, says):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(SourceError, match=rf"a\.txt.*{says}"):
        read_trajectory(tmp_path / "a.txt")


def test_a_missing_or_binary_file_is_told(tmp_path):
    with pytest.raises(SourceError, match="does not exist"):
        read_trajectory(tmp_path / "none.tum")
    (tmp_path / "b.tum").write_bytes(b"\x00\xff\xfe\x81")
    with pytest.raises(SourceError, match="not a text file"):
        read_trajectory(tmp_path / "b.tum")
    with pytest.raises(SourceError, match="cannot read"):
        read_trajectory(tmp_path)


def test_kitti_poses_and_times_must_pair_up(tmp_path):
    write_kitti(tmp_path / "a.kitti", random_trajectory(5))
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(SourceError, match=r"5 poses .* 2 stamps"):
        read_trajectory(tmp_path / "a.kitti")


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    write_tum(tmp_path / "a.tum", random_trajectory(3))
    before = (tmp_path / "a.tum").read_text()

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lodelight.io.text.os.fsync", full_disk)
    with pytest.raises(SourceError, match="No space left"):
        write_tum(tmp_path / "a.tum", random_trajectory(30))
    assert (tmp_path / "a.tum").read_text() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.tum"]


def test_an_unknown_ending_is_refused(tmp_path):
    with pytest.raises(SourceError, match="end the name in one of"):
        write_trajectory(tmp_path / "a.bag", random_trajectory(2))


@given(st.binary(max_size=200))
def test_any_bytes_at_all_are_a_trajectory_or_one_clear_error(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("any") / "a.txt"
    path.write_bytes(data)
    with suppress(SourceError):
        read_trajectory(path)
