"""Simulated twins of the devices, close enough to judge the real programs by."""
