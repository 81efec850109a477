"""Mathematics of the laser range finders (LRFs) in a network of calibrated cameras.

Takes arrays and gives frozen results, without files, bus, devices or plots. Imports `network_calib`, never the
reverse. Axes of an LRF: x forward, y left, z up; a tilt angle above zero turns the forward axis down.
"""
