"""Emulated devices that answer on their own wire (TCP, serial line, USB), with faults by script; `escape emulate`. C libraries of vendors are replaced in stand_ins/."""
