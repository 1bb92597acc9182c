"""Adapters to the packages that ESCAPE is compared with: pyRTC, OOPAO, SPECULA. No measurements."""
