"""What is wrong with a recording is skipped, counted and told, or is one clear error: no traceback, no silence."""

import numpy as np
import pytest

from lodelight.errors import CalibrationError, SourceError
from lodelight.io import open_source
from lodelight.io.recording import summarize
from lodelight.messages import Frame, Imu
from recordings import (
    PERIOD_NS,
    START_NS,
    number,
    picture,
    seconds,
    tiny_depth_rig,
    tiny_rig,
    write,
    write_euroc,
    write_kitti,
    write_sevenscenes,
    write_tum,
)


def numbers(recording, sensors="mono"):
    return [number(m) for m in recording.messages(sensors) if isinstance(m, Frame)]


def image_folder(path, suffix="png", n=6):
    for i in range(n):
        write(path / f"{i:03d}.{suffix}", picture(i))
    return path


def cut(path, keep):
    path.write_bytes(path.read_bytes()[: int(len(path.read_bytes()) * keep)])


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("keep", [0.0, 0.3, 0.6, 0.98])
def test_a_truncated_image_is_skipped_and_told(tmp_path, suffix, keep):
    image_folder(tmp_path, suffix)
    rng = np.random.default_rng(0)  # noise, so that a cut in the middle cuts pixels
    write(tmp_path / f"002.{suffix}", rng.integers(0, 255, (48, 64)).astype(np.uint8))
    cut(tmp_path / f"002.{suffix}", keep)
    recording = open_source(tmp_path, tiny_rig())
    assert numbers(recording) == [0, 1, 3, 4, 5]
    (skip,) = recording.skipped
    assert skip.t_ns == 100_000_000
    assert skip.where.endswith(f"002.{suffix}")
    assert skip.reason == ("image file is truncated" if keep else "image file is empty")
    assert "1 skipped" in summarize(recording.skipped)


def test_a_file_that_is_no_image_is_skipped_and_told(tmp_path):
    image_folder(tmp_path)
    (tmp_path / "004.png").write_text("not an image")
    recording = open_source(tmp_path, tiny_rig())
    assert numbers(recording) == [0, 1, 2, 3, 5]
    assert recording.skipped[0].reason == "file is no readable image"


def test_a_flipped_byte_in_a_png_is_not_passed_on(tmp_path):
    image_folder(tmp_path)
    data = bytearray((tmp_path / "001.png").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "001.png").write_bytes(bytes(data))
    assert 1 not in numbers(open_source(tmp_path, tiny_rig()))


def test_a_missing_image_is_skipped_and_told(tmp_path):
    write_kitti(tmp_path)
    (tmp_path / "sequences/07/image_1/000003.png").unlink()
    recording = open_source(tmp_path / "sequences/07")
    assert numbers(recording, "stereo") == [0, 1, 2, 4, 5]
    assert [skip.reason for skip in recording.skipped] == ["image file is missing"]
    assert numbers(recording, "mono") == [0, 1, 2, 3, 4, 5]
    assert recording.skipped == []  # of the last reading only


def test_an_image_of_another_size_is_skipped_and_both_sizes_told(tmp_path):
    image_folder(tmp_path)
    write(tmp_path / "002.png", np.zeros((24, 32), np.uint8))
    recording = open_source(tmp_path, tiny_rig())
    assert numbers(recording) == [0, 1, 3, 4, 5]
    assert recording.skipped[0].reason == "image is 32x24, the rig says 64x48"


def test_a_rig_of_another_size_is_one_error_that_says_both(tmp_path):
    with pytest.raises(SourceError, match="6x image is 640x480, the rig says 64x48"):
        numbers(open_source(write_sevenscenes(tmp_path), tiny_rig()))


@pytest.mark.parametrize("name", ["9" * 30, "99999999999.5"])
def test_a_number_no_clock_shows_in_an_image_name_is_told(tmp_path, name):
    write(tmp_path / f"{name}.png", picture(0))
    with pytest.raises(SourceError, match="no time stamp"):
        open_source(tmp_path, tiny_rig())


def test_an_empty_recording_is_an_error(tmp_path):
    write_tum(tmp_path / "freiburg1")
    (tmp_path / "freiburg1/rgb.txt").write_text("# color images\n")
    write_euroc(tmp_path / "flight", imu=False)
    (tmp_path / "flight/mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n")
    for name in ("freiburg1", "flight"):
        with pytest.raises(SourceError, match="empty recording"):
            open_source(tmp_path / name)


def test_a_recording_whose_images_are_all_gone_is_an_error_that_counts_them(tmp_path):
    write_euroc(tmp_path)
    for file in tmp_path.glob("mav0/cam0/data/*.png"):
        file.unlink()
    with pytest.raises(SourceError, match="no frame can be used; 6 skipped: 6x image file is missing"):
        numbers(open_source(tmp_path), "stereo-inertial")


@pytest.mark.parametrize(
    ("swap", "kept"),
    [
        ({2: START_NS + PERIOD_NS}, [0, 1, 3, 4, 5]),  # a duplicate
        ({3: START_NS + PERIOD_NS + 1}, [0, 1, 2, 4, 5]),  # steps back
        ({1: START_NS + 10**12}, [0, 2, 3, 4, 5]),  # jumps ahead: the others are not its fault
        ({0: START_NS + 10**12}, [1, 2, 3, 4, 5]),
        ({5: 0}, [0, 1, 2, 3, 4]),
    ],
    ids=["duplicate", "back", "ahead", "first", "zero"],
)
def test_a_stamp_out_of_order_costs_its_own_frame_alone(tmp_path, swap, kept):
    write_euroc(tmp_path, cameras=1)
    stamps = [swap.get(i, START_NS + i * PERIOD_NS) for i in range(6)]
    rows = [f"{t},{START_NS + i * PERIOD_NS}.png" for i, t in enumerate(stamps)]
    (tmp_path / "mav0/cam0/data.csv").write_text("\n".join(rows))
    recording = open_source(tmp_path)
    assert numbers(recording) == kept
    assert [skip.reason for skip in recording.skipped] == ["stamp is a duplicate or out of order"]
    delivered = [m.t_ns for m in recording.messages("mono-inertial")]
    assert delivered == sorted(delivered)


def test_imu_samples_out_of_order_or_unreadable_are_skipped_and_told(tmp_path):
    write_euroc(tmp_path)
    file = tmp_path / "mav0/imu0/data.csv"
    rows = file.read_text().splitlines()
    rows[10], rows[20], rows[30] = rows[9], rows[20].replace("9.81", "nan"), rows[30][:25]
    file.write_text("\n".join(rows))
    recording = open_source(tmp_path)
    stamps = [m.t_ns for m in recording.messages("mono-inertial") if isinstance(m, Imu)]
    assert len(set(stamps)) == len(stamps) == 55 - 3
    reasons = sorted(skip.reason for skip in recording.skipped)
    assert reasons == ["IMU stamp is a duplicate or out of order", "row cannot be read", "row cannot be read"]
    assert any(skip.where.endswith("data.csv line 21") for skip in recording.skipped)


def test_a_list_cut_off_in_its_last_row_loses_that_row(tmp_path):
    write_euroc(tmp_path, cameras=1)
    file = tmp_path / "mav0/cam0/data.csv"
    file.write_text(file.read_text()[:-28])
    recording = open_source(tmp_path)
    assert numbers(recording) == [0, 1, 2, 3, 4]
    assert recording.skipped[0].where.endswith("data.csv line 7")


def test_a_missing_or_broken_depth_image_skips_its_frame(tmp_path):
    write_sevenscenes(tmp_path)
    (tmp_path / "frame-000001.depth.png").unlink()
    cut(tmp_path / "frame-000003.depth.png", 0.7)
    write(tmp_path / "frame-000004.depth.png", np.full((480, 640), 100, np.uint8))
    recording = open_source(tmp_path)
    assert numbers(recording, "rgbd") == [0, 2, 5]
    assert [skip.reason for skip in recording.skipped] == [
        "no depth image near enough in time",
        "image file is truncated",
        "depth image is not 16 bit with one channel",
    ]


def test_depth_that_is_zero_throughout_is_an_error_before_the_first_frame(tmp_path):
    with pytest.raises(SourceError, match="every depth image is zero"):
        next(iter(open_source(write_tum(tmp_path, depth_m=0.0)).messages("rgbd")))


def test_a_recording_that_begins_without_depth_readings_is_read(tmp_path):
    write_tum(tmp_path, n=12)
    for i in (0, 2, 5, 8, 11):  # all that are looked at first
        write(tmp_path / f"depth/{seconds(START_NS + i * PERIOD_NS + 3_000_000)}.png", np.zeros((480, 640), np.uint16))
    assert len(numbers(open_source(tmp_path), "rgbd")) == 12


def test_one_frame_without_depth_readings_is_passed_on_with_none(tmp_path):
    write_tum(tmp_path)
    for i in (0, 2):
        write(tmp_path / f"depth/{seconds(START_NS + i * PERIOD_NS + 3_000_000)}.png", np.zeros((480, 640), np.uint16))
    depth = [m.depth for m in open_source(tmp_path).messages("rgbd")]
    assert [bool(d.any()) for d in depth] == [False, True, False, True, True, True]


@pytest.mark.parametrize(("depth_m", "median"), [(0.002, "0.002 m"), (13.0, None)])
def test_depth_in_a_wrong_unit_is_told(tmp_path, depth_m, median):
    recording = open_source(write_tum(tmp_path, depth_m=depth_m))
    if median is None:  # as far as the unit holds, but beyond the sensor's range: frames without readings
        assert not any(m.depth.any() for m in recording.messages("rgbd"))
        return
    with pytest.raises(SourceError, match=f"median depth is {median}.*units_per_m"):
        next(iter(recording.messages("rgbd")))


def test_depth_stored_in_mm_but_read_as_metres_is_told(tmp_path):
    (tmp_path / "rig.toml").write_text(
        '[[camera]]\nmodel = "radtan"\nsize = [640, 480]\nintrinsics = [525, 525, 319.5, 239.5]\n'
        "T_body_cam = [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n[depth]\nunits_per_m = 1\nmax_m = 100\n"
    )
    with pytest.raises(SourceError, match=r"median depth is 1.5e\+03 m"):
        next(iter(open_source(write_sevenscenes(tmp_path)).messages("rgbd")))


@pytest.mark.parametrize("value", ["nan", ".nan", "-458.0"])
def test_intrinsics_that_cannot_be_are_told_with_file_and_key(tmp_path, value):
    write_euroc(tmp_path)
    file = tmp_path / "mav0/cam1/sensor.yaml"
    file.write_text(file.read_text().replace("[50,", f"[{value},"))
    with pytest.raises(CalibrationError, match=r"cam1/sensor\.yaml.*(intrinsics|focal)"):
        open_source(tmp_path)


def test_a_missing_extrinsic_is_told_with_file_and_key(tmp_path):
    write_euroc(tmp_path)
    file = tmp_path / "mav0/cam1/sensor.yaml"
    file.write_text(file.read_text().replace("T_BS", "T_SB"))
    with pytest.raises(CalibrationError, match=r"cam1/sensor\.yaml: T_BS is missing"):
        open_source(tmp_path)


def test_a_file_where_a_folder_should_be_is_told(tmp_path):
    write_tum(tmp_path)
    (tmp_path / "rgb.txt").write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(SourceError, match="not a text file"):
        open_source(tmp_path)


def test_a_depth_image_without_registration_must_have_its_own_size(tmp_path):
    for i in range(3):
        write(tmp_path / f"frame-{i:06d}.color.png", picture(i))
        write(tmp_path / f"frame-{i:06d}.depth.png", np.full((24, 32), 1500, np.uint16))
    with pytest.raises(SourceError, match="3x image is 32x24, the rig says 64x48"):
        numbers(open_source(tmp_path, tiny_depth_rig()), "rgbd")
