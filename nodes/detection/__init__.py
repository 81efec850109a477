"""Finding the bright spot in one camera's frames.

A frame's way: `channel_choice.py` votes for a channel, `channel.py` reads it · `channel_watch.py` holds what is known
of one channel: `background.py` and `background_learner.py` the empty scene, `silhouettes.py` people before bright
walls · `peaks.py` and `candidates.py` find compact bright changes · `profile.py` (models, start, fit, misfit beside
it) gives a candidate's sub-pixel position with covariance · `ranking.py`, `dwelling.py` and `fixtures.py` judge which
one is the spot · `advice.py` tells what to change about the exposure. `nodes.spot_detector.SpotDetector` joins them.
"""
