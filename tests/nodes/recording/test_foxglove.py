import math

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.formats.calibration_json import load
from network_calib.result import CalibratedLrf
from nodes.bus import spotcal_pb2 as pb
from nodes.recording import schemas
from nodes.recording.foxglove import camera_calibration, tilted_transform
from nodes.recording.merge import rewrite
from nodes.recording.reader import rows
from tests.nodes.recording.conftest import FRAME_NS, START_NS


def derived(folder):
    """All messages for viewers, decoded through the schemas in the file: topic to [(publish_ns, message)]."""
    found = {}
    with (folder / "session.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, record, message in reader.iter_decoded_messages():
            if channel.topic.startswith("/foxglove/"):
                assert schema is not None
                assert schema.name.startswith("foxglove.")
                assert record.log_time == record.publish_time
                found.setdefault(channel.topic, []).append((record.publish_time, message))
    return found


def calibration_row(golden, stamp_ns=START_NS):
    header = pb.Header(schema=1, node="coordinator", boot=b"\x07" * 16, stamp_ns=stamp_ns, session="s1")
    message = pb.Calibration(header=header, id="a", is_final=True, calibration_json=golden.read_bytes())
    return ("spotcal/@v1/lab/result/calibration", message.SerializeToString(), stamp_ns)


def test_spots_stand_where_the_picture_shows_them_and_go_with_the_next_empty_frame(recorded, node):
    camera = node("n0")
    # Centre of the top-left pixel, which lies half a pixel from its corner; then a better and a worse candidate.
    camera.batch(0, 5, spots=[(0, 0.0, 0.0, 0.1, 0.9), (2, 10.0, 20.25, 0.1, 0.9), (2, 1.0, 1.0, 0.1, 0.5)])
    ((topic, messages),) = derived(recorded(camera.rows)).items()
    assert topic == "/foxglove/camera/C0/spots"
    shown = [
        (stamp_ns, [[(p.x, p.y) for p in points.points] for points in message.points]) for stamp_ns, message in messages
    ]
    assert shown == [
        (START_NS, [[(0.5, 0.5)]]),
        (START_NS + FRAME_NS, []),
        (START_NS + 2 * FRAME_NS, [[(10.5, 20.75), (1.5, 1.5)]]),
        (START_NS + 3 * FRAME_NS, []),
    ]
    two = messages[2][1].points[0]
    assert two.type == two.POINTS
    assert [color.g > color.r for color in two.outline_colors] == [True, False]
    assert messages[2][1].timestamp.ToNanoseconds() == START_NS + 2 * FRAME_NS


def test_scans_lie_about_the_front_step_and_error_codes_are_no_ranges(recorded, node):
    lrf = node("n2")
    lrf.scan([1000, 19, 5700])
    lrf.scan([1000, 2000])
    # Who the scanner is arrives last, as after a late replay.
    lrf.info()
    ((topic, ((_, scan),)),) = derived(recorded(lrf.rows)).items()
    assert (topic, scan.frame_id) == ("/foxglove/lrf/L0/scan", "lrf/L0")
    assert scan.start_angle == pytest.approx(-2 * math.pi / 1024, abs=1e-15)
    assert scan.end_angle == pytest.approx(2 * math.pi / 1024, abs=1e-15)
    assert scan.ranges[0] == 1.0
    assert np.isnan(scan.ranges[1:]).all()
    assert scan.pose.orientation.w == 1


def test_a_calibration_gives_cameras_and_their_tree(recorded, node, golden):
    camera = node("n0")
    camera.batch(0)
    found = derived(recorded([*camera.rows, calibration_row(golden)]))
    calibration = load(golden)
    ((_, tree),) = found["/foxglove/tf"]
    by_child = {transform.child_frame_id: transform for transform in tree.transforms}
    for one in calibration.cameras:
        ((_, message),) = found[f"/foxglove/camera/{one.name}/calibration"]
        assert (message.width, message.height, message.frame_id) == (*one.size_px, f"camera/{one.name}")
        transform = by_child[message.frame_id]
        assert transform.parent_frame_id == "world"
        t, q = transform.translation, transform.rotation
        assert np.array_equal([t.x, t.y, t.z], one.centre_in_world)
        # A rotation and its quaternion differ in the last digits.
        world_from_cam = Rotation.from_quat([q.x, q.y, q.z, q.w])
        assert (world_from_cam * one.cam_from_world.rotation).magnitude() < 1e-14


def test_the_camera_matrix_projects_as_opencv_does(calibration):
    import cv2

    for camera in calibration.cameras:
        message = camera_calibration(camera, START_NS)
        point = camera.cam_from_world.inv().apply([0.1, -0.2, 2.0])
        expected, _ = calibration.as_cameras().img_from_world(
            np.array([calibration.cameras.index(camera)]), point[None]
        )
        project = cv2.fisheye.projectPoints if camera.lens.is_fisheye else cv2.projectPoints
        K, D = np.array(message.K).reshape(3, 3), np.array(message.D)
        px, _ = project(np.array([[[0.1, -0.2, 2.0]]]), np.zeros(3), np.zeros(3), K, D)
        # The same formula in another order of operations: some ulp of a thousand pixels.
        assert np.allclose(px.ravel(), expected.ravel(), atol=1e-9)
        assert message.distortion_model == ("kannala_brandt" if camera.lens.is_fisheye else "plumb_bob")


def test_a_calibration_that_comes_after_the_recording_is_written_in(recorded, node, golden):
    camera = node("n0")
    camera.batch(0)
    folder = recorded(camera.rows, site="x = 1")
    before = list(rows(folder))
    assert "/foxglove/tf" not in derived(folder)
    (folder / "calibration.json").write_bytes(golden.read_bytes())
    rewrite(folder)
    assert "/foxglove/tf" in derived(folder)
    assert list(rows(folder)) == before


def test_a_calibration_that_cannot_be_read_costs_the_recording_nothing(recorded, node):
    camera = node("n0")
    camera.batch(0)
    key = "spotcal/@v1/lab/result/calibration"
    folder = recorded([*camera.rows, (key, b"\xff", START_NS)])
    assert [row.key for row in rows(folder)] == [camera.rows[0][0], key]
    with (folder / "session.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
    assert topics == {camera.rows[0][0], key, "/foxglove/camera/C0/spots"}


def test_a_tilted_lrf_stands_at_its_solved_angle_or_else_at_what_the_tilt_unit_says():
    lrf = CalibratedLrf(
        name="L0",
        world_from_lrf=RigidTransform.from_translation([1.0, 0.0, 0.0]),
        reference_tilt_rad=0.0,
        axis_direction_in_world=np.array([0.0, 1.0, 0.0]),
        axis_point_in_world=np.zeros(3),
        instrument=np.array([1.0, 0.0, 1.0, 0.0, 0.0]),
        covariance=np.zeros((15, 15)),
        dx_m=1.0,
        dz_m=0.0,
        mount_roll_rad=0.0,
        mount_yaw_rad=0.0,
        paper_sigma=np.zeros(4),
        tilt_rad=np.array([0.0, math.pi / 2]),
        tilt_sigma_rad=np.zeros(2),
        n_sightings=0,
        n_inliers=0,
        range_rms_m=0.0,
        bearing_rms_rad=0.0,
        out_of_plane_rms_m=0.0,
        held=(),
    )
    for setting, told_rad in ((1, 0.3), (2, math.pi / 2)):
        sample = pb.TiltSample(lrf="L0", setting=setting, tilt_rad=told_rad)
        (transform,) = tilted_transform(lrf, sample, START_NS).transforms
        # A quarter turn right-handed about y: what looked along x looks along -z, down.
        t, q = transform.translation, transform.rotation
        assert np.allclose([t.x, t.y, t.z], [0, 0, -1], atol=1e-15)
        assert np.allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1, 0, 0]), [0, 0, -1], atol=1e-15)
        assert transform.child_frame_id == "lrf/L0"


def test_more_cameras_than_a_viewer_needs_cost_the_recording_nothing(recorded, node, monkeypatch):
    monkeypatch.setattr(schemas, "MAX_TOPICS", 2)
    camera = node("n0")
    for k in range(5):
        camera.batch(2 * k, camera=f"C{k}")
    folder = recorded(camera.rows)
    assert list(derived(folder)) == ["/foxglove/camera/C0/spots", "/foxglove/camera/C1/spots"]
    assert len(list(rows(folder))) == 5
