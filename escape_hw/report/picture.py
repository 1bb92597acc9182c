"""One picture of a run, for a slide or a page: matrices beside the images they lead to."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from escape_hw.errors import ProductError
from escape_hw.io.storage import write_atomic
from escape_hw.report import figures_bench, figures_matrix, style
from escape_hw.report.content import RunContent, read_run

#: Modes shown.
_MODES = 5


def write_picture(folder: Path | str, path: Path) -> Path:
    """Draw the picture of a run folder as PNG.

    Parameters
    ----------
    folder
        A run with at least one matrix and one closed loop, such as ``escape reproduce`` leaves.
    path
        File to write.

    Raises
    ------
    ProductError
        Not a run folder, damaged, or without matrix or image.
    StorageError
        The picture cannot be written.
    """
    run = read_run(folder)
    write_atomic(path, style.png(draw(run), dpi=130))
    return path


def draw(run: RunContent) -> Figure:
    """The picture as a figure; see :func:`write_picture`."""
    matrices = run.matrices()
    if not matrices or not any(loop.psf is not None for loop in run.loops.values()):
        raise ProductError(f"{run.folder}: holds no matrix or no closed-loop image to draw")
    left = 1.0 + 2.15 * len(matrices)
    figure = style.new_figure(left + 5.3, 6.2)
    about = f"{run.document['system']}, {'SIMULATED' if run.simulated else 'hardware'}"
    figure.suptitle(about, x=0.01, ha="left", color=style.MUTED, fontsize=9)
    parts = figure.subfigures(1, 2, squeeze=False, width_ratios=[left, 5.3], wspace=0.02)[0]
    for part, title in zip(parts, ("Interaction matrices", "Closed-loop images"), strict=True):
        part.set_facecolor("none")
        part.suptitle(title, color=style.INK, fontsize=12, fontweight="bold")
    figures_matrix.draw_mode_maps(parts[0], matrices, _MODES)
    figures_bench.draw_psfs(parts[1], run.loops, run.psf_px, rows=2)
    return figure
