import sys
import zipfile

import jax
import numpy as np
import pytest

from ventbench import draws, files, precision, protocol
from ventbench.errors import InputError


@pytest.fixture
def cells():
    with precision.float64():
        return jax.tree.map(np.asarray, draws.scenarios())


def test_build_gives_what_is_frozen():
    with np.load(files.data_path(draws.FILE)) as npz:
        frozen = {name: npz[name] for name in npz.files}
    built = draws.build()
    assert built.keys() == frozen.keys()
    for name, values in built.items():
        np.testing.assert_array_equal(values, frozen[name], err_msg=name)


def test_file_is_the_published_one():
    assert files.sha256(files.data_path(draws.FILE)) == draws.SHA256


def test_cells(cells):
    assert all(
        leaf.shape == (20, 6) and leaf.dtype == np.float64
        for name, leaf in vars(cells).items()
        if name != "noise"
    )
    assert cells.noise.shape == (20, 6, protocol.BREATHS, protocol.INSPIRATION_STEPS)
    assert np.all(np.abs(cells.pip - np.array(protocol.PIPS)) <= 1.0)
    assert np.all(np.abs(cells.peep - 5.0) <= 0.5)
    assert np.all(np.abs(cells.start - cells.peep) <= 0.5)
    assert np.all(np.abs(cells.dt / 0.03 - 1.0) <= 0.03)
    for scale in (cells.r_scale, cells.c_scale):
        assert np.all(np.abs(scale - 1.0) <= 0.05)
    assert np.all((cells.delay >= 0.0) & (cells.delay <= 0.5))
    np.testing.assert_array_equal(cells.quantum, 0.0703)


def test_noise_is_white_and_as_large_as_the_sensors(cells):
    noise = cells.noise.reshape(20 * 6, -1)
    assert np.all((noise.std(axis=1) > 0.15) & (noise.std(axis=1) < 0.31))
    assert 0.21 < noise.std() < 0.24
    assert abs(noise.mean()) < 0.01
    assert abs(np.mean(noise[:, 1:] * noise[:, :-1])) < 0.002
    # Gaussian: 4.55 % beyond two standard deviations.
    scaled = noise / noise.std(axis=1, keepdims=True)
    assert np.mean(np.abs(scaled) > 2) == pytest.approx(0.0455, abs=0.01)


def test_parts_are_parts(cells):
    with precision.float64():
        few = draws.scenarios((35.0, 10.0), 3)
    np.testing.assert_array_equal(few.noise, cells.noise[:3, [5, 0]])
    np.testing.assert_array_equal(few.pip, cells.pip[:3, [5, 0]])


@pytest.mark.parametrize("n", [-1, 0, 21])
def test_so_many_draws_do_not_exist(n):
    with pytest.raises(InputError, match=r"20 published draws; -?\d+ is outside 1..20"):
        draws.scenarios(n=n)


def test_no_draws_for_other_pips():
    with pytest.raises(InputError, match="no draws for PIP 12 cmH2O; they exist for 10, 15"):
        draws.scenarios((10.0, 12.0))


def test_changed_file_is_refused(tmp_path, monkeypatch):
    path = tmp_path / draws.FILE
    content = bytearray(files.data_path(draws.FILE).read_bytes())
    content[5000] ^= 1
    path.write_bytes(content)
    monkeypatch.setattr(draws.files, "data_path", lambda name: path)
    draws._frozen.cache_clear()
    with pytest.raises(InputError, match="not the published draws version 1: its SHA-256 is"):
        draws.scenarios()
    draws._frozen.cache_clear()


def test_missing_file_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_PACKAGE", tmp_path / "ventbench")
    with pytest.raises(InputError, match=r"data/draws-v1.npz is missing"):
        files.data_path(draws.FILE)


def test_wheel_comes_before_a_folder_beside_it(tmp_path, monkeypatch):
    package = tmp_path / "ventbench"
    (package / "_data").mkdir(parents=True)
    (package / "_data" / "x").touch()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "x").touch()
    monkeypatch.setattr(files, "_PACKAGE", package)
    assert files.data_path("x") == package / "_data" / "x"


def test_script_writes_the_file_again(tmp_path):
    again = tmp_path / "again.npz"
    digest = draws.write(again)
    assert members(again) == members(files.data_path(draws.FILE))
    if sys.version_info >= (3, 11, 4):  # before, zipfile wrote other headers around the arrays
        assert digest == draws.SHA256


def members(path):
    """Name and bytes of each file in an archive, in order."""
    with zipfile.ZipFile(path) as archive:
        return [(name, archive.read(name)) for name in archive.namelist()]
