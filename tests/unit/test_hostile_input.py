"""Crafted files and values: each is refused with a typed error, at once and without taking memory."""

from __future__ import annotations

import io
import time
import zipfile
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from astropy.io import fits

from escape_hw.config.loader import load_system, load_text
from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.fits.matrix import load_basis, load_matrix, save_matrix
from escape_hw.io.interchange.pyrtc.calibration import PyrtcConfig
from escape_hw.io.interchange.pyrtc.files import read_file

DEEP = {
    "array": "x = " + "[" * 5000 + "]" * 5000,
    "table": "x = " + "{a=" * 900 + "1" + "}" * 900,
    "dotted": ".".join("a" * 1 for _ in range(3000)) + " = 1",
    "header": "[" + ".".join("a" for _ in range(3000)) + "]",
    "integer": "x = " + "9" * 5000,
}


@pytest.mark.parametrize("text", DEEP.values(), ids=DEEP)
def test_deep_toml_and_long_numbers(text: str) -> None:
    with pytest.raises(ConfigError):
        load_text(text)


@pytest.mark.parametrize("value", ["[" * 5000 + "]" * 5000, "9" * 5000, "{a=" * 900 + "1" + "}" * 900])
def test_deep_overrides(value: str) -> None:
    with pytest.raises(ConfigError):
        load_system("razor-shwfs", overrides=[f"system.seed={value}"])


def test_a_file_of_many_wrong_keys_stops_after_the_first_problems(tmp_path: Path) -> None:
    path = tmp_path / "many.toml"
    path.write_text("\n".join(f"k{number} = 1" for number in range(50_000)))
    began = time.monotonic()
    with pytest.raises(ConfigError) as refused:
        load_system(path)
    lines = str(refused.value).splitlines()
    assert len(lines) <= 21
    assert "further problems" in lines[-1]
    assert time.monotonic() - began < 20


def test_a_configuration_of_many_megabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "many.toml"
    path.write_text("\n".join(f"key{number} = 1" for number in range(200_000)))
    with pytest.raises(ConfigError, match="larger than 1 MB"):
        load_system(path)


@pytest.mark.parametrize(
    "name",
    ["x" * 5000 + ".toml", "/".join("x" * 200 for _ in range(25)) + ".toml", "bad\udcff.toml", "a\0b.toml",
     "~nobody-of-this-name/x.toml"],
    ids=["long name", "long path", "surrogate", "null", "unknown user"],
)  # fmt: skip
def test_hostile_paths(name: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_system(name)
    assert len(str(refused.value)) < 1000
    with pytest.raises(ProductError):
        load_matrix(name)


@pytest.mark.parametrize("text", ["[" * 5000 + "]" * 5000, "a: " + "9" * 5000, "{a: " * 3000 + "}" * 3000])
def test_deep_yaml(tmp_path: Path, text: str) -> None:
    pytest.importorskip("yaml")
    path = tmp_path / "pyrtc.yaml"
    path.write_text(text)
    with pytest.raises(ProductError):
        PyrtcConfig.read(path)


def npy(shape: str, data: bytes = b"") -> bytes:
    """An array file with any claim about its shape."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header = header.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def archive(*members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as out:
        for number, member in enumerate(members):
            out.writestr(f"arr_{number}.npy", member)
    return buffer.getvalue()


CLAIMS = {
    "terabytes": npy("(1000000, 1000000)"),
    "overflow": npy("(9223372036854775807, 9223372036854775807)"),
    "negative": npy("(-5,)"),
    "no tuple": npy("'x'"),
    "terabytes in an archive": archive(npy("(1000000, 1000000)")),
    "nothing": b"",
    "no arrays": archive(b"hello"),
}


@pytest.mark.parametrize("content", CLAIMS.values(), ids=CLAIMS)
def test_arrays_that_claim_more_than_there_is(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "array.npy"
    path.write_bytes(content)
    with pytest.raises(ProductError):
        read_file(path)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("escape_hw.array_files.MAX_ARRAY_BYTES", 1_000_000)
    path = tmp_path / "bomb.npz"
    path.write_bytes(archive(npy("(200000,)", bytes(1_600_000))))
    assert path.stat().st_size < 10_000
    with pytest.raises(ProductError, match="would need 2 MB"):
        read_file(path)


def test_a_sparse_product_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "sparse.fits"
    with path.open("wb") as file:
        file.write(b"SIMPLE  =")
        file.truncate(1 << 42)
    with pytest.raises(ProductError, match="larger than"):
        load_matrix(path)
    with pytest.raises(ProductError, match="larger than"):
        load_basis(path)


def spoil(path: Path, extension: str | int, value: object) -> None:
    """Change a product and give it valid checksums."""
    with fits.open(path, memmap=False) as hdus:
        loaded = fits.HDUList([hdu.copy() for hdu in hdus])
    if isinstance(value, tuple):
        loaded[0].header[value[0]] = value[1]
    else:
        data = np.array(loaded[extension].data)
        data.flat[0] = value
        loaded[extension].data = data
    loaded.writeto(path, overwrite=True, checksum=True)


@pytest.mark.parametrize(
    ("extension", "value"),
    [
        (0, ("SCHEMA", "1")), (0, ("SCHEMA", 1.5)), (0, ("NHDU", "9")), (0, ("KIND", 3)),
        (0, ("FRAMES", -3)), (0, ("FRAMES", "many")), (0, ("LOST", -1)),
        ("M2C", np.nan), ("M2C", 1e300), ("GRID", np.nan), ("GRID", 1e30), ("IM", np.nan), ("IM", np.inf),
        ("SIGMA", -1.0),
    ],
)  # fmt: skip
def test_a_product_with_wrong_contents_and_valid_checksums(
    tmp_path: Path, extension: str | int, value: object
) -> None:
    path = save_matrix(tmp_path / "im.fits", fake.calibration("escape", n=6, n_modes=5), fake.ORIGIN)
    spoil(path, 0, ("COMMENT", "unchanged"))
    load_matrix(path)
    spoil(path, extension, value)
    with pytest.raises(ProductError):
        load_matrix(path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (f"devices.dm.limits.disabled={list(range(97))}", "disables every actuator"),
        ("devices.wfs.region=[0,0,1,1]", "is too small for"),
    ],
    ids=["no actuator", "region of one pixel"],
)
def test_a_system_that_cannot_work_is_refused_before_opening(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_system("razor-shwfs", overrides=[override])


@pytest.mark.parametrize(
    ("system", "overrides", "least"),
    [
        ("revolt-shwfs", ("devices.wfs.region=[626,376,352,350]",), "352 x 352"),
        ("revolt-shwfs", ("sensor.pitch_px=22.1",), "353 x 353"),
        # Without a map of the valid sub-apertures those at the rim may be dark.
        ("razor-shwfs", ("devices.wfs.region=[120,56,340,400]",), "341 x 341"),
    ],
)
def test_a_region_without_room_for_the_subapertures_is_refused(
    system: str, overrides: tuple[str, ...], least: str
) -> None:
    with pytest.raises(ConfigError, match=f"is too small for .* needs at least {least} pixels"):
        load_system(system, overrides=overrides)


def test_a_region_needs_no_room_for_subapertures_that_are_not_used(tmp_path: Path) -> None:
    valid = np.zeros((16, 16), int)
    valid[2:14, 1:15] = 1
    np.savetxt(tmp_path / "valid.txt", valid, fmt="%d")
    overrides = [f'sensor.valid="mask:{tmp_path}/valid.txt"', "devices.wfs.region=[600,300,308,264]"]
    assert load_system("revolt-shwfs", overrides=overrides).devices.wfs.region[2:] == (308, 264)
