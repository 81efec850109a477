"""Sessions of simulated rooms, written as a real one is, with their truth."""
