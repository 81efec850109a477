"""Finding the bright spot in one camera's frames.

`channel.py` reads the configured channel · `background.py` learns the empty scene · `candidates.py` finds compact
bright changes · `profile.py` fits the spot's profile: sub-pixel position with covariance · `advice.py` tells what to
change about the exposure. `nodes.spot_detector.SpotDetector` joins them.
"""
