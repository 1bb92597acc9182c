"""One module per procedure, from the declared parameters to the saved result, and what the modules share.

``declaration`` defines how a procedure is declared, ``registry`` lists all of them, ``python_method`` derives
methods, ``criteria`` and ``products`` assess and save results. The algorithms are in
``escape_hw.calibration``.
"""
