"""Progress bars for terminals and notebooks. Reports and figures are in ``escape_hw.report``."""
