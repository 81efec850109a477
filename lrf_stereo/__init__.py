"""Mathematics of the tilting laser range finder: the paper equation by equation, and the general model.

The paper is Aliakbarpour, Núñez, Prado, Khoshhal, Dias, "An Efficient Algorithm for Extrinsic Calibration between a
3D Laser Range Finder and a Stereo Camera for Surveillance". File by equation:

    3       the tilting scanner, and its general form: any line as tilt axis       scanner.py
    III-B   the tilt angle from gyroscope, gravity and step count                  tilt.py
    7, 8    rigid registration of one tilt (Arun), robust and weighted             rigid.py, rigid_ransac.py
    9       the spot in a scan; crossing the scan plane                            scan_spot.py, crossing.py
    10-13   the tilt axis: the paper's circle, and the screw                       tilt_axis.py
    IV      the paper's sequence as printed                                        paper.py
    V       joint maximum likelihood with all cameras                              calibrate.py, network.py, refine.py,
                                                                                   joint_problem.py, lrf_block.py
            the clock of the scan: the spot moves between exposure and beam        spot_motion.py, sighting_block.py
    14      laser points into every camera, with covariance                        projection.py (beams.py, pixel_*.py,
                                                                                   camera_array.py)
            which cameras can see a scan at all                                    frustums.py (view_bounds.py)
            and back: which beams meet a point                                     plane_beams.py

Deliberate deviations of the joint method, with the reason:
    - one latent spot is shared by all cameras and LRFs, instead of triangulating first and registering then: the
      stereo pair's depth is ten times worse than its bearings, and equation 8 weighs both alike;
    - the tilt axis is any line (10 degrees of freedom): equation 11 drops the phase of the mirror's offset, and
      equation 10 finds a radius from an arc that hardly bends;
    - tilt angles are estimated with their sigma as priors; only their differences matter;
    - a sighting is judged against what the cameras alone say, so that a wrong one cannot vouch for itself.
"""
