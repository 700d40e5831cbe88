"""Localization in a saved map as a user meets it: a recording, a photo, a map that stays as it is, mistakes."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import shared_data
from lodelight.cli.main import main
from lodelight.io import open_source
from lodelight.io.rig_toml import write_rig
from lodelight.localizer import Localizer, LocalizerConfig
from lodelight.mapping.store import load_map, save_map
from lodelight.messages import Frame
from lodelight.slam import Slam, SlamConfig

BLOCK = 50


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    """A folder with a map of every other block of 50 frames of the kitchen."""
    folder = tmp_path_factory.mktemp("kitchen")
    recording = open_source(shared_data("redkitchen"))
    slam = Slam(recording.rig, SlamConfig())
    for i, frame in enumerate(recording.messages("rgbd")):
        if (i // BLOCK) % 2 == 0 and i < 3 * BLOCK:
            slam.feed(frame)
    slam.close()
    save_map(slam.map, folder / "map.lode")
    return folder


def localize(*arguments):
    return main(["localize", *map(str, arguments)])


def test_frames_between_the_mapped_ones_are_localized_and_the_map_file_is_untouched(kitchen, tmp_path):
    before = (kitchen / "map.lode").read_bytes()
    source = shared_data("redkitchen")
    status = localize(
        source, "--map", kitchen, "--out", tmp_path, "--sensors", "mono", "--start", BLOCK / 30, "--end", 99 / 30
    )
    assert status == 0
    assert (kitchen / "map.lode").read_bytes() == before
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["frames"] == BLOCK
    assert metrics["tracked_fraction"] >= 0.95
    assert metrics["temporary_points"]["left"] == 0
    assert not (tmp_path / "map.lode").exists()
    assert (tmp_path / "report.html").stat().st_size > 100_000


def test_a_single_image_is_localized(kitchen, tmp_path, capsys):
    source = shared_data("redkitchen")
    photo = tmp_path / "photo.jpg"
    shutil.copy(source / "frame-000075.color.jpg", photo)
    write_rig(tmp_path / "camera.toml", open_source(source).rig.with_cameras(1))
    assert localize(photo, "--map", kitchen, "--rig", tmp_path / "camera.toml", "--out", tmp_path / "out") == 0
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["relocalizations"] == 1
    assert "looking along" in capsys.readouterr().out
    assert '"relocalized","x":{"dtype"' in (tmp_path / "out" / "report.html").read_text()  # on the map, from above


def test_a_lens_half_as_long_finds_more_of_the_map_in_enlarged_images(kitchen, monkeypatch):
    recording = open_source(shared_data("redkitchen"))
    half = replace(recording.rig.resized(0.5), depth=None)
    size = (half.cameras[0].camera.width, half.cameras[0].camera.height)
    frame = next(recording.messages("mono", 75 / 30))
    small = Frame(0, (cv2.resize(frame.images[0], size, interpolation=cv2.INTER_AREA),))
    map, inliers = load_map(kitchen / "map.lode"), []
    for most in (1.0, 2.0):
        monkeypatch.setattr("lodelight.localizer.MOST_ENLARGED", most)
        inliers.append(Localizer(half, map, LocalizerConfig(sensors="mono")).feed(small).inliers)
    assert inliers[1] > 1.3 * inliers[0]


def test_mistakes_get_one_line_and_exit_status_2(kitchen, tmp_path, capsys):
    source = shared_data("redkitchen")

    def fails(*arguments):
        assert localize(*arguments, "--out", tmp_path / "out") == 2
        said = capsys.readouterr().err.strip()
        assert "\n" not in said
        assert "Traceback" not in said
        return said

    good = kitchen / "map.lode"
    cut = tmp_path / "cut.lode"
    cut.write_bytes(good.read_bytes()[:50_000])
    assert "cut.lode" in fails(source, "--map", cut)
    for name, spoil in (("empty", lambda m: m.remove_points(m.alive_points)), ("blank", blank)):
        map = load_map(good)
        spoil(map)
        save_map(map, tmp_path / f"{name}.lode")
    assert "the map is empty" in fails(source, "--map", tmp_path / "empty.lode")
    assert "no descriptors" in fails(source, "--map", tmp_path / "blank.lode")
    assert "lidar" in fails(source, "--map", good, "--sensors", "lidar")
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((48, 64), np.uint8))
    write_rig(tmp_path / "camera.toml", open_source(source).rig.with_cameras(1))
    assert "64x48" in fails(small, "--map", good, "--rig", tmp_path / "camera.toml")


def blank(map):
    map.features.desc[:] = 0
    map.points.desc[:] = 0
