"""Stand-ins of the vendors' C libraries: compiled on demand, strict, with faults by script.

A driver is tested through its real path, down to the C calls, by giving it a stand-in's file where the
vendor's library would be.
"""

from escape_sim.stand_ins.build import LIBRARIES, StandInUnavailable, build
from escape_sim.stand_ins.control import StandIn

__all__ = ["LIBRARIES", "StandIn", "StandInUnavailable", "build"]
