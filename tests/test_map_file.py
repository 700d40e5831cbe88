"""The map file: what goes in comes out, equal bytes for equal maps, and nothing half-written or damaged is believed."""

from __future__ import annotations

import multiprocessing
import os
import resource
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from lodelight.errors import MapError
from lodelight.geometry.se3 import SE3
from lodelight.io.rig_toml import format_rig
from lodelight.mapping import invariants, store
from lodelight.mapping.compact import compacted, squeeze
from lodelight.mapping.map import Map
from lodelight.mapping.mapfile import DamagedMap
from lodelight.mapping.store import check_map, load_map, map_info, save_map
from lodelight.mapping.table import Table
from maps import room_map, room_rig, thinned


def assert_equal_maps(a: Map, b: Map) -> None:
    assert format_rig(a.rig) == format_rig(b.rig)
    assert a.tables.keys() == b.tables.keys()
    for name, table in a.tables.items():
        for column, values in table.columns.items():
            other = b.tables[name].columns[column]
            assert values.dtype == other.dtype
            np.testing.assert_array_equal(values, other, err_msg=f"{name}.{column}")


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    save_map(room_map(sigma_px=0.5), tmp_path / "map.lode", {"seed": 7, "source": "room"})
    return tmp_path / "map.lode"


# -- what goes in comes out -----------------------------------------------------------------------------------------


def test_every_column_comes_back_from_the_file(saved: Path) -> None:
    original = room_map(sigma_px=0.5)
    assert all(values.any() for values in original.features.columns.values())  # a column of zeros would prove nothing
    assert_equal_maps(load_map(saved), original)


def test_map_larger_than_a_block_comes_back(tmp_path: Path) -> None:
    original = room_map(n_keyframes=5, n_points=3 * store.BLOCK_ROWS)
    assert len(original.points) > 2 * store.BLOCK_ROWS
    save_map(original, tmp_path / "map.lode")
    assert_equal_maps(load_map(tmp_path / "map.lode"), original)


@pytest.mark.parametrize("keyframes", [0, 1])
def test_empty_map_and_map_of_one_empty_keyframe_come_back(tmp_path: Path, keyframes: int) -> None:
    original = room_map(n_keyframes=keyframes, n_points=0)
    save_map(original, tmp_path / "map.lode")
    assert check_map(tmp_path / "map.lode") == []
    assert_equal_maps(load_map(tmp_path / "map.lode"), original)


@pytest.mark.parametrize("lens", [("equidistant", (0.01, -0.002, 0.001, 0.0)), ("double_sphere", (-0.2, 0.6))])
def test_every_lens_comes_back(tmp_path: Path, lens: tuple[str, tuple[float, ...]]) -> None:
    original = room_map(rig=room_rig(*lens))
    original.save(tmp_path / "map.lode")
    assert_equal_maps(load_map(tmp_path / "map.lode"), original)


@pytest.mark.parametrize("seed", range(5))
def test_save_leaves_out_what_is_dead_and_nothing_else(tmp_path: Path, seed: int) -> None:
    map = thinned(room_map(seed, n_keyframes=16), seed)
    before = {(n, c): v.copy() for n, t in map.tables.items() for c, v in t.columns.items()}
    save_map(map, tmp_path / "map.lode")
    for (name, column), values in before.items():
        np.testing.assert_array_equal(map.tables[name].columns[column], values)  # the live map is not changed

    loaded = load_map(tmp_path / "map.lode")
    assert invariants.problems(loaded) == []
    assert loaded.keyframes.alive.all()
    assert loaded.points.alive.all()
    keyframes, points = map.alive_keyframes, map.alive_points
    new_keyframe = {int(old): new for new, old in enumerate(keyframes)}
    np.testing.assert_array_equal(loaded.keyframes.p, map.keyframes.p[keyframes])
    np.testing.assert_array_equal(loaded.points.xyz, map.points.xyz[points])
    for new, old in enumerate(keyframes):
        parent = int(map.keyframes.parent[old])
        assert int(loaded.keyframes.parent[new]) == (new_keyframe[parent] if parent >= 0 else -1)
        np.testing.assert_array_equal(
            loaded.features.px[loaded.feature_range(new)], map.features.px[map.feature_range(int(old))]
        )
    for new, old in enumerate(points):  # the same sightings in the same order, told by keyframe and pixel
        told = [(new_keyframe[int(map.features.keyframe[r])], *map.features.px[r]) for r in map.observations(int(old))]
        again = [(int(loaded.features.keyframe[r]), *loaded.features.px[r]) for r in loaded.observations(new)]
        assert told == again
    for new, old in enumerate(points):  # born in the keyframe it was, or in its nearest ancestor that is left
        birth = int(map.points.first_keyframe[old])
        while not map.keyframes.alive[birth]:
            birth = int(map.keyframes.parent[birth])
        assert loaded.points.first_keyframe[new] == new_keyframe[birth]


def test_loops_of_culled_keyframes_pass_to_their_ancestors_and_say_the_same() -> None:
    map = room_map(n_keyframes=9)
    offset = SE3.exp(np.array([0.01, -0.02, 0.03, 0.05, 0.0, -0.04]))  # a loop is measured, and is not what is believed
    for a, b in [(3, 7), (2, 3), (4, 8)]:
        T_a_b = map.pose(a).inverse() @ map.pose(b) @ offset
        map.loops.append(1, a=a, b=b, R=T_a_b.R, p=T_a_b.t)
    believed = {k: map.pose(k) for k in range(9)}
    for keyframe in (6, 3, 7):
        map.remove_keyframe(keyframe)
    small = compacted(map)
    # 3 passes to 2, 7 by 6 to 5: (3, 7) becomes (2, 5), whose new numbers are (2, 4); (2, 3) has nothing left to say
    assert list(zip(small.loops.a.tolist(), small.loops.b.tolist(), strict=True)) == [(0, 5), (2, 4), (3, 5)]
    T_2_5 = believed[2].inverse() @ believed[3]
    T_2_5 = T_2_5 @ (believed[3].inverse() @ believed[7] @ offset) @ (believed[7].inverse() @ believed[5])
    np.testing.assert_allclose(small.loops.R[1], T_2_5.R, atol=1e-12)  # rounding of a few products
    np.testing.assert_allclose(small.loops.p[1], T_2_5.t, atol=1e-12)


def test_points_and_loops_of_a_root_that_is_gone_are_not_lost_track_of() -> None:
    map = room_map(n_keyframes=5)
    map.remove_keyframe(0)
    small = compacted(map)
    assert len(small.loops) == 0
    assert invariants.problems(small) == []


def test_keyframes_without_features_keep_their_place() -> None:
    map = room_map(n_keyframes=3, n_points=0)
    crowd = room_map(n_keyframes=3)
    for k in range(3):
        rows = crowd.feature_range(k)
        map.features.append(rows.stop - rows.start, keyframe=3 + k, point=-1, next=-1, px=crowd.features.px[rows])
        map.keyframes.append(
            1, R=np.eye(3), parent=2 + k, first_feature=rows.start, n_features=rows.stop - rows.start, alive=True
        )
    map.remove_keyframe(3)
    map.remove_keyframe(1)
    small = compacted(map)
    assert invariants.problems(small) == []
    assert small.keyframes.n_features.tolist() == [0, 0, *map.keyframes.n_features[4:].tolist()]


def test_squeezed_in_place_a_map_loses_its_dead_rows_and_nothing_else() -> None:
    map = room_map(n_keyframes=9)
    for keyframe in (3, 4, 7):
        map.remove_keyframe(keyframe)
    map.remove_points(map.alive_points[::5])
    small, poses = compacted(map), [map.pose(k) for k in range(9)]
    xyz = map.points.xyz.copy()
    new_point = squeeze(map)
    assert invariants.problems(map) == []
    assert len(map.keyframes) == 9  # whoever keeps their numbers may go on to
    np.testing.assert_array_equal([map.pose(k).t for k in range(9)], [T.t for T in poses])
    assert len(map.points) == len(small.points)
    for name in ("px", "desc", "point", "next"):
        np.testing.assert_array_equal(getattr(map.features, name), getattr(small.features, name))
    alive = new_point >= 0
    np.testing.assert_array_equal(map.points.xyz[new_point[alive]], xyz[alive[:-1]])
    seen = map.features_of(8)
    map.add_keyframe(10**9, poses[8], seen, parent=8)
    assert invariants.problems(map) == []


# -- the same bytes ---------------------------------------------------------------------------------------------


def test_equal_maps_give_equal_bytes_in_any_process(saved: Path, tmp_path: Path) -> None:
    save_map(load_map(saved), tmp_path / "again.lode", {"seed": 7, "source": "room"})
    assert (tmp_path / "again.lode").read_bytes() == saved.read_bytes()
    code = (
        "import sys; from maps import room_map; from lodelight.mapping.store import save_map\n"
        "save_map(room_map(sigma_px=0.5), sys.argv[1], {'seed': 7, 'source': 'room'})"
    )
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "other.lode")],
        check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(Path(__file__).parent), "PYTHONHASHSEED": "5"},
    )  # fmt: skip
    assert (tmp_path / "other.lode").read_bytes() == saved.read_bytes()


def test_saving_over_an_old_map_gives_the_bytes_of_a_fresh_one(saved: Path, tmp_path: Path) -> None:
    save_map(room_map(seed=3, n_keyframes=20), tmp_path / "old.lode")
    save_map(load_map(saved), tmp_path / "old.lode", {"seed": 7, "source": "room"})
    assert (tmp_path / "old.lode").read_bytes() == saved.read_bytes()


def test_reading_leaves_the_file_and_its_folder_as_they_were(saved: Path) -> None:
    before, stamp = saved.read_bytes(), saved.stat().st_mtime_ns
    saved.chmod(0o444)
    load_map(saved), map_info(saved), check_map(saved)
    assert saved.read_bytes() == before
    assert saved.stat().st_mtime_ns == stamp
    assert os.listdir(saved.parent) == ["map.lode"]


def test_names_with_uri_characters_are_names(tmp_path: Path) -> None:
    path = tmp_path / "my map?mode=rw#1 50%.lode"
    save_map(room_map(), path)
    assert check_map(path) == []


def test_saving_through_a_link_replaces_what_it_leads_to(saved: Path, tmp_path: Path) -> None:
    (tmp_path / "link.lode").symlink_to(saved)
    save_map(room_map(n_keyframes=3), tmp_path / "link.lode")
    assert (tmp_path / "link.lode").is_symlink()
    assert map_info(saved)["keyframes"] == 3


def test_permissions_of_the_earlier_map_are_kept(saved: Path) -> None:
    saved.chmod(0o600)
    save_map(room_map(seed=1), saved)
    assert saved.stat().st_mode & 0o777 == 0o600


def test_info_tells_counts_and_notes(saved: Path) -> None:
    map, info = room_map(sigma_px=0.5), map_info(saved)
    assert info["keyframes"] == len(map.keyframes)
    assert info["observations"] == map.points.n_obs.sum()
    assert info["notes"] == {"seed": 7, "source": "room"}
    assert info["sensors"] == "mono-inertial"
    assert info["bytes"] == saved.stat().st_size


# -- kills and full disks ---------------------------------------------------------------------------------------


def save_for_ever(maps: list[Map], path: Path) -> None:
    while True:
        for map in maps:
            save_map(map, path)


def test_a_killed_save_leaves_one_whole_map_and_the_next_save_clears_up(tmp_path: Path) -> None:
    path = tmp_path / "map.lode"
    maps = [room_map(seed, n_keyframes=40, n_points=2000) for seed in (1, 2)]
    wanted = []
    for map in maps:
        save_map(map, path)
        wanted.append(path.read_bytes())
    rng = np.random.default_rng(0)
    halfway = 0
    for _ in range(30):
        process = multiprocessing.get_context("fork").Process(target=save_for_ever, args=(maps, path))
        process.start()
        time.sleep(rng.uniform(0.02, 0.1))
        process.kill()
        process.join()
        assert path.read_bytes() in wanted
        halfway += len(os.listdir(tmp_path)) > 1
    assert halfway > 0  # some kills must have come in the middle of a save, or nothing was tried
    save_map(room_map(), path)
    assert os.listdir(tmp_path) == ["map.lode"]


def test_savers_of_one_map_wait_for_each_other(tmp_path: Path) -> None:
    path, maps = tmp_path / "map.lode", [room_map(seed) for seed in range(3)]
    wanted = set()
    for map in maps:
        save_map(map, path)
        wanted.add(path.read_bytes())
    failed: list[Exception] = []

    def save_often(map: Map) -> None:
        try:
            for _ in range(10):
                save_map(map, path)
        except Exception as error:
            failed.append(error)

    savers = [threading.Thread(target=save_often, args=(map,)) for map in maps]
    for saver in savers:
        saver.start()
    while any(saver.is_alive() for saver in savers):
        assert path.read_bytes() in wanted
    assert failed == []
    assert os.listdir(tmp_path) == ["map.lode"]


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_a_full_disk_leaves_the_earlier_map_and_no_rubbish(saved: Path, fraction: float) -> None:
    """A limit on file size stands for the disk: writing beyond it fails at that byte."""
    earlier = saved.read_bytes()
    larger = room_map(n_keyframes=30, n_points=1000)
    save_map(larger, saved.with_name("size.lode"))
    size = saved.with_name("size.lode").stat().st_size
    saved.with_name("size.lode").unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(fraction * size), hard))
    try:
        with pytest.raises(MapError, match=r"cannot save map .*; make room or choose another place"):
            save_map(larger, saved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert saved.read_bytes() == earlier
    assert os.listdir(saved.parent) == ["map.lode"]


def test_an_interrupted_save_leaves_no_rubbish(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    earlier = saved.read_bytes()
    monkeypatch.setattr(store, "_blocks", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_map(room_map(), saved)
    assert saved.read_bytes() == earlier
    assert os.listdir(saved.parent) == ["map.lode"]


def test_saving_where_nothing_can_be_saved_is_a_map_error(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="is a folder"):
        save_map(room_map(), tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(MapError, match="cannot save"):
        save_map(room_map(), tmp_path / "file" / "map.lode")
    with pytest.raises(MapError, match="cannot save"):
        save_map(room_map(), "/proc/map.lode")


# -- what is no map, and what was one ---------------------------------------------------------------------------


def rewrite(path: Path, sql: str) -> None:
    with sqlite3.connect(path) as db:
        db.execute(sql)
    db.close()


def test_what_is_no_map_is_refused_with_its_reason(saved: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "short").write_bytes(b"SQLite format 3\0")
    (tmp_path / "text").write_text("# a trajectory\n" * 100)
    rewrite(tmp_path / "plain.db", "CREATE TABLE a (b)")
    cases = {"": "is a folder", "none": "does not exist", "empty": "is empty", "short": "is not a map",
             "text": "is not a map", "plain.db": "an SQLite database but not a map"}  # fmt: skip
    for name, reason in cases.items():
        for function in (load_map, map_info, check_map):
            with pytest.raises(MapError, match=reason) as error:
                function(tmp_path / name)
            assert not isinstance(error.value, DamagedMap)
            assert "\n" not in str(error.value)


def test_maps_of_newer_or_foreign_formats_are_refused(saved: Path) -> None:
    rewrite(saved, f"PRAGMA user_version = {store.VERSION + 1}")
    with pytest.raises(MapError, match="update lodelight"):
        load_map(saved)
    rewrite(saved, "PRAGMA application_id = 1")
    with pytest.raises(MapError, match="not a map"):
        load_map(saved)


def test_truncated_map_is_refused_at_every_length(saved: Path) -> None:
    whole = saved.read_bytes()
    for length in [*range(100, len(whole), 9973), len(whole) - 1]:
        saved.write_bytes(whole[:length])
        with pytest.raises(DamagedMap, match="is truncated"):
            load_map(saved)
        assert len(check_map(saved)) == 1


def test_flipped_bytes_are_found_or_do_no_harm(saved: Path) -> None:
    """Wherever a byte is wrong: the map is refused, or it is the same map (the byte was padding)."""
    whole, original = saved.read_bytes(), load_map(saved)
    rng = np.random.default_rng(0)
    written = np.flatnonzero(np.frombuffer(whole, np.uint8))
    refused = 0
    for at in [*range(100), *rng.choice(written, 400)]:
        flipped = bytearray(whole)
        flipped[at] ^= 1 << rng.integers(8)
        saved.write_bytes(flipped)
        try:
            loaded = load_map(saved)
        except MapError:
            refused += 1
            continue
        assert_equal_maps(loaded, original)
    assert refused > 350


def test_lost_rows_are_found(saved: Path) -> None:
    rewrite(saved, "DELETE FROM features WHERE first_row = (SELECT max(first_row) FROM features)")
    with pytest.raises(DamagedMap, match=r"has \d+ of its \d+ features"):
        load_map(saved)
    rewrite(saved, "DELETE FROM meta WHERE key = 'rig'")
    with pytest.raises(DamagedMap, match="has lost its rig"):
        load_map(saved)


def test_a_map_that_would_lead_out_of_its_arrays_is_neither_saved_nor_loaded(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    map, earlier = room_map(), saved.read_bytes()
    map.points.head[3] = -2
    with pytest.raises(MapError, match="points whose head is no row of features: 3"):
        save_map(map, saved)
    assert saved.read_bytes() == earlier
    with monkeypatch.context() as other_writer:
        other_writer.setattr(invariants, "structure", lambda map: [])
        other_writer.setattr(store, "compacted", lambda map: map)
        save_map(map, saved)
    with pytest.raises(DamagedMap, match="contradicts itself"):
        load_map(saved)
    assert check_map(saved) == ["points whose head is no row of features: 3"]


# -- the documentation --------------------------------------------------------------------------------------------


def test_the_page_on_the_file_reads_a_keyframe_without_this_package(
    saved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[1] / "docs" / "map-file.md").read_text(encoding="utf-8")
    codes = [block.split("```")[0] for block in page.split("```python\n")[1:]]
    (saved.parent / "out").mkdir()
    saved.rename(saved.parent / "out" / "map.lode")
    monkeypatch.chdir(saved.parent)
    found: dict[str, dict[str, np.ndarray]] = {}
    for code in codes:
        exec(code, found)
    original = room_map(sigma_px=0.5)
    for name, values in original.features.columns.items():
        np.testing.assert_array_equal(found["features"][name], values[original.feature_range(0)])


# -- columns come and go ----------------------------------------------------------------------------------------


class MapWithColour(Map):
    """A map of a later version, with one more column."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        columns = {name: (c.dtype, c.shape[1:]) for name, c in self.points.columns.items()}
        self.points = Table(**columns, colour=(np.float32, (3,)))


def test_older_file_is_read_where_a_new_column_has_a_value_for_it(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "Map", MapWithColour)
    with pytest.raises(MapError, match=r"lacks the column points\.colour"):
        load_map(saved)
    monkeypatch.setitem(store.ADDED, ("points", "colour"), 0.5)
    assert (load_map(saved).points.colour == 0.5).all()


def test_file_with_an_unknown_column_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lodelight.mapping.compact.Map", MapWithColour)
    map = MapWithColour(room_rig())
    save_map(map, tmp_path / "map.lode")
    with pytest.raises(MapError, match=r"has the column points\.colour"):
        load_map(tmp_path / "map.lode")
