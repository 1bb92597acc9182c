"""Damaged files, by a seeded sequence: each is read or refused with a typed error."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from escape_hw.config.bundled import bundled_text
from escape_hw.config.loader import load_text
from escape_hw.errors import EscapeError
from escape_hw.io.interchange.pyrtc.files import read_file

SEED, NUMBER = 17, 150


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, overwritten, repeated, or with a stretch of noise."""
    data, where = bytearray(content), int(rng.integers(len(content)))
    length = int(rng.integers(1, 40))
    match rng.integers(4):
        case 0:
            return bytes(data[:where])
        case 1:
            data[where : where + length] = rng.bytes(length)
        case 2:
            data[where:where] = data[where : where + length]
        case _:
            data[where] ^= 1 << int(rng.integers(8))
    return bytes(data)


def archive() -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, data=np.arange(50.0), other=np.eye(3))
    return buffer.getvalue()


def array() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.arange(50.0))
    return buffer.getvalue()


def read_toml(path: Path) -> None:
    load_text(path.read_bytes().decode("latin-1"))


@pytest.mark.parametrize(
    ("content", "read"),
    [(bundled_text("razor-shwfs").encode(), read_toml), (archive(), read_file), (array(), read_file)],
    ids=["system", "archive", "array"],
)
def test_damaged_files(tmp_path: Path, content: bytes, read: Callable[[Path], object]) -> None:
    rng = np.random.default_rng(SEED)
    refused = 0
    for number in range(NUMBER):
        path = tmp_path / f"{number}.file"
        path.write_bytes(damage(content, rng))
        try:
            read(path)
        except EscapeError:
            refused += 1
    assert refused > NUMBER // 10
