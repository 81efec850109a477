"""Commented examples of site.toml, camera.toml and lrf.toml, complete and valid: what `spotcal init` writes."""

from __future__ import annotations

from enum import StrEnum


class Example(StrEnum):
    """Which file."""

    SITE = "site"
    CAMERA = "camera"
    LRF = "lrf"


_SITE = """\
# A site: its rooms' cameras and LRFs, and how a session goes. For `spotcal coordinator --config site.toml`.
# Paths are meant from the folder of this file. What is commented out shows the default, or an example.

name = "lab"                            # first part of every key on the bus; each node's file says the same
router = ["tcp/127.0.0.1:7447"]         # addresses of `spotcal router`; the first that answers is taken
data = "sessions"                       # folder that gets a folder for each session

# Certificates (PEM files), needed where the bus leaves one machine; then router = ["tls/host:7447"].
# [tls]
# ca = "certificates/ca.pem"
# certificate = "certificates/coordinator.pem"
# key = "certificates/coordinator.key"

# The nodes that are expected: a session tells which of them is missing. Others may join at any time.
[[nodes]]
name = "door"
role = "camera"

[[nodes]]
name = "lrf"
role = "lrf"

# The cameras, by the names that their nodes give them. What is known of the lens helps; nothing need be known.
[[cameras]]
name = "C0"
size = [1280, 720]                      # width, height in px
# lens = "k1_k2_p1_p2"                  # none, k1, k1_k2, k1_k2_p1_p2 or fisheye
# intrinsics = "initial"                # unknown, initial (a start, with sigma) or fixed
# focal = [910.0, 910.0]                # px
# centre = [639.5, 359.5]               # px; the centre of the top-left pixel is (0, 0)
# distortion = [0.0, 0.0, 0.0, 0.0]     # as many numbers as the lens has terms
# sigma = { focal = 20.0, centre = 10.0, distortion = 0.1 }

[[cameras]]
name = "C1"
size = [1280, 720]

# The LRFs, and what each may be wrong by (one standard deviation; 0 holds it at its nominal value).
[[lrfs]]
name = "L0"
# sigma = { range_bias_m = 0.01, bearing_zero_deg = 0.1, clock_offset_ms = 2.0 }

# Where metres and the world's frame come from; here the measured distance of two cameras.
[anchor]
kind = "distance"                       # stereo, distance, centres, points or none
cameras = ["C0", "C1"]
distance_m = 4.0
sigma_m = 0.002

[session]
background_s = 4.0                      # of the empty room, at the beginning
target_sigma_mm = 2.0                   # waving is enough when every camera's centre is known to this
min_waving_s = 20.0
max_waving_s = 600.0
tilts_deg = [2.0, 12.0, 23.0]           # of every LRF
crossings = 12                          # of the scan plane at every tilt

# [options]                             # how to solve; the defaults suit
# rejection = 4.0
"""

_CAMERA = """\
# A camera node: watches one or several cameras beside it. For `spotcal camera --config camera.toml`.
# Paths are meant from the folder of this file. What is commented out shows the default, or an example.

node = "door"                           # no other node of the site has this name
site = "lab"                            # as in site.toml
router = ["tcp/127.0.0.1:7447"]         # the first that answers is taken; the node may start before it
journal = "door.journal"                # what was observed is kept here until the coordinator surely has it
# batch_ms = 80.0                       # frames of so long travel together

# Certificates (PEM files), needed where the bus leaves one machine; then router = ["tls/host:7447"].
# [tls]
# ca = "certificates/ca.pem"
# certificate = "certificates/door.pem"
# key = "certificates/door.key"

[[cameras]]
name = "C0"                             # as in site.toml
source = "/dev/video0"
# size = [1280, 720]                    # of /dev/video: to ask for
# rate_hz = 30.0                        # likewise
# channel = "auto"                      # the light of the pointer: auto, red, green, blue or luma
# mask = "door-mask.png"                # black where no spot may be, such as windows; of the pictures' size
# n_learning = 50                       # frames of the empty room from which the background is learnt
# max_candidates = 4                    # spots kept of each frame
# exposure_ms = 5.0                     # where the camera does not tell it; only for advice

# A network camera. Its password stands elsewhere, never in this file: ${DOOR_PASSWORD} is an environment variable,
# ${file:/etc/spotcal/door-password} the first line of a file that only this node's user can read.
# [[cameras]]
# name = "C1"
# source = "rtsp://viewer:${DOOR_PASSWORD}@192.168.1.20:554/stream1"
"""

_LRF = """\
# An LRF node: a scanner on a tilt unit, with an IMU. For `spotcal lrf --config lrf.toml`.
# Paths are meant from the folder of this file. What is commented out shows the default, or an example.

node = "lrf"                            # no other node of the site has this name
site = "lab"                            # as in site.toml
router = ["tcp/127.0.0.1:7447"]         # the first that answers is taken; the node may start before it
journal = "lrf.journal"                 # what was observed is kept here until the coordinator surely has it

# Certificates (PEM files), needed where the bus leaves one machine; then router = ["tls/host:7447"].
# [tls]
# ca = "certificates/ca.pem"
# certificate = "certificates/lrf.pem"
# key = "certificates/lrf.key"

[lrf]
name = "L0"                             # as in site.toml
scanner = "/dev/ttyACM0"                # or tcp://host:port; `spotcal devices` tells what is where
tilt_unit = "/dev/ttyUSB0"              # leave it out where somebody tilts the LRF by hand
imu = "/dev/ttyUSB1"                    # leave it out where there is none
# axis = [0.0, 1.0, 0.0]                # the tilt axis in the IMU's axes
# tilt_sign = -1                        # 1 where the tilt unit hangs upside down
# zero_steps = 0                        # position of the tilt unit that is called tilt zero
# tilts_deg = [2.0, 12.0, 23.0]         # where the coordinator names none
# crossings = 12                        # of the scan plane at every tilt, at least
# max_crossings = 60                    # enough, whatever the accuracy
# plane_sigma_mm = 4.0                  # so many crossings that the scan plane is known to this
# rest_s = 3.0                          # at rest before the empty room is learnt
# n_background = 20                     # scans of the empty room
# ball_mm = 40.0                        # diameter of the spot
"""

_TEXTS = {Example.SITE: _SITE, Example.CAMERA: _CAMERA, Example.LRF: _LRF}


def example(which: Example) -> str:
    """The text of a file."""
    return _TEXTS[which]
