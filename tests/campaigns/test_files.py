"""Damaged and crafted files through the readers and ``escape show``: read, or refused with a typed error."""

from __future__ import annotations

import contextlib
import io
import random
from collections.abc import Callable
from pathlib import Path

import fake_results as fake
import numpy as np
import pytest
from astropy.io import fits
from campaign_table import Campaign
from test_damaged_files import array, damage, read_toml

from escape_hw.cli import main
from escape_hw.config.bundled import bundled_text
from escape_hw.errors import EscapeError
from escape_hw.io.fits.gains import load_gains, save_gains
from escape_hw.io.fits.loop import load_loop, save_loop
from escape_hw.io.fits.matrix import load_basis, load_matrix, save_matrix
from escape_hw.io.interchange.pyrtc.calibration import PyrtcConfig
from escape_hw.io.interchange.pyrtc.files import read_file

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(3000)]

SEED, NUMBER = 1500, 200

YAML = b"""slopes:
  type: SHWFS
  signalType: slopes
  subApSpacing: 15.5
  subApOffsetX: 3
  subApOffsetY: 4
  contrast: 0
loop:
  gain: 0.3
  leakyGain: 0.01
  numDroppedModes: 5
  IMMethod: push-pull
wfs: {width: 128, height: 128}
wfc: {numActuators: 97, numModes: 94, m2cFile: m2c.npy}
"""


def archive() -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, data=np.arange(50.0))
    return buffer.getvalue()


#: Values that replace a card of a header or an element of an array.
CARDS = ("", "x", "T", -1, 0, 3, 10**18, 1.5, -1e300, True, False, "nan", "[[[", "<b>", "9" * 60)
ELEMENTS = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, -1e300, 1e-300, 2**31, 255)


def craft(path: Path, rng: random.Random) -> None:
    """Change the contents of a product, and give it valid checksums."""
    with fits.open(path, memmap=False) as opened:
        hdus = fits.HDUList([hdu.copy() for hdu in opened])
    for _ in range(rng.randint(1, 3)):
        hdu = rng.choice(hdus)
        keys = [key for key in hdu.header if key not in ("", "COMMENT", "HISTORY")]
        match rng.randrange(6):
            case 0:
                hdu.header[rng.choice(keys)] = rng.choice(CARDS)
            case 1:
                hdu.header.remove(rng.choice(keys))
            case 2 if len(hdus) > 1:
                del hdus[rng.randrange(1, len(hdus))]
            case 3:
                hdus.append(rng.choice(hdus[1:] or [fits.ImageHDU()]).copy())
            case 4 if isinstance(hdu, fits.ImageHDU) and hdu.data is not None:
                hdu.data = rng.choice([hdu.data[..., :-1], hdu.data[None], hdu.data.ravel(), hdu.data.T])
            case _ if hdu.data is not None and hdu.data.size and hdu.data.dtype.names is None:
                data = np.array(hdu.data)
                data.flat[rng.randrange(data.size)] = np.array(rng.choice(ELEMENTS)).astype(data.dtype)
                hdu.data = data
            case _ if hdu.data is not None and hdu.data.dtype.names:
                column = hdu.data[rng.choice(hdu.data.dtype.names)]
                if column.size and column.dtype.kind in "fiu":
                    column.flat[rng.randrange(column.size)] = np.array(rng.choice(ELEMENTS)).astype(
                        column.dtype
                    )
    hdus.writeto(path, overwrite=True, checksum=True, output_verify="ignore")


def save_matrix_product(path: Path) -> Path:
    return save_matrix(path, fake.calibration("escape", n=6, n_modes=5), fake.ORIGIN)


def save_loop_product(path: Path) -> Path:
    return save_loop(path, fake.loop(), "razor-shwfs", True)


def save_gains_product(path: Path) -> Path:
    return save_gains(path, fake.gains_result(), "razor-shwfs", True)


PRODUCTS: dict[str, tuple[Callable[[Path], Path], tuple[Callable[[Path], object], ...]]] = {
    "matrices": (save_matrix_product, (load_matrix, load_basis)),
    "loops": (save_loop_product, (load_loop,)),
    "gains": (save_gains_product, (load_gains,)),
}


def attempt(campaign: Campaign, what: str, read: Callable[[], object]) -> None:
    """Read, and count the outcome."""
    try:
        read()
    except EscapeError as error:
        if not str(error).strip():
            campaign.fail(f"{what}: no message")
        campaign.count("refused")
    except Exception as error:
        campaign.fail(f"{what}: {type(error).__name__}: {str(error)[:200]}")
    else:
        campaign.count("read")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", PRODUCTS)
def test_products(campaign: Campaign, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    save, readers = PRODUCTS[kind]
    good = save(tmp_path / "good.fits").read_bytes()
    rng, noise = random.Random(SEED), np.random.default_rng(SEED)
    for number in range(NUMBER):
        path = tmp_path / "tried.fits"
        if number % 2:
            path.write_bytes(damage(good, noise))
        else:
            path.write_bytes(good)
            # Astropy does not write everything; what it wrote is read.
            with contextlib.suppress(Exception):
                craft(path, rng)
        what = f"{kind} {number}"
        for read in readers:
            attempt(campaign, what, lambda read=read, path=path: read(path))
        show(campaign, what, path, capsys)
    campaign.end(f"products of {kind}: bytes damaged, or contents changed under valid checksums")


def show(campaign: Campaign, what: str, path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``escape show`` of a file."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["show", str(path)])
    out, err = capsys.readouterr()
    code = ended.value.code or 0
    if code not in (0, 2) or "Traceback" in out + err:
        campaign.fail(f"escape show, {what}: exit code {code}: {err[-400:]}")
    else:
        campaign.count("refused" if code else "read")


FILES: dict[str, tuple[bytes, Callable[[Path], object]]] = {
    "system files (TOML)": (bundled_text("razor-shwfs").encode(), read_toml),
    "pyRTC's configurations (YAML)": (YAML, PyrtcConfig.read),
    "archives of arrays (npz)": (archive(), read_file),
    "arrays (npy)": (array(), read_file),
}


@pytest.mark.parametrize("kind", FILES)
def test_other_files(campaign: Campaign, tmp_path: Path, kind: str) -> None:
    content, read = FILES[kind]
    noise = np.random.default_rng(SEED)
    for number in range(2 * NUMBER):
        path = tmp_path / "tried"
        tried = content
        for _ in range(noise.integers(1, 4)):
            tried = damage(tried, noise) if tried else tried
        path.write_bytes(tried)
        attempt(campaign, f"{kind} {number}", lambda path=path: read(path))
    campaign.end(f"{kind}: bytes damaged")
