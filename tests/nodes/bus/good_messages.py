"""A good message of every kind, for tests to spoil."""

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind

NOW_NS = 1_700_000_000 * 10**9
NODE = "n1"


def header():
    return pb.Header(
        schema=1,
        node=NODE,
        boot=bytes(range(16)),
        sequence=5,
        stamp_ns=NOW_NS,
        clock=pb.ClockQuality(source=pb.CLOCK_SOURCE_PTP, sigma_s=1e-5),
        session="S1",
    )


def good(kind):
    """An observation that every check passes."""
    match kind:
        case Kind.SPOTS:
            return pb.SpotBatch(
                header=header(), camera="C0", width_px=640, height_px=480, rate_hz=30, origin=pb.STAMP_ORIGIN_CAMERA,
                frame_sequence=[7, 9], frame_stamp_ns=[NOW_NS, NOW_NS + 1], spot_frame=[0, 1, 1],
                x_px=[-0.5, 1, 639.5], y_px=[-0.5, 2, 479.5], sigma_px=[0.1, 0.2, 0.3], score=[0, 0.5, 1],
            )  # fmt: skip
        case Kind.LRF_INFO:
            return pb.LrfInfo(
                header=header(), lrf="L0", product="scanner", serial="1", firmware="2", front_step=384,
                steps_per_turn=1024, first_step=44, last_step=725, range_min_m=0.02, range_max_m=5.6, turn_s=0.1,
            )  # fmt: skip
        case Kind.LRF_SCAN:
            return pb.LrfScan(
                header=header(), lrf="L0", scan=3, stamp_ns=NOW_NS, sigma_s=1e-3, device_s=10,
                readings_mm=[0, 1000], intensity=[1, 2],
            )  # fmt: skip
        case Kind.LRF_SPOT:
            return pb.LrfSpot(
                header=header(), lrf="L0", setting=1, stamp_ns=NOW_NS, range_m=2, bearing_rad=-1, range_sigma_m=0.01,
                bearing_sigma_rad=0.001, out_of_plane_sigma_m=0.002, bias_bound_m=0,
            )  # fmt: skip
        case Kind.TILT:
            return pb.TiltSample(header=header(), lrf="L0", setting=1, tilt_rad=0.2, steps=-100, has_steps=True)
        case Kind.TILTS:
            return pb.TiltSettings(
                header=header(), lrf="L0", angle_rad=[0.1, 0.2], covariance_rad2=[2e-6, 1e-6, 1e-6, 2e-6],
                sources=["steps"], notes=["fine"],
            )  # fmt: skip
        case Kind.IMU:
            return pb.ImuBatch(
                header=header(), lrf="L0", sample=[1], device_s=[1], arrival_ns=[NOW_NS], rate_rad_s=[0, 0, 0],
                acceleration_m_s2=[0, 0, -9.8],
            )  # fmt: skip
    return pb.NodeEvent(header=header(), text="phase\tbackground\n")


def good_status():
    """A status that the checks pass."""
    return pb.NodeStatus(
        header=header(),
        role="camera",
        state="watching",
        rate_hz=30,
        temperature_c=40,
        has_temperature=True,
        advice=["a"],
    )
