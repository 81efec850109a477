"""Mathematics of the camera network: arrays in, frozen results out. No network, threads or plots.

The method is that of Svoboda, Martinec, Pajdla, "A Convenient Multi-Camera Self-Calibration for Virtual Environments",
Presence 14(4), 2005, finished by a joint maximum-likelihood solve. File by step:

    1  pairwise epipolar verification, overlap graph        pairs.py (epipolar.py)
    2  projective depths, filling of missing points         depths.py
       rank-4 factorisation (Martinec, Pajdla 2002)         factorise.py
    3  Euclidean upgrade by the absolute dual quadric        metric_upgrade.py; 1-3 together: svoboda_start.py
    4  the other start: growth from the stereo anchor       anchor.py (focal_ratios.py, seed_pair.py, resection.py)
    5  the joint least-squares engine                       bundle.py (blocks, chunks, linearisation, schur)
       its camera blocks                                    camera_block.py, camera_parameters.py, priors.py
    6  outlier rounds, noise of each camera                 refine.py (spots.py, triangulate.py)
    7  scale, world frame, named gauge                      world.py (gauge.py)
    +  quality: hold-out, covariance, doubts, refusals      quality.py, sync.py, doubts.py, refusals.py, evaluate.py

`calibrate.py` is the list of these steps. What a finished calibration says of pixels, rays and points: `rays.py`.

Deliberate deviations from the paper, with the reason:
    - every frame seen by two cameras is used, not only those seen by three or by all: more data, and
      thin overlap works;
    - lens distortion is estimated in the joint solve, not by alternating with it: the alternation stops early;
    - the final adjustment is metric (square pixels, no skew), not projective: a projective one hides wrong focal
      lengths behind a small reprojection error;
    - outliers are judged by their residual over its own standard deviation, not by a shrinking pixel threshold, and may
      come back;
    - each camera's noise is estimated and weighs it;
    - random draws are seeded.
"""
