"""From a platform's scanner, tilt unit and IMU to the spots on its beams."""
