"""Rendered cameras: a room, a person, a spot, and the sensor that sees them."""
