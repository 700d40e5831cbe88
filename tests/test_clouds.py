"""Point clouds as other readers find them: plyfile for PLY, a reader written from the format's page for PCD."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from lodelight.errors import SourceError
from lodelight.io.clouds import write_pcd, write_ply


def cloud(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return rng.normal(size=(n, 3)) * 10, normal, rng.integers(0, 100, n).astype(np.int32)


def read_pcd(path: Path) -> np.ndarray:
    data = path.read_bytes()
    end = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    head = {line.split()[0]: line.split()[1:] for line in data[:end].decode().splitlines()}
    assert int(head["WIDTH"][0]) * int(head["HEIGHT"][0]) == int(head["POINTS"][0])
    kinds = [f"<{t.lower()}{s}" for t, s in zip(head["TYPE"], head["SIZE"], strict=True)]
    return np.frombuffer(data[end:], list(zip(head["FIELDS"], kinds, strict=True)), int(head["POINTS"][0]))


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_ply_is_read_back_by_plyfile(tmp_path: Path, n: int) -> None:
    xyz, normal, n_obs = cloud(n)
    write_ply(tmp_path / "c.ply", xyz, normal, n_obs=n_obs)
    ply = PlyData.read(str(tmp_path / "c.ply"))
    vertex = ply["vertex"]
    assert ply.byte_order == "<"
    np.testing.assert_array_equal(np.column_stack([vertex[a] for a in "xyz"]), xyz.astype(np.float32))
    np.testing.assert_array_equal(np.column_stack([vertex["n" + a] for a in "xyz"]), normal.astype(np.float32))
    np.testing.assert_array_equal(vertex["n_obs"], n_obs)


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_pcd_is_read_back_by_its_format_page(tmp_path: Path, n: int) -> None:
    xyz, normal, n_obs = cloud(n)
    write_pcd(tmp_path / "c.pcd", xyz, normal, n_obs=n_obs)
    rows = read_pcd(tmp_path / "c.pcd")
    np.testing.assert_array_equal(np.column_stack([rows[a] for a in "xyz"]), xyz.astype(np.float32))
    np.testing.assert_array_equal(rows["normal_z"], normal[:, 2].astype(np.float32))
    np.testing.assert_array_equal(rows["n_obs"], n_obs)


def test_plain_points_need_nothing_else(tmp_path: Path) -> None:
    xyz, _, _ = cloud(10)
    write_ply(tmp_path / "c.ply", xyz)
    assert PlyData.read(str(tmp_path / "c.ply"))["vertex"].data.dtype.names == ("x", "y", "z")


def test_a_type_that_clouds_do_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot hold t_ns"):
        write_ply(tmp_path / "c.ply", np.zeros((2, 3)), t_ns=np.zeros(2, np.int64))
    assert not (tmp_path / "c.ply").exists()
