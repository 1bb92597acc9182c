"""Matrices in text, NumPy and FITS files, in any order, orientation and unit, become products."""

from __future__ import annotations

import gzip
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from shared_data import shared_data

from escape_hw.config import layouts
from escape_hw.errors import ConfigError, EscapeError, IncompatibleProduct, ProductError
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.io.interchange.arrays import (
    ActuatorTable,
    ArrayDescription,
    ArrayTarget,
    actuator_order,
    import_arrays,
    read_description,
)

CIRCLE = layouts.layout_map("circle-5")
TARGET = ArrayTarget("bench", False, 6, 21, CIRCLE, 10.0, (64, 64))
#: Valid lenslets, not symmetric, on a grid smaller than the system's.
MASK = np.array([[0, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0], [0, 1, 0, 0]], bool)
N = int(MASK.sum())
DATA = np.random.default_rng(1).normal(size=(2 * N, 21))


def describe(**tables):
    return ArrayDescription.model_validate({"matrix": {}, "sensor": {"valid": "mask.txt"}, **tables})


@pytest.fixture
def folder(tmp_path):
    np.savetxt(tmp_path / "mask.txt", MASK, fmt="%d")
    return tmp_path


def write(path, array):
    """An array in the format that the name says."""
    buffer = io.BytesIO()
    kind = path.name.removesuffix(".gz").rpartition(".")[2]
    if kind == "npy":
        np.save(buffer, array)
    elif kind == "npz":
        np.savez(buffer, other=np.zeros(3), im=array)
    elif kind == "fits":
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(array, name="IM")]).writeto(buffer)
    else:
        np.savetxt(buffer, array, header="a comment")
    content = buffer.getvalue()
    path.write_bytes(gzip.compress(content) if path.name.endswith(".gz") else content)
    return path


def maps(data):
    out = np.zeros((21, 2, *MASK.shape))
    out[:, :, MASK] = data.reshape(2, N, 21).transpose(2, 0, 1)
    return out


@pytest.mark.parametrize(
    "name", ["im.npy", "im.npz", "im.fits", "im.txt", "im.npy.gz", "im.txt.gz", "im.fits.gz"]
)
def test_every_format_gives_the_same_matrix(folder, name):
    write(folder / name, DATA)
    table = {"file": name, "array": "im" if "npz" in name else "", "scale": 2.0, "sigma": 0.1}
    result = import_arrays(describe(matrix=table), folder, TARGET)
    assert result.matrix.data == pytest.approx(2 * DATA, rel=1e-6)
    assert result.matrix.sigma == pytest.approx(0.2)
    assert np.array_equal(result.matrix.m2c, np.eye(21))
    assert np.array_equal(result.grid.valid[1:-1, 1:-1], MASK)
    assert result.grid.valid.shape == (6, 6)
    assert not result.matrix.simulated
    for stated in (True, False):
        real = import_arrays(
            describe(matrix={**table, "simulated": stated}), folder, replace(TARGET, simulated=not stated)
        )
        assert real.matrix.simulated is stated


@pytest.mark.parametrize(
    ("order", "slopes", "array"),
    [
        ("commands-slopes", "x-y", DATA.T),
        ("slopes-commands", "y-x", np.concatenate([DATA[N:], DATA[:N]])),
        ("slopes-commands", "xy-pairs", DATA.reshape(2, N, 21).swapaxes(0, 1).reshape(2 * N, 21)),
        ("maps-beside", "x-y", np.concatenate([maps(DATA)[:, 0], maps(DATA)[:, 1]], axis=2)),
        ("maps-above", "x-y", np.concatenate([maps(DATA)[:, 0], maps(DATA)[:, 1]], axis=1)),
    ],
)
def test_every_order_gives_the_same_matrix(folder, order, slopes, array):
    write(folder / "im.npy", array)
    tables = {"matrix": {"order": order, "slopes": slopes}}
    result = import_arrays(describe(**tables), folder, TARGET, folder / "im.npy")
    assert result.matrix.data == pytest.approx(DATA, rel=1e-6)
    if order.startswith("maps"):
        tables["sensor"] = {"valid": "nonzero"}
        again = import_arrays(describe(**tables), folder, TARGET, folder / "im.npy")
        assert np.array_equal(again.matrix.data, result.matrix.data)


def test_a_mask_may_be_given_for_x_and_y(folder):
    write(folder / "im.npy", DATA)
    for two in (np.concatenate([MASK, MASK]), np.concatenate([MASK, MASK], axis=1)):
        np.save(folder / "two.npy", two)
        description = describe(matrix={"file": "im.npy"}, sensor={"valid": "two.npy"})
        assert import_arrays(description, folder, TARGET).matrix.data == pytest.approx(DATA, rel=1e-6)
    np.save(folder / "two.npy", np.concatenate([MASK, ~MASK]))
    with pytest.raises(IncompatibleProduct, match="masks for x and y differ"):
        import_arrays(description, folder, TARGET)


def test_camera_flips_turn_mask_and_slopes(folder):
    write(folder / "im.npy", DATA)
    flips = {"valid": "mask.txt", "transpose": True, "flip_y": True, "sign_x": -1}
    found = import_arrays(describe(matrix={"file": "im.npy"}, sensor=flips), folder, TARGET)
    expected = MASK.T[::-1]
    assert np.array_equal(found.grid.valid[1:-1, 1:-1], expected)
    # Row r, column c of the system is column 3 - r, row c of the file; x and y are exchanged.
    x, y = maps(DATA).swapaxes(0, 1)
    rows, columns = np.nonzero(expected)
    want_x, want_y = -y[:, columns, 3 - rows].T, -x[:, columns, 3 - rows].T
    assert found.matrix.data == pytest.approx(np.concatenate([want_x, want_y]), rel=1e-6)


def test_actuators_are_renumbered(folder):
    order = np.random.default_rng(2).permutation(21)
    write(folder / "im.npy", DATA)
    for given in (order.tolist(), "order.txt"):
        np.savetxt(folder / "order.txt", order, fmt="%d")
        description = describe(matrix={"file": "im.npy"}, actuators={"order": given, "sign": -1})
        data = import_arrays(description, folder, TARGET).matrix.data
        assert data[:, order] == pytest.approx(-DATA, rel=1e-6)


@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize("flip_x", [False, True])
@pytest.mark.parametrize("flip_y", [False, True])
def test_flips_of_the_actuators_grid(transpose, flip_x, flip_y):
    layout = layouts.layout_map("map:0111/1111/1110/0100")
    target = ArrayTarget("bench", False, 6, int(layout.sum()), layout, 10.0, (64, 64))
    table = ActuatorTable(transpose=transpose, flip_x=flip_x, flip_y=flip_y)
    order = actuator_order(table, target)
    # The file's map, turned as the table says, has ESCAPE's numbers in row-major order.
    rows, columns = np.nonzero(layout)
    theirs = layout[:, ::-1] if flip_x else layout
    theirs = theirs[::-1] if flip_y else theirs
    theirs = theirs.T if transpose else theirs
    number = np.full(theirs.shape, -1)
    number[theirs] = order
    turned = number.T if transpose else number
    turned = turned[:, ::-1] if flip_x else turned
    turned = turned[::-1] if flip_y else turned
    assert np.array_equal(turned[rows, columns], np.arange(target.n_act))


def test_the_numbering_of_a_real_mirror_is_a_turned_grid():
    stated = json.loads((shared_data("dm97") / "dm97.json").read_text())["matrix"]["escape_order"]
    target = ArrayTarget("bench", False, 31, 97, layouts.layout_map("circle-11"), 54.5, (2048, 2048))
    order = actuator_order(ActuatorTable(transpose=True, flip_x=True, flip_y=True), target)
    assert order.tolist() == stated


def test_a_modal_matrix_has_its_modes(folder):
    m2c = np.random.default_rng(3).normal(size=(21, 5))
    order = np.random.default_rng(4).permutation(21)
    write(folder / "im.npy", DATA @ m2c)
    for given in (m2c, m2c.T):
        write(folder / "m2c.fits", given)
        tables = {"actuators": {"order": order.tolist()}, "modes": {"file": "m2c.fits"}}
        matrix = import_arrays(describe(matrix={"file": "im.npy"}, **tables), folder, TARGET).matrix
        assert matrix.data == pytest.approx(DATA @ m2c, rel=1e-5)
        assert matrix.m2c[order] == pytest.approx(m2c)


@pytest.mark.parametrize(
    ("tables", "error", "text"),
    [
        ({"matrix": {}}, ConfigError, "matrix.file .* is empty"),
        ({"matrix": {"file": "no.npy"}}, ProductError, "no.npy: cannot be read .No such file"),
        ({"matrix": {"file": "mask.txt"}}, IncompatibleProduct, "4 slopes for 11 valid sub-apertures"),
        (
            {"matrix": {"file": "im.npy", "order": "commands-slopes"}},
            IncompatibleProduct,
            "21 slopes for 11 .*ord",
        ),
        ({"matrix": {"file": "im.npy", "order": "maps-above"}}, IncompatibleProduct, "needs 3 axes"),
        ({"matrix": {"file": "nan.npy"}}, IncompatibleProduct, "1 of 462 elements are not finite"),
        ({"sensor": {"valid": "nonzero"}}, IncompatibleProduct, "needs maps of slopes"),
        ({"actuators": {"order": [0, 1]}}, IncompatibleProduct, "has 2 numbers; the 21 actuators"),
        ({"actuators": {"order": [0] * 21, "flip_x": True}}, ConfigError, "remove transpose"),
        (
            {"modes": {"file": "mask.txt"}},
            IncompatibleProduct,
            r"shape \(4, 4\); 21 actuators and the 21 modes",
        ),
        ({"matrix": {"file": "im.npy", "scale": 0.0}}, IncompatibleProduct, "matrix.scale = 0; slopes must"),
        (
            {"matrix": {"file": "im.npy", "scale": 1e300}},
            IncompatibleProduct,
            "matrix.scale = 1e.300; slopes",
        ),
        ({"matrix": {"file": "zero.npy"}}, IncompatibleProduct, "largest element 0, times matrix.scale = 1;"),
        ({"matrix": {"file": "complex.npy"}}, IncompatibleProduct, "elements of type complex128; save real"),
        ({"modes": {"file": "complex.npy"}}, IncompatibleProduct, "elements of type complex128; save real"),
        (
            {"matrix": {"file": "several.npz"}},
            IncompatibleProduct,
            "arrays other, im: name one with matrix.array",
        ),
        (
            {"modes": {"file": "several.npz"}},
            IncompatibleProduct,
            "arrays other, im: name one with modes.array",
        ),
        ({"sensor": {"valid": "several.npz"}}, IncompatibleProduct, "arrays other, im: save the mask alone"),
        (
            {"actuators": {"order": "between.txt"}},
            IncompatibleProduct,
            "need each whole number of 0 to 20 once",
        ),
    ],
)
def test_what_does_not_fit_is_refused(folder, tables, error, text):
    write(folder / "im.npy", DATA)
    write(folder / "nan.npy", np.where(np.arange(DATA.size).reshape(DATA.shape) == 5, np.nan, DATA))
    write(folder / "zero.npy", 0 * DATA)
    write(folder / "complex.npy", DATA + 1j)
    write(folder / "several.npz", DATA)
    np.savetxt(folder / "between.txt", np.arange(21) + 0.4)
    with pytest.raises(error, match=text):
        import_arrays(describe(**{"matrix": {"file": "im.npy"}, **tables}), folder, TARGET)


def test_a_larger_mask_is_cut_where_nothing_is_valid(folder):
    np.savetxt(folder / "wide.txt", np.pad(MASK, 3), fmt="%d")
    write(folder / "im.npy", DATA)
    description = describe(matrix={"file": "im.npy"}, sensor={"valid": "wide.txt"})
    found = import_arrays(description, folder, TARGET)
    assert np.array_equal(found.grid.valid, np.pad(MASK, 1))
    assert found.matrix.data == pytest.approx(DATA, rel=1e-6)
    for n_sub in (2, 9):  # valid ones are outside; one row more on one side than on the other
        with pytest.raises(IncompatibleProduct, match="10 x 10 sub-apertures cannot be centred"):
            import_arrays(description, folder, replace(TARGET, n_sub=n_sub))


def test_a_mask_must_fit_the_system(folder):
    write(folder / "im.npy", DATA)
    target = ArrayTarget("bench", False, 5, 21, CIRCLE, 10.0, (64, 64))
    with pytest.raises(IncompatibleProduct, match=r"4 x 4 sub-apertures cannot .* = 5; correct"):
        import_arrays(describe(matrix={"file": "im.npy"}), folder, target)


def test_a_wrong_description_names_its_keys(tmp_path):
    path = tmp_path / "im.toml"
    path.write_text('[matrix]\nordr = 1\nvalid = "m"\nslopes = "x"\n[sensor]\nflip_x = 1\n[sensr]\n')
    with pytest.raises(ConfigError) as caught:
        read_description(path)
    text = str(caught.value)
    for key in (
        "matrix.ordr: unknown key (did you mean 'matrix.order'?)",
        "matrix.valid: unknown key (did you mean 'sensor.valid'?)",
        "sensr: unknown key (did you mean 'sensor'?)",
        "matrix.slopes: input should be 'x-y'",
        "sensor.valid: field required",
        "sensor.flip_x: input should be a valid boolean, not 1",
    ):
        assert key in text
    with pytest.raises(ConfigError, match=r"cannot be read .No such file"):
        read_description(tmp_path / "none.toml")


def test_the_command_writes_a_product(folder, document, escape):
    data = np.random.default_rng(5).normal(size=(2 * 24 * 24, 97))
    write(folder / "im.npy", data)
    np.save(folder / "mask.npy", np.ones((24, 24), bool))
    path = folder / "im.toml"
    path.write_text('[matrix]\nfile = "im.npy"\nmethod = "push-pull"\n[sensor]\nvalid = "mask.npy"\n')
    code, found, err = document("import", "arrays", path, "razor-shwfs", "--out", folder / "im.fits")
    assert code == 0, err
    product = load_matrix(folder / "im.fits", expect_system="razor-shwfs", expect_actuators=97)
    assert product.matrix.data == pytest.approx(data, rel=1e-6)
    assert product.matrix.method == "push-pull"
    assert product.matrix.simulated, "as the system"
    assert found["products"]["im"] == str(folder / "im.fits")
    assert {"im.toml", "im.npy", "mask.npy"} <= {
        value for key, value in product.header.items() if key.startswith("PARENT")
    }
    path.write_text('[matrix]\nfile = "im.npy"\n')
    code, _, err = escape("import", "arrays", path, "razor-shwfs", "--out", folder / "x.fits")
    assert code == EscapeError.exit_code or code == 2
    assert "sensor: field required" in err
