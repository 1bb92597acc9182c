"""Tables, figures and ``report.html`` of one run folder.

Tables and figures of the paper are in ``escape_hw.paper``.
"""
