"""What several drivers share.

Loading of vendor libraries, parsing of options, base class and limits of cameras. Nothing of a single vendor,
and no rule that every device obeys: those are in ``escape_hw.api`` and ``escape_hw.safety``.
"""
