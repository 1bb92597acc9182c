"""Layout of milk's images: offsets printed by its library, and images with this layout."""

from __future__ import annotations

import stat
from pathlib import Path

import numpy as np
import pytest

from escape_hw.errors import ProductError
from escape_hw.io.interchange.milk import layout
from escape_hw.io.interchange.milk.stream import MilkStream

PLAIN, CIRCULAR = 0x2, 0x20001

#: Images by the shape, type, keywords, kind, copies and semaphores they were made with.
IMAGES = {
    "bytes": ((3,), "u1", 0, PLAIN, 0, 10),
    "frame": ((5, 7), "u2", 3, PLAIN, 0, 10),
    "ring": ((5, 7), "u2", 3, PLAIN, 4, 9),
    "cube": ((4, 3, 2), "f4", 0, PLAIN, 0, 10),
    "slices": ((5, 3, 3), "u2", 1, CIRCULAR, 2, 10),
}

#: Pointers minus the start of the file, and its size, from a program that linked the library: data,
#: semaphores, the loggers' one, readers, writers, traces; stamps, counters and copies where there are any;
#: size. Of 2.01 (1a88d3ae), the same without rounding (01b29394), and compiled with DAO_COMPAT.
PRINTED = {
    "aligned": {
        "bytes": (384, 392, 712, 744, 784, 904, None, None, None, None, 1544),
        "frame": (384, 840, 1160, 1192, 1232, 1352, None, None, None, None, 1992),
        "ring": (384, 840, 1128, 1160, 1200, 1320, None, None, None, 2152, 2432),
        "cube": (384, 480, 800, 832, 872, 992, None, None, None, None, 1632),
        "slices": (384, 608, 928, 960, 1000, 1120, 1760, 1840, 1920, 2056, 2240),
    },
    "packed": {
        "bytes": (384, 387, 707, 739, 779, 899, None, None, None, None, 1539),
        "frame": (384, 838, 1158, 1190, 1230, 1350, None, None, None, None, 1990),
        "ring": (384, 838, 1126, 1158, 1194, 1302, None, None, None, 2134, 2414),
        "cube": (384, 480, 800, 832, 872, 992, None, None, None, None, 1632),
        "slices": (384, 602, 922, 954, 994, 1114, 1754, 1834, 1914, 2050, 2230),
    },
    "dao": {
        "bytes": (4496, 4504, 4824, 4856, 4896, 5016, None, None, None, None, 5656),
        "frame": (4496, 4952, 5272, 5304, 5344, 5464, None, None, None, None, 6104),
        "ring": (4496, 4952, 5240, 5272, 5312, 5432, None, None, None, 6264, 6544),
        "cube": (4496, 4592, 4912, 4944, 4984, 5104, None, None, None, None, 5744),
        "slices": (4496, 4720, 5040, 5072, 5112, 5232, 5872, 5952, 6032, 6168, 6352),
    },
}
FIELDS = tuple(layout.Sections.__dataclass_fields__)


def head_of(image: str) -> layout.Metadata:
    """Its metadata."""
    shape, dtype, keywords, kind, ring, semaphores = IMAGES[image]
    head = layout.build_metadata(image, shape, dtype, "2.01")
    head.n_keywords, head.imagetype, head.ring_size, head.sem = keywords, kind, ring, semaphores
    return head


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("release", PRINTED)
@pytest.mark.parametrize("image", IMAGES)
def test_sections_lie_where_the_library_said(release: str, image: str) -> None:
    printed = dict(zip(FIELDS, PRINTED[release][image], strict=True))
    found = layout.detect_sections(head_of(image), PRINTED[release][image][-1])
    assert found is not None
    for field, at in printed.items():
        if at is not None:
            assert getattr(found, field) == at, field


@pytest.mark.parametrize("image", IMAGES)
@pytest.mark.parametrize("release", PRINTED)
def test_images_of_every_layout_are_read_and_written(folder: Path, release: str, image: str) -> None:
    file, size = layout.shm_path(image), PRINTED[release][image][-1]
    file.write_bytes(bytes(head_of(image)).ljust(size, b"\0"))
    found = layout.detect_sections(head_of(image), size)
    assert found is not None
    shape, dtype, _, kind, ring, _ = IMAGES[image]
    frame, n = (shape[1:], shape[0]) if kind == CIRCULAR else (shape, 1)
    stream = MilkStream.open(image)
    try:
        assert stream.shape == frame
        for number in range(1, 8):
            data = np.full(frame, number, dtype)
            stream.write(data)
            newest = stream.latest()
            assert newest.count == number
            np.testing.assert_array_equal(newest.data, data)
            place, raw = number % n, file.read_bytes()
            assert raw[found.data + data.nbytes * place :][: data.nbytes] == data.tobytes()
            if kind == CIRCULAR:
                assert stream._head.cnt1 == place
                assert int.from_bytes(raw[found.counts + 8 * place :][:8], "little") == number
            if ring:
                copied = raw[found.ring + data.nbytes * n * (number % ring) :][: data.nbytes * n]
                assert copied == raw[found.data :][: data.nbytes * n]
    finally:
        stream.close()


@pytest.mark.parametrize("version", ["foo", "1.00", "2.000", ""])
def test_another_version_is_not_written(folder: Path, version: str) -> None:
    with pytest.raises(ValueError, match=f"layout '{version}': versions 2.00 to 2.99"):
        MilkStream.create("one", (5, 7), "u2", version=version)
    assert not list(folder.iterdir())


def test_a_file_of_another_size_is_refused(folder: Path) -> None:
    path = layout.shm_path("frame")
    path.write_bytes(bytes(head_of("frame")).ljust(2000, b"\0"))
    with pytest.raises(ProductError, match="its 2000 bytes fit no layout"):
        MilkStream.open("frame")


def test_an_image_of_ours_is_writable_by_all_and_complete_at_once(folder: Path) -> None:
    before = MilkStream.create("one", (5, 7), "u2")
    after = MilkStream.create("one", (4, 3, 2), "f4")
    try:
        assert [path.name for path in folder.iterdir()] == ["one.im.shm"]
        path = layout.shm_path("one")
        assert stat.S_IMODE(path.stat().st_mode) == 0o666
        assert path.stat().st_size == PRINTED["aligned"]["cube"][-1], "a cube without stamps has none"
        before.write(np.ones((5, 7)))
        assert after.count == 0
    finally:
        before.close()
        after.close()
