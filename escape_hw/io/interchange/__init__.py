"""Files and streams of other adaptive-optics software (pyRTC, milk/CACAO, AOT).

Optional packages are imported when they are used; the extra 'interchange' installs them.
"""
