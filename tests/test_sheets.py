"""Printed sheets: read back from the file itself, at true size."""

import re
import shutil
import subprocess
import zlib

import cv2
import numpy as np
import pytest

from lodelight.anchors import Anchors, Tag
from lodelight.cli.main import main
from lodelight.errors import ConfigError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.anchors_toml import write_anchors
from lodelight.report.sheets import page_size_mm
from lodelight.tagboard import TagBoard
from lodelight.tags.detect import TagConfig, TagDetector

PX_PER_MM = 4.0


def drawn(pdf: bytes) -> list[np.ndarray]:
    """Each page's boxes as an image, by the operators in the file alone."""
    pages = []
    for box, stream in zip(
        re.findall(rb"/MediaBox \[0 0 ([0-9.]+) ([0-9.]+)\]", pdf),
        re.findall(rb"stream\n(.*?)\nendstream", pdf, re.S),
        strict=True,
    ):
        w, h = (float(v) / 72 * 25.4 for v in box)
        image = np.full((round(h * PX_PER_MM), round(w * PX_PER_MM)), 255, np.uint8)
        for x, y, bw, bh in re.findall(
            r"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", zlib.decompress(stream).decode("cp1252")
        ):
            left, low, wide, tall = (float(v) / 72 * 25.4 * PX_PER_MM for v in (x, y, bw, bh))
            top = h * PX_PER_MM - low - tall
            image[round(top) : round(top + tall), round(left) : round(left + wide)] = 0
        pages.append(image)
    return pages


def read(image, family):
    """Sightings on a page, with their corners in mm."""
    page = Camera.create(
        "radtan", image.shape[1], image.shape[0], (1000.0, 1000.0, image.shape[1] / 2, image.shape[0] / 2)
    )
    return TagDetector(page, (), TagConfig(families=family)).detect(
        cv2.GaussianBlur(image, (0, 0), 0.8), 0, thorough=True
    )


@pytest.mark.parametrize(
    ("family", "ids"), [("tag36h11", "3"), ("aruco_4x4_50", "7"), ("qr", "A17"), ("tag25h9", "12")]
)
def test_a_sheet_shows_the_tag_at_true_size(tmp_path, family, ids):
    assert (
        main(["tags", "print", "--family", family, "--ids", ids, "--size", "0.12", "--out", str(tmp_path / "t.pdf")])
        == 0
    )
    (image,) = drawn((tmp_path / "t.pdf").read_bytes())
    (found,) = read(image, family)
    assert found.id == ids
    sides_mm = np.linalg.norm(found.corners_px - np.roll(found.corners_px, 1, axis=0), axis=1) / PX_PER_MM
    assert sides_mm == pytest.approx(120.0, abs=0.3)  # a pixel is a quarter of a millimetre
    assert found.corners_px[0, 1] > found.corners_px[3, 1]  # upright: its first corner is the lower left
    assert found.corners_px[0, 0] < found.corners_px[1, 0]


def test_qr_sheets_of_a_survey_say_where_they_hang(tmp_path):
    T = SE3.from_quat_xyzw(np.array([1.2, 0.0, 1.5]), np.array([0.5, 0.5, -0.5, -0.5]))
    write_anchors(tmp_path / "anchors.toml", Anchors((Tag("qr", "A17", 0.1, T), Tag("tag36h11", "4", 0.1))))
    assert main(["tags", "print", str(tmp_path / "anchors.toml"), "--out", str(tmp_path / "t.pdf")]) == 0
    first, second = drawn((tmp_path / "t.pdf").read_bytes())
    (qr,) = read(first, "qr")
    assert (qr.id, qr.size_m) == ("A17", 0.1)
    assert np.abs((qr.T_world_tag.inverse() @ T).log()).max() < 1e-3
    assert read(second, "tag36h11")[0].id == "4"


def test_a_pdf_viewer_agrees_with_us(tmp_path):
    if shutil.which("pdftoppm") is None:
        pytest.skip("needs pdftoppm (poppler-utils)")
    assert (
        main(["tags", "print", "--family", "qr", "--ids", "A17", "--size", "0.1", "--out", str(tmp_path / "t.pdf")])
        == 0
    )
    subprocess.run(["pdftoppm", "-r", "101.6", "-gray", "-png", tmp_path / "t.pdf", tmp_path / "page"], check=True)
    (file,) = tmp_path.glob("page*.png")
    (found,) = read(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), "qr")
    sides_mm = np.linalg.norm(found.corners_px - np.roll(found.corners_px, 1, axis=0), axis=1) / PX_PER_MM
    assert sides_mm == pytest.approx(100.0, abs=0.3)


def test_svg_sheets_hold_the_same_boxes(tmp_path):
    args = ["tags", "print", "--family", "tag36h11", "--ids", "0-2", "--size", "0.1", "--out"]
    assert main([*args, str(tmp_path / "t.svg")]) == 0
    assert main([*args, str(tmp_path / "t.pdf")]) == 0
    files = sorted(tmp_path.glob("t-*.svg"))
    assert [f.name for f in files] == ["t-001.svg", "t-002.svg", "t-003.svg"]
    for file, page in zip(files, drawn((tmp_path / "t.pdf").read_bytes()), strict=True):
        image = np.full(page.shape, 255, np.uint8)
        for x, y, w, h in re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v([\d.]+)", file.read_text()):
            x, y, w, h = (float(v) * PX_PER_MM for v in (x, y, w, h))
            image[round(y) : round(y + h), round(x) : round(x + w)] = 0
        assert np.mean(image != page) < 2e-3  # rounding to whole pixels along the edges
    assert 'width="210mm"' in files[0].read_text()


def test_the_same_sheets_are_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        assert main(["tags", "print", "--ids", "X", "--size", "0.1", "--out", str(tmp_path / f"{name}.pdf")]) == 0
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


@pytest.mark.parametrize(
    ("args", "why"),
    [
        (["--ids", "0", "--family", "tag36h11", "--size", "0.19"], "use --page a3"),
        (["--ids", "9999", "--family", "tag36h11"], "0 to 586"),
        (["--ids", "A", "--family", "tag36h11"], "has numbers"),
        (["--ids", "0", "--family", "tag99"], "unknown"),
        (["--ids", "0", "--size", "-1"], "between 0.005 and 5"),
        (["--ids", "9-1", "--family", "tag36h11"], "first-last"),
        (["--ids", "A", "--page", "b17"], "unknown"),
        ([], "anchors.toml or --ids"),
        (["--board", "tag36h11:6x8:60/7mm"], "larger --page"),
        (["--board", "nonsense"], "write family"),
        (["--ids", "x" * 70], "characters"),
    ],
)
def test_what_cannot_be_printed_is_said_in_a_line(tmp_path, capsys, args, why):
    assert main(["tags", "print", *args, "--out", str(tmp_path / "t.pdf")]) == 2
    assert why in capsys.readouterr().err
    assert not (tmp_path / "t.pdf").exists()


def test_board_texts_round_trip():
    board = TagBoard("aruco_4x4_50", 5, 7, 0.03, 0.006)
    assert TagBoard.parse(str(board)) == board
    assert page_size_mm("300x400") == (300.0, 400.0)
    with pytest.raises(ConfigError, match="letter"):
        page_size_mm("3x")
