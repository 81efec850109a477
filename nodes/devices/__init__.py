"""Cameras and instruments, each behind one seam; their simulated twins stand in `nodes.simulated`."""
