"""Everything of spotcal that runs: the command line, configuration, reports, devices and the bus.

Imports `lrf_stereo` and `network_calib`; neither of them imports this package. Heavy libraries are imported inside the
functions that use them, so that the command line answers at once.
"""
