"""`lodelight map`: what it prints, what it writes, and its exit statuses."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest
from plyfile import PlyData

from lodelight.cli.main import main
from lodelight.mapping.store import save_map
from maps import room_map, room_rig

POINTS = len(room_map(n_keyframes=20, n_points=1000).points)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_map(room_map(n_keyframes=20, n_points=1000), tmp_path / "map.lode", {"seed": 7})
    return tmp_path / "map.lode"


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = main(["map", *(str(a) for a in arguments)])
    out, err = capsys.readouterr()
    return status, out, err


def test_info_of_a_file_or_of_the_folder_it_is_in(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "info", path.parent, "--json")
    assert status == 0
    found = json.loads(out)
    assert (found["keyframes"], found["points"], found["notes"]) == (
        20,
        len(room_map(n_keyframes=20, n_points=1000).points),
        {"seed": 7},
    )
    status, out, _ = run(capsys, "info", path)
    assert status == 0
    assert "keyframes  20 over 0.9 s" in out  # 19 steps of 50 ms
    assert "notes      seed 7\n" in out


def test_check_is_0_for_a_sound_map_1_for_a_damaged_one_and_2_for_none(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "check", path)[:2] == (0, f"{path} is sound\n")
    path.write_bytes(path.read_bytes()[:-1])
    status, out, err = run(capsys, "check", path, "--json")
    assert (status, err) == (1, "")
    assert "truncated" in json.loads(out)["problems"][0]
    (tmp_path / "text").write_text("no map")
    status, out, err = run(capsys, "check", tmp_path / "text")
    assert (status, out) == (2, "")
    assert "is not a map" in err


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda p: p.unlink(), "does not exist"),
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.write_bytes(p.read_bytes()[:30_000]), "truncated"),
        (lambda p: p.write_text("no map at all"), "is not a map"),
        (lambda p: sqlite3.connect(p).execute("PRAGMA user_version = 99"), "update lodelight"),
    ],
)
@pytest.mark.parametrize("command", ["info", "export"])
def test_bad_maps_are_one_line_and_status_2(
    path: Path, capsys: pytest.CaptureFixture[str], command: str, spoil: object, said: str
) -> None:
    spoil(path)  # type: ignore[operator]
    more = ["--format", "ply", "--out", path.with_name("c.ply")] if command == "export" else []
    status, out, err = run(capsys, command, path, *more)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not path.with_name("c.ply").exists()


def test_every_format_is_written(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("ply", "pcd", "colmap", "grid"):
        status, out, err = run(capsys, "export", path, "--format", name, "--out", tmp_path / "to" / name, "--json")
        assert (status, err) == (0, "")
        assert json.loads(out)
    assert len(PlyData.read(str(tmp_path / "to" / "ply"))["vertex"].data) == len(
        room_map(n_keyframes=20, n_points=1000).points
    )
    assert (tmp_path / "to" / "pcd").read_bytes().startswith(b"VERSION 0.7\nFIELDS x y z normal_x")
    assert (tmp_path / "to" / "colmap" / "points3D.txt").is_file()
    assert (tmp_path / "to" / "grid.pgm").read_bytes().startswith(b"P5\n")


def test_grid_takes_its_options(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--resolution", "0.1", "--up", "0,0,2", "--band", "0.5", "1.5", "--floor", "0.0", "--range", "5"]
    status, out, _ = run(capsys, "export", path, "--format", "grid", "--out", tmp_path / "g", *options, "--json")
    assert status == 0
    assert json.loads(out)["floor_m"] == 0.0
    assert json.loads(out)["up"] == "0.0000 0.0000 1.0000 in the map's frame, as given"
    assert "resolution: 0.1\n" in (tmp_path / "g.yaml").read_text()
    for wrong in ("up", "1,2", "0,0,0", "a,b,c", "nan,0,1"):
        status, out, err = run(capsys, "export", path, "--format", "grid", "--out", tmp_path / "h", "--up", wrong)
        assert (status, out) == (2, "")
        assert "no direction" in err
    assert not (tmp_path / "h.yaml").exists()


def test_colmap_without_its_lens_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_map(room_map(rig=room_rig("double_sphere", (-0.2, 0.6))), tmp_path / "map.lode")
    status, out, err = run(capsys, "export", tmp_path, "--format", "colmap", "--out", tmp_path / "model")
    assert (status, out) == (2, "")
    assert "COLMAP has no double_sphere lens" in err
