"""Stand-ins of vendors' C libraries (ALPAO, XIMEA, Aravis), compiled on demand, with scripted faults.

A server connects them to a simulated bench.
"""

from escape_sim.stand_ins.library import LIBRARIES, StandIn, StandInUnavailable, build_library

__all__ = ["LIBRARIES", "StandIn", "StandInUnavailable", "build_library"]
