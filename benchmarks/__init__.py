"""What is measured and reported: speed and accuracy, each against a peer, a bound or a published figure, in one run.

`python -m benchmarks [NAME ...] [--quick] [--out FOLDER]` runs the benchmarks below (all of them by default) and ends
with one table. Nothing here fails on a slow machine: times are reported, and judged only as ratios.

    recordings          the real recordings: left-out error, published figures, plausibility, wall time
    against_colmap_sfm  COLMAP's structure from motion fed with the spots
    engine              the joint engine against pycolmap's bundle adjustment, same problem, same optimum
    statistics          a synthetic room, many seeds: errors over the Cramer-Rao bound, coverage, inlier mask
    growth              5 to 200 cameras, 1,000 to 50,000 spots: time and memory exponents
    lrf_accuracy        the paper's set-up, 150 sessions: each method's errors, trust in the stated ones, time
    lrf_projection      equation 14 against a loop of OpenCV's, validity and covariance
    lrf_instruments     the LRF node's devices, emulated: clocks, faults, mutated bytes, tilt angles, the acquisition
    spot_detector       hard rendered scenes: spots found, time of a frame
    spot_profile        the fit of a spot: error over the Cramer-Rao bound, saturation, smear, compression
    detect_end_to_end   rendered videos of five cameras -> detect -> calibrate, against the truth
    rtsp_4k             a 4K camera over RTSP: frames lost; processor time of decoding, handing over, detecting
    startup             `spotcal --help`
"""

import os

# Before NumPy is loaded, here and so in every child: more BLAS threads are slower on small matrices, and one core is
# compared with one core.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"
